"""Derivatives of the margin of wrench resistance with respect to positions, normals and coefficients.

    d t* = derivative of the Lagrangian of the margin's cone program, the solution fixed    (envelope theorem)

and of the internal force and the escape twist behind it, by the implicit function theorem. t* depends on Null(A)
alone, so the length L, which scales the program, is held fixed; the factor of A serves the linear solve alone. An
escape twist read from the rank of A, or from unit forces alone, stays where it is. A ``custom_jvp`` whose rule calls
the same function: it nests. Lanes without a margin (INVALID, t* = -inf), and all lanes of ``verdict_only``, have
derivative 0.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from ..backend import inlined, to_lanes
from ..conic import (
    Bounds,
    Cholesky,
    Cone,
    ConvexConeProgram,
    ConvexPoint,
    PointShift,
    centring,
    cone_sum,
    kkt_solve,
    lagrangian,
    point_tangent,
    residuals,
)
from ..contacts import (
    BatchAxes,
    Component,
    Contacts,
    filled,
    fold,
    masked,
    safe_contacts,
    tiled,
    tiled_solver,
    unfold,
    zero_tangent,
)
from ..core import Array, Status
from .problem import margin_program
from .verdict import Verdict

__all__ = ["Solved", "differentiable"]

NO_BOUNDS = Bounds(None, None, None, None, None)
TWIST_READ = 1e-3  # an escape twist this near the multipliers' own was read from them


class Solved(NamedTuple):
    """The solver's part of a result, as rows.

    point  (y, u, z) of the margin's cone program, y the multipliers of A itself; None where no derivative is wanted
    """

    verdict: Verdict
    iterations: Array
    stop: Array
    point: tuple[Array, Array, Array] | None
    scales: Scales | None


class Scales(NamedTuple):
    """Constants of the derivative, lanes last."""

    length: Array
    factor: Cholesky


class _Form(NamedTuple):
    """What is fixed at trace time."""

    components: tuple[Component, ...]
    width: int


def _program(form: _Form, contacts: Contacts, scales: Scales) -> ConvexConeProgram:
    """``margin_program`` of A itself as a differentiable function of the contacts."""
    program = margin_program(fold(contacts, form.components, scales.length))
    none = (None,) * 7
    return ConvexConeProgram(program.columns, program.rhs, program.exists, program.cost[0], *none)


def _centring(form: _Form, contacts: Contacts, scales: Scales, point: ConvexPoint) -> PointShift:
    program = _program(form, contacts, scales)
    return centring(program, point, lambda rhs: kkt_solve(program, point, scales.factor, rhs))


def _added(a: Cone, b: Cone) -> Cone:
    return tuple(x + y for x, y in zip(a, b, strict=True))


def _internal_force(
    contacts: Contacts, exists: Array, u: Cone, t: Array, components: tuple[Component, ...]
) -> Array:
    """``s = u + t e`` in the caller's components."""
    s = (exists * (u[0] + t), *(exists * x for x in u[1:]))
    return unfold(s, components, to_lanes(contacts.friction), to_lanes(contacts.torsion))


def _twist(y: Array, length: Array) -> Array:
    """(m, N) unit (velocity; angular velocity) of the multipliers y of A, whose lengths are over ``length``."""
    m = y.shape[0]
    physical = y / jnp.where(jnp.arange(m)[:, None] < (2 if m == 3 else 3), 1.0, length)
    square = jnp.sum(physical * physical, axis=0)
    return physical / jnp.sqrt(jnp.where(square > 0, square, 1.0))


def differentiable(
    solve: Callable[[Contacts, Array], Solved], components: tuple[Component, ...], exact: bool, width: int
) -> Callable[[Contacts, Array], Solved]:
    """``solve`` with derivatives of margin and internal force; ``exact``: the solver went to the optimum."""
    form = _Form(components, width)

    @jax.custom_jvp
    def run(contacts: Contacts, tolerance: Array) -> Solved:
        return solve(contacts, tolerance)

    @run.defjvp
    def rule(primals, tangents):  # pyright: ignore[reportUnusedFunction]
        contacts, tolerance = primals
        result = run(contacts, tolerance)
        if not exact:
            return result, jax.tree.map(zero_tangent, result)
        with inlined():
            change = _tangents(form, result, contacts, tangents[0])
        return result, change

    return run


def _tangents(form: _Form, result: Solved, contacts: Contacts, change: Any) -> Solved:
    batch = BatchAxes(result.stop.shape)
    flat = batch.flat
    assert result.point is not None and result.scales is not None
    data, changes = jax.tree.map(flat, (contacts, change))
    ok = jnp.isfinite(flat(result.verdict.margin)) & (flat(result.stop) != Status.SKIPPED.value)
    data, changes = safe_contacts(ok, data), jax.tree.map(lambda x, dx: masked(ok, x, dx), data, changes)
    y, u, z = (flat(x) for x in result.point)  # (N, m), (N, d, k), (N, d, k)
    apex = jnp.zeros(u.shape[1:2], u.dtype).at[0].set(1.0)[:, None]

    def cone(rows: Array) -> Cone:
        lanes = to_lanes(filled(ok, rows, apex))
        return tuple(lanes[i] for i in range(lanes.shape[0]))

    point = ConvexPoint(-to_lanes(filled(ok, y, 0.0)), None, cone(u), cone(z), NO_BOUNDS, NO_BOUNDS)
    scales = jax.tree.map(lambda x: lax.stop_gradient(to_lanes(filled(ok, flat(x), 1.0))), result.scales)
    program = _program(form, data, scales)
    fixed = lax.stop_gradient((data, scales))
    shift = tiled(partial(_centring, form), fixed[0], (fixed[1], lax.stop_gradient(point)), form.width)
    point = point._replace(y=point.y + shift.y, u=_added(point.u, shift.u), z=_added(point.z, shift.z))
    _, residual = jax.jvp(lambda c: residuals(_program(form, c, scales), point), (data,), (changes,))
    solver = tiled_solver(partial(_program, form), *fixed, lax.stop_gradient(point), form.width)
    moved = point_tangent(program, point, residual, solver)
    _, cost = jax.jvp(lambda c: lagrangian(_program(form, c, scales), point), (data,), (changes,))
    t = 1 - cone_sum(program.price * point.u[0])
    _, force = jax.jvp(
        lambda c, u, t: _internal_force(c, program.exists, u, t, form.components),
        (data, point.u, t),
        (changes, moved.u, -cost),
    )

    y_read = -to_lanes(filled(ok, y, 0.0))
    twist = filled(ok, flat(result.verdict.escape_twist), 0.0)
    read = jnp.all(jnp.abs(_twist(y_read, scales.length) - to_lanes(twist)) < TWIST_READ, axis=0)
    _, turned = jax.jvp(lambda y: _twist(y, scales.length), (point.y,), (jnp.where(read, moved.y, 0.0),))

    back = partial(batch.back, ok)
    zero = jax.tree.map(zero_tangent, result)
    verdict = zero.verdict._replace(
        margin=back(-cost), upper=back(-cost), internal_force=back(force), escape_twist=back(turned)
    )
    moves = (back(-moved.y), back(jnp.stack(moved.u)), back(jnp.stack(moved.z)))
    return zero._replace(verdict=verdict, point=moves)
