"""Derivatives of optimal costs and forces with respect to everything that is asked (theory section 3).

    d cost  = derivative of the Lagrangian in the data, the solution fixed       (envelope theorem, no linear solve)
    d force = one solve with the Newton matrix at the solution                   (implicit function theorem)

A ``custom_jvp`` whose rule calls the same function again, so gradients, Hessians and every nesting are exact. The
load's size, the length L and the norms of the torque rows only scale the problem; the rule holds them fixed. It works
with A itself: the factor of A serves the linear solve alone. Lanes without an optimum, and lanes without a load, have
derivative 0.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from ..backend import inlined, to_lanes
from ..conic import (
    Cholesky,
    Cone,
    ConvexConeProgram,
    ConvexPoint,
    cone_sum,
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
    tiled_solver,
    unfold,
    zero_tangent,
)
from ..core import Array, Status
from .answer import Answer
from .bounds import criterion_value
from .problem import Demand, force_program

__all__ = ["Scales", "Solved", "differentiable"]

Rows = tuple[Contacts, Demand]


class Scales(NamedTuple):
    """What the scaled problem was divided by: constants of the derivative. Lanes last."""

    length: Array
    size: Array
    factor: Cholesky
    row_norm: Array | None


class Solved(NamedTuple):
    """The solver's part of a result, as rows; ``point`` and ``scales`` only where derivatives may be wanted.

    point  the primal-dual point, its y the multipliers of A itself
    """

    answer: Answer
    smooth: Array
    iterations: Array
    stop: Array
    point: ConvexPoint | None
    scales: Scales | None


class _Form(NamedTuple):
    """What is fixed at trace time."""

    components: tuple[Component, ...]
    dimension: int
    width: int


def _program(form: _Form, rows: Rows, scales: Scales) -> ConvexConeProgram:
    """The scaled program ``A u = -w / size`` as a differentiable function of the data."""
    contacts, demand = rows
    folded = fold(contacts, form.components, scales.length)
    wrench = to_lanes(demand.wrench)
    force, torque = wrench[: form.dimension], wrench[form.dimension :] / scales.length
    rhs = -jnp.concatenate([force, torque]) / scales.size
    program, _, _ = force_program(
        contacts, folded.exists, folded.columns, rhs, scales.size, demand, form.components, scales.row_norm
    )
    return program


def _safe(ok: Array, rows: Rows) -> Rows:
    """``rows`` with harmless numbers in the lanes without a derivative."""
    contacts, demand = rows

    def keep(x: Array | None, value: float) -> Array | None:
        return None if x is None else filled(ok, x, value)

    asked = Demand(
        filled(ok, demand.wrench, 0.0),
        jax.tree.map(lambda x: filled(ok, x, 1.0), demand.criterion),
        jax.tree.map(lambda x: filled(ok, x, 1.0), demand.log_det),
        keep(demand.cap, np.inf),
        keep(demand.jacobian, 0.0),
        keep(demand.torque, 1.0),
        keep(demand.smoothing, 1.0),
    )
    return safe_contacts(ok, contacts), asked


def _safe_point(ok: Array, point: ConvexPoint) -> ConvexPoint:
    """An interior point in the lanes without a derivative; lanes last."""

    def keep(x: Array, value: float) -> Array:
        return jnp.where(ok, x, jnp.full_like(x, value))

    def cone(x: Cone) -> Cone:
        return (keep(x[0], 1.0), *(keep(t, 0.0) for t in x[1:]))

    ones = jax.tree.map(lambda x: keep(x, 1.0), (point.slack, point.price))
    xi = None if point.xi is None else keep(point.xi, 2.0)
    return ConvexPoint(keep(point.y, 0.0), xi, cone(point.u), cone(point.z), *ones)


class _View(NamedTuple):
    """The differentiable outputs of a lane, lanes last."""

    force: Array
    twist: Array
    rates: Array
    cost: Array


def _view(form: _Form, rows: Rows, scales: Scales, point: ConvexPoint) -> _View:
    """Forces, multipliers and the criterion's value, as functions of the data and the point."""
    contacts, demand = rows
    friction, torsion = to_lanes(contacts.friction), to_lanes(contacts.torsion)
    force = unfold(tuple(scales.size * x for x in point.u), form.components, friction, torsion)
    program = _program(form, rows, scales)
    back = scales.size if program.curvature is not None else jnp.ones_like(scales.size)
    y = back * point.y
    twist = jnp.concatenate([y[: form.dimension], y[form.dimension :] / scales.length])
    rates = jnp.zeros((0, *scales.size.shape), force.dtype)
    if scales.row_norm is not None:
        assert point.price.upper is not None and point.price.lower is not None
        rates = back * (point.price.upper - point.price.lower) / scales.row_norm
    cost = criterion_value(program, point.u, scales.size, demand.barrier())
    return _View(force, twist, rates, cost)


