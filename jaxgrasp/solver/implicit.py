"""Derivatives of solutions by the implicit function theorem, from the optimality conditions of a ``ConvexProgram``.

A point on the central path solves, with its own products held fixed,

    z = gradient(u, y, prices),  B u = b,  slack = limit - value,  u_i o z_i = (phi_i + mu_i) e,  slack price = floor.

A change of the data leaves residuals in these equations; one solve with the Newton matrix removes them. At the end of
the iteration mu is rounding-small and the derivative is that of the solution where strict complementarity holds, and
the limit of the central path's derivatives, one finite choice among several, where it does not. Values need no solve:
their derivative is that of the Lagrangian with the point fixed (envelope theorem).

Plain JAX of any layout, linear in the tangents: it nests, batches and transposes. Source: Fiacco 1983, theorem 3.2.2.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from .._types import Array, pivot_tolerance, unit_roundoff, widest_scaling
from ..cones import Cone, cone_sum, inner
from .blocks import Frame, tail_basis, unit_direction
from .convex import Bounds, ConvexProgram, Optional, Point
from .kkt import KKT, factor

__all__ = ["Residuals", "lagrangian", "point_tangent", "residuals"]

REFINEMENTS = 2


class Residuals(NamedTuple):
    """What the data leave to the point: zero at a solution."""

    gradient: Cone  # stationarity - z
    equations: Array  # b - B u
    missing: Bounds  # limit - value - slack
    cone_floor: Optional
    floors: Bounds


def residuals(program: ConvexProgram, point: Point) -> Residuals:
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


def lagrangian(program: ConvexProgram, point: Point) -> Array:
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
    for i in range(program.rhs.shape[0]):
        total = total + point.y[i] * (applied[i] - program.rhs[i])
    if program.cap is not None:
        mask = program.masks().cap
        limit = jnp.where(mask > 0, program.cap, jnp.zeros_like(program.cap))
        total = total + cone_sum(mask * point.price.cap * (u[0] - limit))
    if program.bound is not None and product is not None:
        total = total + cone_sum(point.price.upper * (product - program.bound))
        total = total - cone_sum(point.price.lower * (product + program.bound))
    if program.cone_floor is not None and program.head_floor is not None:
        one = jnp.ones_like(exists)
        det = jnp.where(exists > 0, (u[0] - _tail_size(u)) * (u[0] + _tail_size(u)), one)
        head = jnp.where(exists > 0, u[0], one)
        logs = program.cone_floor / 2 * jnp.log(det) + program.head_floor * jnp.log(head)
        total = total - cone_sum(exists * logs)
    return total


def _tail_size(x: Cone) -> Array:
    if len(x) == 1:
        return jnp.zeros_like(x[0])
    return unit_direction(x[1:])[1]


def _products(program: ConvexProgram, point: Point) -> Array:
    """<u_i, z_i>: fixed but for the floors in it."""
    product, floor = inner(point.u, point.z), program.cone_target()
    base = lax.stop_gradient(product) if floor is None else floor + lax.stop_gradient(product - floor)
    least = unit_roundoff(product.dtype) * lax.stop_gradient(point.u[0] * point.z[0])
    return jnp.where(program.exists > 0, jnp.maximum(base, least), jnp.ones_like(base))


def central_frame(program: ConvexProgram, point: Point) -> Frame:
    """The scaling of a central point, each eigenvalue from numbers that did not cancel."""
    u, z = point.u, point.z
    product = _products(program, point)
    if len(u) == 1:
        return Frame((), u[0] / jnp.sqrt(product), None, None)
    root = jnp.sqrt(product)
    pull = tuple(a / u[0] - b / z[0] for a, b in zip(u[1:], z[1:], strict=True))
    direction, _ = unit_direction(pull)
    along = (u[0] + _tail_size(u)) / root
    against = root / (z[0] + _tail_size(z))
    across = jnp.sqrt(u[0] / z[0]) if len(u) > 2 else None
    return Frame(tail_basis(direction), along, against, across)


class _System(NamedTuple):
    """One factored Newton system, and the equations it solves approximately."""

    program: ConvexProgram
    masks: Bounds
    rates: Bounds
    frame: Frame  # as the factorisation uses it: no eigenvalue beyond ``widest_scaling``
    stiffness: Cone  # the true z / u in frame coordinates
    kkt: KKT


def _families(function: Callable, *parts: Bounds) -> Bounds:
    return Bounds(*(None if p[0] is None else function(*p) for p in zip(*parts, strict=True)))


def _system(program: ConvexProgram, point: Point) -> _System:
    masks, frame = program.masks(), central_frame(program, point)
    rates = _families(lambda m, s, p: m * p / s, masks, point.slack, point.price)
    eigenvalues = [w for w in (frame.along, frame.against, frame.across) if w is not None]
    stiffness = [1 / (w * w) for w in eigenvalues]
    stiffness = (
        (*stiffness[:2], *(stiffness[2:] * (len(point.u) - 2))) if len(point.u) > 1 else (stiffness[0],)
    )
    limit = jnp.asarray(widest_scaling(program.exists.dtype) ** 0.5, program.exists.dtype)
    cut = [None if w is None else jnp.minimum(w, limit) for w in (frame.along, frame.against, frame.across)]
    assert cut[0] is not None
    frame = Frame(frame.basis, cut[0], cut[1], cut[2])
    # Rows closer to dependent than this make derivatives of rounding: a degenerate optimum gets one finite choice.
    dependent = pivot_tolerance(program.exists.dtype) ** 0.5
    return _System(program, masks, rates, frame, stiffness, factor(program, frame, rates, dependent))


class _Sources(NamedTuple):
    """Right-hand sides: of the cones (frame coordinates), the scalar inequalities, the rows, the level."""

    cone: Cone
    gains: Bounds
    missing: Bounds
    equations: Array
    level: Optional


def _respond(system: _System, sources: _Sources) -> Point:
    """The change of everything but z."""
    program, rates, masks, frame = system.program, system.rates, system.masks, system.frame
    exists, m = program.exists, program.rhs.shape[0]
    pushed = _families(lambda g, r, x: g - r * x, sources.gains, rates, sources.missing)
    rows = sources.equations
    if pushed.upper is not None and pushed.lower is not None:
        rows = jnp.concatenate([rows, (pushed.lower - pushed.upper) / (rates.upper + rates.lower)])
    net = pushed.net()
    head = exists * net if isinstance(net, Array) else jnp.zeros_like(exists)
    solution = system.kkt.solve(frame.scale(sources.cone), head, sources.level, rows)
    du = tuple(exists * x for x in frame.from_frame(frame.scale(solution.p)))
    slack = sources.missing
    if slack.level is not None:
        slack = slack._replace(level=masks.level * (solution.xi - du[0]))
    if slack.cap is not None:
        slack = slack._replace(cap=slack.cap - masks.cap * du[0])
    if slack.head is not None:
        slack = slack._replace(head=du[0])
    if slack.upper is not None:
        _, product = program.products(du)
        slack = slack._replace(upper=slack.upper - product, lower=slack.lower + product)
    price = _families(lambda g, r, s: g - r * s, sources.gains, rates, slack)
    return Point(solution.rows[:m], solution.xi, du, du, slack, price)


def point_tangent(program: ConvexProgram, point: Point, change: Residuals) -> Point:
    """The change of the point that cancels ``change``, the change of its residuals."""
    system = _system(program, point)
    exists, frame = program.exists, system.frame
    lift: Cone = tuple(jnp.zeros_like(exists) for _ in point.u)
    if change.cone_floor is not None:
        # u o z = floor e moves z by floor' u^-1, which is z / <u, z> on the central path.
        share = exists * change.cone_floor / _products(program, point)
        lift = frame.to_frame(tuple(share * x for x in point.z))

    gains = _families(lambda m, f, s: m * f / s, system.masks, change.floors, point.slack)
    none = _families(jnp.zeros_like, gains)
    level = None if gains.level is None else cone_sum(gains.level)
    start = tuple(a - b for a, b in zip(lift, frame.to_frame(change.gradient), strict=True))
    total = _respond(system, _Sources(start, gains, change.missing, change.equations, level))
    for _ in range(REFINEMENTS):
        dz = _dual_change(program, total, change)
        along = frame.to_frame(total.u)
        error = tuple(
            exists * (f - a - h * b)
            for f, a, h, b in zip(lift, frame.to_frame(dz), system.stiffness, along, strict=True)
        )
        equations = change.equations - program.products(total.u)[0]
        level = None if total.price.level is None else cone_sum(total.price.level)
        more = _respond(system, _Sources(error, none, none, equations, level))
        total = jax.tree.map(jnp.add, total, more)
    return total._replace(z=_dual_change(program, total, change))


def _dual_change(program: ConvexProgram, moved: Point, change: Residuals) -> Cone:
    """dz by stationarity."""
    dz = program.gradient(moved.u, moved.rows(), moved.price.net())
    return tuple(program.exists * (a + b) for a, b in zip(dz, change.gradient, strict=True))
