"""The Newton matrix N of a ``ConvexProgram`` at a point of the central path, with slacks, prices and z eliminated:

    (D + W^-2 + head) du + B^T dy - e_0 delta dxi + E^T dbeta = r_u        B du = r_y
    sum_i delta_i (dxi - du_0,i)                              = r_xi       E du - dbeta / rate = r_beta

``head`` and ``delta`` are rates price / slack of the inequalities on u_0 and of the level. N is symmetric in
(u, y, xi, beta). ``newton_product`` is plain JAX: it defines N and may be differentiated. ``newton_solve`` is its
inverse in stages, which nothing differentiates.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from ..backend import stage
from ..core import Array, pivot_tolerance, unit_roundoff, widest_scaling
from .arrow_blocks import Frame, tail_basis, unit_direction
from .cone import Cone, cone_sum, inner
from .convex_program import Bounds, ConvexProgram, Optional, Point, as_vector
from .kkt import factor
from .linear import Cholesky, matvec, rmatvec, solve_lower, solve_transposed

__all__ = ["Motion", "Newton", "newton_at", "newton_product", "newton_solve"]

REFINEMENTS = 2


def tail_size(x: Cone) -> Array:
    if len(x) == 1:
        return jnp.zeros_like(x[0])
    return unit_direction(x[1:])[1]


def products(program: ConvexProgram, point: Point) -> Array:
    """``<u_i, z_i>``: fixed but for the floors in it."""
    product, floor = inner(point.u, point.z), program.cone_target()
    base = lax.stop_gradient(product) if floor is None else floor + lax.stop_gradient(product - floor)
    least = unit_roundoff(product.dtype) * lax.stop_gradient(point.u[0] * point.z[0])
    return jnp.where(program.exists > 0, jnp.maximum(base, least), jnp.ones_like(base))


def central_frame(program: ConvexProgram, point: Point) -> Frame:
    """The scaling of a central point, each eigenvalue from numbers that did not cancel."""
    u, z = point.u, point.z
    product = products(program, point)
    if len(u) == 1:
        return Frame((), u[0] / jnp.sqrt(product), None, None)
    root = jnp.sqrt(product)
    pull = tuple(a / u[0] - b / z[0] for a, b in zip(u[1:], z[1:], strict=True))
    direction, _ = unit_direction(pull)
    along = (u[0] + tail_size(u)) / root
    against = root / (z[0] + tail_size(z))
    across = jnp.sqrt(u[0] / z[0]) if len(u) > 2 else None
    return Frame(tail_basis(direction), along, against, across)


class Motion(NamedTuple):
    """What the Newton matrix acts on, and what it makes of it: u (d arrays (k, L)), y (m, L), xi (L,), beta (q, L)."""

    u: Cone
    y: Array
    xi: Optional
    beta: Optional


class Newton(NamedTuple):
    """The Newton matrix at a point.

    rates  price / slack of the inequalities      stiffness  z / u in frame coordinates
    """

    program: ConvexProgram
    rates: Bounds
    frame: Frame
    stiffness: Cone


def families(function: Callable, *parts: Bounds) -> Bounds:
    return Bounds(*(None if p[0] is None else function(*p) for p in zip(*parts, strict=True)))


def newton_at(program: ConvexProgram, point: Point) -> Newton:
    """The Newton matrix at a point on the central path."""
    frame = central_frame(program, point)
    rates = families(lambda m, s, p: m * p / s, program.masks(), point.slack, point.price)
    return Newton(program, rates, frame, tuple(1 / (w * w) for w in frame.eigenvalues()))


def newton_product(newton: Newton, x: Motion) -> Motion:
    """``N x``."""
    program, rates, frame = newton.program, newton.rates, newton.frame
    m = program.rhs.shape[0]
    rows = x.y if x.beta is None else jnp.concatenate([x.y, x.beta])
    pulled = rmatvec(program.columns, as_vector(rows))
    along = frame.to_frame(x.u)
    stiff = frame.from_frame(tuple(h * a for h, a in zip(newton.stiffness, along, strict=True)))
    cone = [program.exists * (a + b) for a, b in zip(pulled, stiff, strict=True)]
    if program.curvature is not None:
        cone = [a + program.exists * b for a, b in zip(cone, program.curvature.apply(x.u), strict=True)]
    total = rates.sum_on_head()
    if total is not None:
        cone[0] = cone[0] + total * x.u[0]
    level = beta = None
    if rates.level is not None:
        cone[0] = cone[0] - rates.level * x.xi
        level = cone_sum(rates.level * (x.xi - x.u[0]))
    applied = matvec(program.columns, x.u)
    if x.beta is not None:
        beta = applied[m:] - x.beta / (rates.upper + rates.lower)
    return Motion(tuple(cone), applied[:m], level, beta)


def newton_solve(program: ConvexProgram, point: Point, triangle: Cholesky, rhs: Motion) -> Motion:
    """``N^-1 rhs``, refined: one lane's bits depend on nothing but its own. ``B = L Q``, Q of orthonormal rows.

    Rows closer to dependent than sqrt(rounding) make derivatives of rounding: they get one finite choice, 0. No
    eigenvalue of W beyond ``widest_scaling`` enters the factorisation; refinement makes up for the cut.
    """
    newton = _prepared(program, point)
    limit = widest_scaling(program.exists.dtype) ** 0.5
    frame = _cut(newton.frame, limit)
    columns = _orthonormal(triangle, program.columns)
    inside = program._replace(columns=columns)
    dependent = pivot_tolerance(program.exists.dtype) ** 0.5
    kkt = factor(inside, frame, newton.rates, dependent)

    def respond(rhs: Motion) -> Motion:
        h, head, equations = _scaled_sides(frame, triangle, rhs)
        solution = kkt.solve(h, head, rhs.xi, equations)
        return _unscaled(program, frame, triangle, solution.p, solution.xi, solution.rows)

    x = change = respond(rhs)
    for _ in range(REFINEMENTS):
        change = respond(_left(newton, frame, change, x, rhs))
        x = _sum(x, change)
    return x


# Stages of the solve, which nothing differentiates.

_prepared = stage(newton_at)


@stage
def _cut(frame: Frame, limit: float) -> Frame:
    along, against, across = (
        None if w is None else jnp.minimum(w, jnp.asarray(limit, w.dtype))
        for w in (frame.along, frame.against, frame.across)
    )
    assert along is not None
    return Frame(frame.basis, along, against, across)


def _orthonormal(triangle: Cholesky, columns: Cone) -> Cone:
    """``L^-1 B`` over E."""
    m = len(triangle.inverse)
    solved = [solve_lower(triangle, tuple(c[i] for i in range(m)))[0] for c in columns]
    return _over(solved, tuple(c[m:] for c in columns))


@stage
def _over(upper: list[tuple[Array, ...]], lower: Cone) -> Cone:
    return tuple(jnp.concatenate([jnp.stack(a), b]) for a, b in zip(upper, lower, strict=True))


def _scaled_sides(frame: Frame, triangle: Cholesky, rhs: Motion) -> tuple[Cone, Array, Array]:
    inner_rows, _ = solve_lower(triangle, as_vector(rhs.y))
    return _sides(frame, rhs.u, inner_rows, rhs.beta)


@stage
def _sides(frame: Frame, u: Cone, rows: tuple[Array, ...], beta: Optional) -> tuple[Cone, Array, Array]:
    equations = jnp.stack(rows)
    if beta is not None:
        equations = jnp.concatenate([equations, beta])
    return frame.scale(frame.to_frame(u)), jnp.zeros_like(u[0]), equations


def _unscaled(
    program: ConvexProgram, frame: Frame, triangle: Cholesky, p: Cone, xi: Optional, rows: Array
) -> Motion:
    m = program.rhs.shape[0]
    y = solve_transposed(triangle, as_vector(rows[:m]))
    return _motion(program.exists, frame, p, y, xi, rows if program.bound is not None else None, m)


def _motion(
    exists: Array, frame: Frame, p: Cone, y: tuple[Array, ...], xi: Optional, rows: Optional, m: int
) -> Motion:
    @stage
    def run(
        exists: Array, frame: Frame, p: Cone, y: tuple[Array, ...], xi: Optional, rows: Optional
    ) -> Motion:
        u = tuple(exists * x for x in frame.from_frame(frame.scale(p)))
        return Motion(u, jnp.stack(y), xi, None if rows is None else rows[m:])

    return run(exists, frame, p, y, xi, rows)


@stage
def _left(newton: Newton, cut: Frame, change: Motion, x: Motion, rhs: Motion) -> Motion:
    """What the cut left of ``change``, and what rounding left of ``B u = r_y``.

    ``rhs - N x`` itself would be noise: rates grow like 1 / gap, and multiply the rounding of u.
    """
    along = cut.to_frame(change.u)
    excess = (1 / (w * w) - h for w, h in zip(cut.eigenvalues(), newton.stiffness, strict=True))
    cone = cut.from_frame(tuple(h * a for h, a in zip(excess, along, strict=True)))
    m = rhs.y.shape[0]
    applied = matvec(tuple(c[:m] for c in newton.program.columns), x.u)
    zero = jax.tree.map(jnp.zeros_like, (rhs.xi, rhs.beta))
    return Motion(cone, rhs.y - applied, *zero)


@stage
def _sum(x: Motion, more: Motion) -> Motion:
    return jax.tree.map(jnp.add, x, more)