def _value(form: _Form, rows: Rows, scales: Scales, point: ConvexPoint) -> Array:
    """The Lagrangian in the caller's units, the point fixed."""
    demand = rows[1]
    program = _program(form, rows, scales)
    total = scales.size * lagrangian(program, point)
    if program.curvature is not None:
        total = total * scales.size
    barrier = demand.barrier()
    if barrier is not None:
        degree = barrier.on_normal + 2 * barrier.on_cone
        logs = cone_sum(program.exists * (degree * jnp.log(scales.size) + barrier.constant))
        total = total - barrier.weight * logs
    return total


def differentiable(
    solve: Callable[[Rows, Array], Solved], components: tuple[Component, ...], dimension: int, width: int
) -> Callable[[Rows, Array], Solved]:
    """``solve`` with derivatives of cost, bound, force, load_twist and joint_rates in all float rows."""
    form = _Form(components, dimension, width)

    @jax.custom_jvp
    def run(rows: Rows, tolerance: Array) -> Solved:
        return solve(rows, tolerance)

    @run.defjvp
    def rule(primals, tangents):  # pyright: ignore[reportUnusedFunction]
        rows, tolerance = primals
        result = run(rows, tolerance)
        with inlined():
            change = _tangents(form, result, rows, tangents[0])
        return result, change

    return run


def _tangents(form: _Form, result: Solved, rows: Rows, change: Rows) -> Solved:
    batch = BatchAxes(result.answer.status.shape)
    flat = batch.flat
    data, changes = jax.tree.map(flat, (rows, change))
    assert result.point is not None and result.scales is not None
    status, stop = flat(result.answer.status), flat(result.stop)
    point, scales = jax.tree.map(lambda x: to_lanes(flat(x)), (result.point, result.scales))
    ok = (status == Status.OPTIMAL.value) & (stop != Status.SKIPPED.value)

    data = _safe(ok, data)
    changes = jax.tree.map(lambda x, dx: masked(ok, x, dx), data, changes)
    point = _safe_point(ok, point)
    scales = jax.tree.map(lambda x: lax.stop_gradient(jnp.where(ok, x, jnp.ones_like(x))), scales)

    program = _program(form, data, scales)
    _, residual = jax.jvp(lambda r: residuals(_program(form, r, scales), point), (data,), (changes,))
    fixed = lax.stop_gradient((data, scales, point))
    moved = point_tangent(program, point, residual, tiled_solver(partial(_program, form), *fixed, form.width))
    _, seen = jax.jvp(lambda r, p: _view(form, r, scales, p), (data, point), (changes, moved))
    cost = seen.cost
    if data[1].smoothing is None:
        _, cost = jax.jvp(lambda r: _value(form, r, scales, point), (data,), (changes,))

    back = partial(batch.back, ok)
    zero = jax.tree.map(zero_tangent, result)
    cost = back(cost)
    answer_change = zero.answer._replace(
        force=back(seen.force),
        cost=cost,
        bound=cost,
        load_twist=back(seen.twist),
        joint_rates=back(seen.rates),
    )
    return zero._replace(answer=answer_change, point=jax.tree.map(back, moved))
