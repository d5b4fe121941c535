"""Derivatives of solutions by the implicit function theorem, from the optimality conditions of a ``ConvexConeProgram``.

A point on the central path solves, with its own products held fixed,

    z = gradient(u, y, prices),  B u = b,  slack = limit - value,  u_i o z_i = (phi_i + mu_i) e,  slack price = floor.

A change of the data leaves residuals in these equations; one solve with the reduced KKT matrix N removes them. N is
symmetric, so the adjoint equation of reverse mode is the same solve, and ``lax.custom_linear_solve`` makes derivatives
of all orders of the two. At the end of the iteration mu is rounding-small: the derivative is that of the solution where
strict complementarity holds; where it does not, it is the limit of the central path's derivatives, one finite choice
among several. Values need no solve: their derivative is that of the Lagrangian with the point fixed
(envelope theorem). Source: Fiacco 1983, theorem 3.2.2.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from ..backend import stage
from ..core import Array
from .cone import Cone, cone_min, cone_sum, inner
from .convex_cone_program import Bounds, ConvexConeProgram, ConvexPoint, OptionalArray, map_bounds
from .jordan_frame import smooth_determinant, tail_size
from .products import vector_inner
from .reduced_kkt import KKTVector, ReducedKKT, central_products, kkt_product, reduced_kkt

__all__ = ["PointShift", "Residuals", "centring", "lagrangian", "point_tangent", "residuals"]


class Residuals(NamedTuple):
    """What the data leave to the point: zero at a solution."""

    gradient: Cone  # stationarity - z
    equations: Array  # b - B u
    missing: Bounds  # limit - value - slack
    cone_floor: OptionalArray
    floors: Bounds


def residuals(program: ConvexConeProgram, point: ConvexPoint) -> Residuals:
    """The optimality function of the data; differentiate it with the point fixed."""
    applied, product = program.products(point.u)
    gradient = tuple(a - b for a, b in zip(program.stationarity(point), point.z, strict=True))
    return Residuals(
        tuple(program.exists * g for g in gradient),
        program.rhs - applied,
        program.bound_residuals(point.u, product, point.slack),
        program.cone_target(),
        program.floors(),
    )


def lagrangian(program: ConvexConeProgram, point: ConvexPoint) -> Array:
    """``objective + y.(B u - b) - prices.slacks`` (L,), whose derivative in the data is that of the optimal value."""
    exists, u = program.exists, point.u
    applied, product = program.products(u)
    total = jnp.zeros_like(exists[0])
    if program.price is not None:
        total = total + cone_sum(program.price * u[0])
    if program.curvature is not None:
        total = total + cone_sum(exists * inner(u, program.curvature.apply(u))) / 2
    if program.level is not None:
        total = total + program.level * point.xi
    total = total + vector_inner(point.y, applied - program.rhs)
    if program.cap is not None:
        mask = program.masks().cap
        limit = jnp.where(mask > 0, program.cap, jnp.zeros_like(program.cap))
        total = total + cone_sum(mask * point.price.cap * (u[0] - limit))
    if program.bound is not None and product is not None:
        total = total + cone_sum(point.price.upper * (product - program.bound))
        total = total - cone_sum(point.price.lower * (product + program.bound))
    if program.cone_floor is not None and program.head_floor is not None:
        one = jnp.ones_like(exists)
        det = jnp.where(exists > 0, smooth_determinant(u), one)
        head = jnp.where(exists > 0, u[0], one)
        logs = program.cone_floor / 2 * jnp.log(det) + program.head_floor * jnp.log(head)
        total = total - cone_sum(exists * logs)
    return total


class PointShift(NamedTuple):
    """What is added to the multipliers, the cones and their duals of a point."""

    y: Array
    u: Cone
    z: Cone


def centring(
    program: ConvexConeProgram, point: ConvexPoint, solve: Callable[[KKTVector], KKTVector]
) -> PointShift:
    """One Newton step of a program of cones alone towards ``u_i o z_i = mu e``, mu the mean product.

    A gap of g leaves the point open to the root of g across the central path, and derivatives with it; on the path
    they are right to g. A step that leaves a cone is not taken. In stages, which nothing differentiates.
    """
    x = solve(KKTVector(_off_centre(program.exists, point.u, point.z), jnp.zeros_like(point.y), None, None))
    return _interior_shift(program, point, x)


@stage
def _off_centre(exists: Array, u: Cone, z: Cone) -> Cone:
    """``mu u^-1 - z``."""
    mean = cone_sum(exists * inner(u, z)) / cone_sum(exists)
    det = jnp.where(exists > 0, smooth_determinant(u), jnp.ones_like(exists))
    barrier = exists * mean / det
    return (
        barrier * u[0] - exists * z[0],
        *(-barrier * a - exists * b for a, b in zip(u[1:], z[1:], strict=True)),
    )


@stage
def _interior_shift(program: ConvexConeProgram, point: ConvexPoint, x: KKTVector) -> PointShift:
    exists = program.exists
    dz = program.gradient(x.u, x.y, jnp.zeros_like(exists[0]))
    du = tuple(exists * a for a in x.u)
    dz = tuple(exists * a for a in dz)
    good = jnp.isfinite(cone_sum(du[0] + dz[0]))
    for old, change in ((point.u, du), (point.z, dz)):
        v = tuple(a + b for a, b in zip(old, change, strict=True))
        good = good & (cone_min(jnp.where(exists > 0, v[0] - tail_size(v), jnp.ones_like(exists))) > 0)
    return jax.tree.map(lambda a: jnp.where(good, a, jnp.zeros_like(a)), PointShift(x.y, du, dz))


def point_tangent(
    program: ConvexConeProgram, point: ConvexPoint, change: Residuals, solve: Callable[[KKTVector], KKTVector]
) -> ConvexPoint:
    """The change of the point that cancels ``change``, the change of its residuals; ``solve`` inverts N."""
    kkt, masks, exists = reduced_kkt(program, point), program.masks(), program.exists
    rates = kkt.rates
    cone = tuple(-g for g in change.gradient)
    if change.cone_floor is not None:
        # u o z = floor e moves z by floor' u^-1, which is z / <u, z> on the central path.
        share = exists * change.cone_floor / central_products(program, point)
        cone = tuple(a + share * b for a, b in zip(cone, point.z, strict=True))
    gains = map_bounds(lambda m, f, s: m * f / s, masks, change.floors, point.slack)
    reduced = map_bounds(lambda g, r, x: g - r * x, gains, rates, change.missing)
    cone = (cone[0] - exists * reduced.net(), *cone[1:])
    level = beta = None
    if gains.level is not None:
        level = cone_sum(gains.level)
    if reduced.upper is not None and reduced.lower is not None:
        beta = (reduced.lower - reduced.upper) / (rates.upper + rates.lower)
    rhs = _tied(KKTVector(cone, change.equations, level, beta))
    x = lax.custom_linear_solve(partial(kkt_product, kkt), rhs, lambda _, b: solve(b), symmetric=True)
    return _with_eliminated(program, kkt, change, gains, x)


def _tied(rhs: KKTVector) -> KKTVector:
    """The same numbers, each a function of all: JAX transposes a solve only if no part of its rhs is a constant."""
    nothing = sum(0 * jnp.sum(x, axis=tuple(range(x.ndim - 1))) for x in jax.tree.leaves(rhs))
    return jax.tree.map(lambda x: x + nothing, rhs)


def _with_eliminated(
    program: ConvexConeProgram, kkt: ReducedKKT, change: Residuals, gains: Bounds, x: KKTVector
) -> ConvexPoint:
    """Slacks, prices and z from the rest."""
    masks, exists, du = program.masks(), program.exists, x.u
    slack = program.slack_changes(masks, change.missing, du, x.xi)
    price = map_bounds(lambda g, r, s: g - r * s, gains, kkt.rates, slack)
    if price.upper is not None and price.lower is not None:
        # ``r s`` carries the rounding of du times rates up to 1 / gap; beta does not: it says what it was.
        error = x.beta - (price.upper - price.lower)
        upper = price.upper + error * kkt.rates.upper / (kkt.rates.upper + kkt.rates.lower)
        price = price._replace(upper=upper, lower=upper - x.beta)
    moved = ConvexPoint(x.y, x.xi, du, du, slack, price)
    dz = program.gradient(du, moved.rows(), price.net())
    return moved._replace(z=tuple(exists * (a + b) for a, b in zip(dz, change.gradient, strict=True)))
