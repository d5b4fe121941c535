"""Where the solver begins on a force problem: least-norm forces pressed into their cones, and prices to match."""

from __future__ import annotations

import jax.numpy as jnp

from ..backend import stage
from ..conic import Bounds, Cone, ConvexConeProgram, ConvexPoint, cone_max, rmatvec, tail_norm
from ..core import Array
from .problem import ForceProblem

__all__ = ["starting_point"]


@stage
def _first_forces(program: ConvexConeProgram, basis: Cone, count: Array) -> tuple[Cone, Array]:
    """The least-norm forces, pressed into the cones: ``u = Q^T b + depth e``."""
    exists = program.exists
    least = rmatvec(basis, program.rhs)
    depth = 1 + cone_max(exists * jnp.maximum(tail_norm(least) - least[0], jnp.zeros_like(exists)))
    if program.cone_floor is not None and program.head_floor is not None:
        depth = jnp.maximum(depth, count * cone_max(program.cone_floor + program.head_floor))
    head = jnp.where(exists > 0, least[0] + depth, jnp.ones_like(exists))
    share = exists
    if program.curvature is not None:  # D u must be inside the cone, too
        steepest = program.curvature.tail
        if program.curvature.last is not None:
            steepest = jnp.maximum(steepest, program.curvature.last)
        share = exists / jnp.maximum(jnp.ones_like(exists), steepest / 2)
    return (head, *(share * x for x in least[1:])), depth


@stage
def _first_prices(program: ConvexConeProgram, u: Cone, depth: Array, count: Array) -> ConvexPoint:
    """Slacks and prices that make the first forces dual feasible with y = 0, all products about ``depth / k``."""
    exists, one = program.exists, jnp.ones_like(program.exists)
    masks = program.masks()
    share = one / count
    xi = level = level_price = cap = cap_price = head = head_price = None
    if program.level is not None:
        xi = cone_max(exists * u[0]) + depth
        level = jnp.where(exists > 0, xi - u[0], one)
        level_price = jnp.where(exists > 0, share, one)
    if program.cap is not None and masks.cap is not None:
        room = jnp.where(masks.cap > 0, program.cap, one) - u[0]
        cap = jnp.where(masks.cap > 0, jnp.maximum(room, depth / 2), one)
        cap_price = jnp.where(masks.cap > 0, share * depth / (4 * cap), one)
    if program.head_floor is not None:
        head = u[0]
        head_price = jnp.where(exists > 0, jnp.minimum(program.head_floor / u[0], share / 2), one)
        head_price = jnp.maximum(head_price, share / 100)
    upper = price = None
    if program.bound is not None:
        _, product = program.products(u)
        size = jnp.abs(product)
        upper = jnp.maximum(program.bound - size, 0.5 * jnp.maximum(program.bound, size))
        price = (depth / count) / upper
    slack = Bounds(level, cap, head, upper, upper)
    point = ConvexPoint(
        jnp.zeros_like(program.rhs), xi, u, u, slack, Bounds(level_price, cap_price, head_price, price, price)
    )
    z = program.stationarity(point)
    z = (jnp.where(exists > 0, z[0], one), *(exists * x for x in z[1:]))
    return point._replace(z=z)


def starting_point(problem: ForceProblem) -> ConvexPoint:
    """Dual feasible, inside every inequality; what ``B u = b`` and the limits lack is left to the solver."""
    count = problem.tile.folded.count
    u, depth = _first_forces(problem.program, problem.tile.projection.basis.columns, count)
    return _first_prices(problem.program, u, depth, count)
