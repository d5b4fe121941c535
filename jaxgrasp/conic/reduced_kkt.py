"""The reduced KKT matrix N of a ``ConvexConeProgram`` on the central path: slacks, prices and z are eliminated.

    (D + W^-2 + head) du + B^T dy - e_0 delta dxi + E^T dbeta = r_u        B du = r_y
    sum_i delta_i (dxi - du_0,i)                              = r_xi       E du - dbeta / rate = r_beta

``head`` and ``delta`` are rates price / slack of the inequalities on u_0 and of the level. N is symmetric in
(u, y, xi, beta). ``kkt_product`` is plain JAX: it defines N and may be differentiated. ``kkt_solve`` is its inverse in
stages, which nothing differentiates. Source: Wright, Primal-Dual Interior-Point Methods, 1997, chapter 11 (augmented
system).
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from ..backend import fori_loop, stage
from ..core import Array, pivot_tolerance, unit_roundoff, widest_scaling
from .cholesky import Cholesky, solve_lower, solve_transposed
from .cone import Cone, cone_sum, inner
from .convex_cone_program import Bounds, ConvexConeProgram, ConvexPoint, OptionalArray
from .jordan_frame import JordanFrame, tail_basis, tail_size, unit_direction
from .products import matvec, rmatvec
from .scaled_kkt import ScaledDirection, ScaledSides, factor_scaled_kkt

__all__ = ["KKTVector", "ReducedKKT", "central_products", "kkt_product", "kkt_solve", "reduced_kkt"]

REFINEMENTS = 2


class KKTVector(NamedTuple):
    """What N acts on, and what it makes of it: u (d arrays (k, L)), y (m, L), xi (L,), beta (q, L)."""

    u: Cone
    y: Array
    xi: OptionalArray
    beta: OptionalArray


class ReducedKKT(NamedTuple):
    """N at a point.

    rates  price / slack of the inequalities      stiffness  z / u in frame coordinates
    """

    program: ConvexConeProgram
    rates: Bounds
    frame: JordanFrame
    stiffness: Cone


def central_products(program: ConvexConeProgram, point: ConvexPoint) -> Array:
    """``<u_i, z_i>``: fixed but for the floors in it."""
    product, floor = inner(point.u, point.z), program.cone_target()
    base = lax.stop_gradient(product) if floor is None else floor + lax.stop_gradient(product - floor)
    least = unit_roundoff(product.dtype) * lax.stop_gradient(point.u[0] * point.z[0])
    return jnp.where(program.exists > 0, jnp.maximum(base, least), jnp.ones_like(base))


def central_frame(program: ConvexConeProgram, point: ConvexPoint) -> JordanFrame:
    """The scaling of a central point, each eigenvalue from numbers that did not cancel."""
    u, z = point.u, point.z
    product = central_products(program, point)
    if len(u) == 1:
        return JordanFrame((), u[0] / jnp.sqrt(product), None, None)
    root = jnp.sqrt(product)
    tails = tuple(a / u[0] - b / z[0] for a, b in zip(u[1:], z[1:], strict=True))
    direction, _ = unit_direction(tails)
    along = (u[0] + tail_size(u)) / root
    against = root / (z[0] + tail_size(z))
    across = jnp.sqrt(u[0] / z[0]) if len(u) > 2 else None
    return JordanFrame(tail_basis(direction), along, against, across)


def reduced_kkt(program: ConvexConeProgram, point: ConvexPoint) -> ReducedKKT:
    """N at a point on the central path."""
    frame = central_frame(program, point)
    rates = program.rates(program.masks(), point)
    return ReducedKKT(program, rates, frame, tuple(1 / (w * w) for w in frame.eigenvalues()))


def kkt_product(kkt: ReducedKKT, x: KKTVector) -> KKTVector:
    """``N x``."""
    program, rates, frame = kkt.program, kkt.rates, kkt.frame
    m = program.rhs.shape[0]
    rows = x.y if x.beta is None else jnp.concatenate([x.y, x.beta])
    adjoint = rmatvec(program.columns, rows)
    along = frame.to_frame(x.u)
    stiff = frame.from_frame(tuple(h * a for h, a in zip(kkt.stiffness, along, strict=True)))
    cone = [program.exists * (a + b) for a, b in zip(adjoint, stiff, strict=True)]
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
    return KKTVector(tuple(cone), applied[:m], level, beta)


def kkt_solve(
    program: ConvexConeProgram, point: ConvexPoint, triangle: Cholesky, rhs: KKTVector
) -> KKTVector:
    """``N^-1 rhs``, refined: one lane's bits depend on nothing but its own. ``B = L Q``, Q of orthonormal rows.

    Rows closer to dependent than sqrt(rounding) make derivatives of rounding: they get one finite choice, 0. No
    eigenvalue of W beyond ``widest_scaling`` enters the factorisation; refinement makes up for the bound.
    """
    kkt = _stored(program, point)
    limit = widest_scaling(program.exists.dtype) ** 0.5
    frame = _bounded(kkt.frame, limit)
    orthonormal = program._replace(columns=_orthonormal(triangle, program.columns))
    dependent = pivot_tolerance(program.exists.dtype) ** 0.5
    factored = factor_scaled_kkt(orthonormal, frame, kkt.rates, dependent)

    def respond(rhs: KKTVector) -> KKTVector:
        return _unscaled(program, frame, triangle, factored.solve(_scaled(frame, triangle, rhs)))

    def refine(_: Array, carry: tuple[KKTVector, KKTVector]) -> tuple[KKTVector, KKTVector]:
        x, left = carry
        change = respond(left)
        x = _sum(x, change)
        return x, _residual(kkt, frame, change, x, rhs)

    nothing = jax.tree.map(jnp.zeros_like, rhs)
    return fori_loop(0, 1 + REFINEMENTS, refine, (nothing, rhs))[0]


# Stages of the solve, which nothing differentiates.

_stored = stage(reduced_kkt)


@stage
def _bounded(frame: JordanFrame, limit: float) -> JordanFrame:
    along, against, across = (
        None if w is None else jnp.minimum(w, jnp.asarray(limit, w.dtype))
        for w in (frame.along, frame.against, frame.across)
    )
    assert along is not None
    return JordanFrame(frame.basis, along, against, across)


def _orthonormal(triangle: Cholesky, columns: Cone) -> Cone:
    """``L^-1 B`` over E."""
    m = len(triangle.inverse)
    solved = tuple(solve_lower(triangle, c[:m]) for c in columns)
    return _over(solved, tuple(c[m:] for c in columns))


@stage
def _over(upper: Cone, lower: Cone) -> Cone:
    return tuple(jnp.concatenate([a, b]) for a, b in zip(upper, lower, strict=True))


def _scaled(frame: JordanFrame, triangle: Cholesky, rhs: KKTVector) -> ScaledSides:
    """``rhs`` in scaled coordinates, its equations multiplied by L^-1."""
    solved = solve_lower(triangle, rhs.y)
    h, head, rows = _sides(frame, rhs.u, solved, rhs.beta)
    return ScaledSides(h, head, rhs.xi, rows)


@stage
def _sides(frame: JordanFrame, u: Cone, y: Array, beta: OptionalArray) -> tuple[Cone, Array, Array]:
    rows = y if beta is None else jnp.concatenate([y, beta])
    return frame.scale(frame.to_frame(u)), jnp.zeros_like(u[0]), rows


def _unscaled(
    program: ConvexConeProgram, frame: JordanFrame, triangle: Cholesky, x: ScaledDirection
) -> KKTVector:
    y = solve_transposed(triangle, x.rows[: program.rhs.shape[0]])
    return _vector(program.exists, frame, x, y, program.bound)


@stage
def _vector(
    exists: Array, frame: JordanFrame, x: ScaledDirection, y: Array, bound: OptionalArray
) -> KKTVector:
    u = tuple(exists * a for a in frame.from_frame(frame.scale(x.p)))
    return KKTVector(u, y, x.xi, None if bound is None else x.rows[y.shape[0] :])


@stage
def _residual(
    kkt: ReducedKKT, bounded: JordanFrame, change: KKTVector, x: KKTVector, rhs: KKTVector
) -> KKTVector:
    """What bounding the eigenvalues left of ``change``, and what rounding left of ``B u = r_y``.

    ``rhs - N x`` itself would be noise: rates grow like 1 / gap, and multiply the rounding of u.
    """
    along = bounded.to_frame(change.u)
    excess = (1 / (w * w) - h for w, h in zip(bounded.eigenvalues(), kkt.stiffness, strict=True))
    cone = bounded.from_frame(tuple(h * a for h, a in zip(excess, along, strict=True)))
    m = rhs.y.shape[0]
    applied = matvec(tuple(c[:m] for c in kkt.program.columns), x.u)
    zero = jax.tree.map(jnp.zeros_like, (rhs.xi, rhs.beta))
    return KKTVector(cone, rhs.y - applied, *zero)


@stage
def _sum(x: KKTVector, more: KKTVector) -> KKTVector:
    return jax.tree.map(jnp.add, x, more)
