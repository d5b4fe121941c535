"""One primal-dual Newton step of a ``LinearConeProgram``: Mehrotra's predictor and corrector, Nesterov-Todd scaling.

With W of the scaling, ``lambda = W z = W^-1 u``, ``C = B W`` and the scaled changes ``q = W dz``, ``p = W^-1 du``, the
linearised conditions ``lambda o (p + q) = target``, ``B du = r``, ``B^T dy + dz = 0`` collapse to m unknowns:

    (C C^T) dy = r - C h,   q = -C^T dy,   p = h - q,       lambda o (lambda + h) = sigma mu e + (lambda + q) o q

Sources: Nesterov, Todd 1997; Mehrotra 1992; Vandenberghe 2010.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp

from ..backend import stage
from ..core import Array, pivot_tolerance
from .cholesky import cholesky, cholesky_solve
from .cone import Cone, cone_max, cone_sum, inner, jordan_product, tail_inner
from .linear_cone_program import LinearConeProgram
from .mehrotra import boundary_fraction, clipped_ratio, step_length
from .nesterov_todd import Scaling, interior_rate, nesterov_todd
from .products import gram, matvec, rmatvec, vector_norm

__all__ = ["LinearPoint", "LinearStep", "linear_newton_step"]


class LinearPoint(NamedTuple):
    """A strictly interior point: y free (m, L), u and z in the cones (d arrays (k, L))."""

    y: Array
    u: Cone
    z: Cone


class LinearStep(NamedTuple):
    """What one Newton step did, per lane."""

    residual: Array  # |b - B u| before the step
    centering: Array  # sigma
    length: Array


@stage
def _scale(scaling: Scaling, x: Cone) -> Cone:
    return scaling.apply(x)


@stage
def _residual(program: LinearConeProgram, u: Cone) -> Array:
    return program.residual(u)


@stage
def _dual_direction(columns: Cone, dy: Array) -> Cone:
    return tuple(-x for x in rmatvec(columns, dy))


@stage
def _predictor_length(scaling: Scaling, lam: Cone, q: Cone) -> Array:
    """Step to the boundary along p = -lambda - q, q, capped at 1; the same for both sides."""
    rho = scaling.to_identity(lam, q)
    dual, primal = interior_rate(rho), interior_rate(tuple(-x for x in rho)) + 1
    return 1 / jnp.maximum(jnp.ones_like(dual[0]), cone_max(jnp.maximum(dual, primal)))


@stage
def _centering(exists: Array, lam: Cone, q: Cone, length: Array) -> tuple[Array, Array]:
    """``r`` = gap after the predictor / gap, and the target ``sigma mu`` with Mehrotra's sigma = r^3."""
    gap = cone_sum(exists * inner(lam, lam))
    p_after = tuple((1 - length) * a - length * b for a, b in zip(lam, q, strict=True))
    q_after = tuple(a + length * b for a, b in zip(lam, q, strict=True))
    ratio = clipped_ratio(cone_sum(exists * inner(p_after, q_after)) / gap)
    sigma = ratio * ratio * ratio
    return ratio, sigma * gap / cone_sum(exists)


@stage
def _solved_head(scaling: Scaling, lam: Cone, q: Cone, target: Array) -> tuple[Array, Array]:
    """First entry of ``x`` in ``lambda o x = target e + (lambda + q) o q``, and 1 / lambda_0.

    ``lambda o`` is an arrowhead matrix; its inverse is in Vandenberghe 2010, section 5.
    """
    moved = tuple(a + b for a, b in zip(lam, q, strict=True))
    c = jordan_product(moved, q)
    head = lam[0] * (target + c[0]) - tail_inner(lam, c)
    return head * scaling.root * scaling.root, 1 / lam[0]


@stage
def _centring_direction(exists: Array, lam: Cone, q: Cone, head: Array, inverse: Array) -> Cone:
    """``h = lambda \\ (target e + (lambda + q) o q) - lambda``: centring plus second-order correction."""
    moved = tuple(a + b for a, b in zip(lam, q, strict=True))
    c = jordan_product(moved, q)
    rest = ((b - a * head) * inverse - a for a, b in zip(lam[1:], c[1:], strict=True))
    return tuple(exists * x for x in (head - lam[0], *rest))


@stage
def _corrector_rhs(residual: Array, columns: Cone, h: Cone) -> Array:
    return residual - matvec(columns, h)


@stage
def _difference(h: Cone, q: Cone) -> Cone:
    return tuple(a - b for a, b in zip(h, q, strict=True))


@stage
def _step_length(scaling: Scaling, lam: Cone, p: Cone, q: Cone, ratio: Array) -> Array:
    """One length for both sides, which keeps the iterates near the central path: two lengths stall 1 % of the lanes."""
    rate = cone_max(jnp.maximum(scaling.step_reach(lam, p), scaling.step_reach(lam, q)))
    return step_length(rate, boundary_fraction(ratio))


@stage
def _moved(
    point: LinearPoint, columns: Cone, scaling: Scaling, dy: Array, p: Cone, length: Array
) -> LinearPoint:
    du, dz = scaling.apply(p), rmatvec(columns, dy)
    u = tuple(a + length * b for a, b in zip(point.u, du, strict=True))
    z = tuple(a - length * b for a, b in zip(point.z, dz, strict=True))
    return LinearPoint(point.y + length * dy, u, z)


def linear_newton_step(program: LinearConeProgram, point: LinearPoint) -> tuple[LinearPoint, LinearStep]:
    """One predictor-corrector step from a strictly interior point."""
    residual = _residual(program, point.u)
    scaling = nesterov_todd(point.u, point.z)
    lam = _scale(scaling, point.z)
    C = _scale(scaling, program.columns)
    factor = cholesky(gram(C), pivot_tolerance(program.exists.dtype))

    # Predictor: target 0, so h = -lambda, and r - C h = b.
    q = _dual_direction(C, cholesky_solve(factor, program.rhs))
    ratio, target = _centering(program.exists, lam, q, _predictor_length(scaling, lam, q))

    # Corrector: target sigma mu, less the predictor's second-order error.
    head, inverse = _solved_head(scaling, lam, q, target)
    h = _centring_direction(program.exists, lam, q, head, inverse)
    dy = cholesky_solve(factor, _corrector_rhs(residual, C, h))
    q = _dual_direction(C, dy)
    p = _difference(h, q)

    length = _step_length(scaling, lam, p, q, ratio)
    moved = _moved(point, program.columns, scaling, dy, p, length)
    return moved, LinearStep(vector_norm(residual), ratio * ratio * ratio, length)
