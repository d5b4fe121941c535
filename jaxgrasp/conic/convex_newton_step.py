"""One primal-dual Newton step of a ``ConvexConeProgram``: Mehrotra's predictor and corrector, Nesterov-Todd scaling.

All changes follow from p = W^-1 du, the level's dxi and the rows' dr that ``scaled_kkt`` solves for. Near the solution
prices over slacks grow like 1 / gap, so a price's change must not be read off a slack's; ``_recovered`` says what is
done.

Sources: Nesterov, Todd 1997; Mehrotra 1992; Vandenberghe 2010.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from ..backend import stage
from ..core import Array
from .cone import Cone, cone_max, cone_sum, determinant, inner, jordan_product, tail_inner
from .convex_cone_program import Bounds, ConvexConeProgram, ConvexPoint, OptionalArray, map_bounds
from .jordan_frame import JordanFrame, jordan_frame, spectral, stored_spectral
from .mehrotra import boundary_fraction, clipped_ratio, step_length
from .nesterov_todd import largest_rate, nesterov_todd
from .scaled_kkt import ScaledDirection, ScaledSides, factor_scaled_kkt

__all__ = ["ConvexStep", "convex_newton_step", "duality_excess"]

AIM = 0.5  # of the gap to reach: no step aims lower, because a nearer central point is reached by a full step
SMALL_RESIDUAL = 0.1  # of a product: the step that removes it then leaves the products as they are


class ConvexStep(NamedTuple):
    """A Newton direction; p and q are the scaled changes of u and z, their tails in the frame's basis."""

    p: Cone
    q: Cone
    u: Cone
    z: Cone
    xi: OptionalArray
    rows: Array
    slack: Bounds
    price: Bounds


class Local(NamedTuple):
    """What both steps of an iteration share."""

    masks: Bounds
    floors: Bounds
    rates: Bounds
    missing: Bounds  # residuals of caps and bounds
    residual: Array  # b - B u


@stage
def _local(program: ConvexConeProgram, point: ConvexPoint) -> Local:
    masks, floors = program.masks(), program.floors()
    applied, product = program.products(point.u)
    rates = program.rates(masks, point)
    missing = program.bound_residuals(point.u, product, point.slack)
    return Local(masks, floors, rates, missing, program.rhs - applied)


@stage
def _frame(w: Cone, eta: Array, z: Cone) -> tuple[JordanFrame, Cone]:
    """The frame of the scaling, and lambda = W z in rotated coordinates."""
    frame = jordan_frame(w, eta)
    return frame, spectral(frame.scale(frame.to_frame(z)))


@stage
def duality_excess(program: ConvexConeProgram, point: ConvexPoint) -> tuple[Array, Array]:
    """Sum of ``|product - floor|`` over all inequalities, and their number."""
    product = inner(point.u, point.z)
    floor = program.cone_target()
    if floor is not None:
        product = jnp.abs(product - floor)
    total, count = cone_sum(program.exists * product), cone_sum(program.exists)
    for mask, least, a, b in zip(program.masks(), program.floors(), point.slack, point.price, strict=True):
        if mask is not None:
            total = total + cone_sum(mask * jnp.abs(a * b - least))
            count = count + cone_sum(mask)
    return total, count


@stage
def _targets(
    program: ConvexConeProgram, local: Local, mu: Array, weight: Array, affine: ConvexStep | None
) -> tuple[Cone, Bounds]:
    """Targets of the products: floor + mu, less ``weight`` times the predictor's second-order error."""
    zero = jnp.zeros_like(program.exists)
    floor = program.cone_target()
    first = zero + mu if floor is None else floor + mu
    cone: Cone = (first, *(zero for _ in program.columns[1:]))
    scalar = map_bounds(lambda floor: floor + mu, local.floors)
    if affine is not None:
        error = jordan_product(affine.p, affine.q)
        cone = tuple(a - weight * b for a, b in zip(cone, error, strict=True))
        scalar = map_bounds(lambda a, s, p: a - weight * s * p, scalar, affine.slack, affine.price)
    return cone, scalar


@stage
def _right_hand_side(
    program: ConvexConeProgram,
    point: ConvexPoint,
    local: Local,
    lam: Cone,
    cone: Cone,
    scalar: Bounds,
    share: Array,
    drive: Array,
) -> tuple[Cone, Bounds, Array, OptionalArray, Array]:
    """h, the gains ``target / slack - price``, and the head, level and rows of the Newton system."""
    exists = program.exists
    head = (lam[0] * cone[0] - tail_inner(lam, cone)) / determinant(lam)
    solved = (head, *((c - a * head) / lam[0] for a, c in zip(lam[1:], cone[1:], strict=True)))
    h = tuple(drive * exists * (a - b) for a, b in zip(solved, lam, strict=True))
    gains = map_bounds(
        lambda m, t, s, p: drive * m * (t / s - p), local.masks, scalar, point.slack, point.price
    )
    reduced = map_bounds(lambda g, r, x: g - share * r * x, gains, local.rates, local.missing)
    level = None if gains.level is None else cone_sum(gains.level)
    rows = share * local.residual
    if reduced.upper is not None and reduced.lower is not None and local.rates.upper is not None:
        rows = jnp.concatenate(
            [rows, (reduced.lower - reduced.upper) / (local.rates.upper + local.rates.lower)]
        )
    return h, gains, exists * reduced.net(), level, rows


@stage
def _recovered(
    program: ConvexConeProgram,
    local: Local,
    frame: JordanFrame,
    h: Cone,
    gains: Bounds,
    share: Array,
    solution: ScaledDirection,
) -> ConvexStep:
    """All other changes from p, dxi and dr; dz by stationarity, so that the dual stays feasible."""
    exists, rates, masks = program.exists, local.rates, local.masks
    p = spectral(solution.p)
    q = tuple(a - b for a, b in zip(h, p, strict=True))
    du = frame.from_frame(frame.scale(solution.p))
    slack = program.slack_changes(masks, map_bounds(lambda x: share * x, local.missing), du, solution.xi)
    price = map_bounds(lambda g, r, s: g - r * s, gains, rates, slack)
    rows = solution.rows
    # ``r * s`` carries the rounding of du times rates up to 1 / gap. dr and q do not: they say what it was.
    if price.upper is not None and price.lower is not None:
        beta = rows[local.residual.shape[0] :]
        share_upper = rates.upper / (rates.upper + rates.lower)
        error = beta - (price.upper - price.lower)
        upper = price.upper + error * share_upper
        price = price._replace(upper=upper, lower=upper - beta)
    dz = program.gradient(du, rows, price.net())
    total = rates.sum_on_head()
    if total is not None:
        # Where the rates are small, ``r * s`` has lost nothing, and a price as small would drown in rounding of dz.
        error = (frame.head_of_unscaled(stored_spectral(q)) - dz[0]) / jnp.maximum(
            total, jnp.ones_like(total)
        )
        error = exists * error
        if price.level is not None:
            price = price._replace(level=price.level + error * rates.level)
        if price.cap is not None:
            price = price._replace(cap=price.cap + error * rates.cap)
        if price.head is not None:
            price = price._replace(head=price.head - error * rates.head)
        dz = (dz[0] + error * total, *dz[1:])
    return ConvexStep(p, q, du, tuple(exists * x for x in dz), solution.xi, rows, slack, price)


@stage
def _largest_rate(largest: Array, masks: Bounds, point: ConvexPoint, step: ConvexStep) -> Array:
    """The largest rate over all inequalities, with that of the cones; the step to the boundary is 1 / rate."""
    for mask, a, b, da, db in zip(masks, point.slack, point.price, step.slack, step.price, strict=True):
        if mask is not None:
            rate = jnp.maximum(-da / a, -db / b)
            largest = jnp.maximum(largest, cone_max(jnp.where(mask > 0, rate, jnp.zeros_like(rate))))
    return largest


@stage
def _moved(point: ConvexPoint, step: ConvexStep, length: Array) -> ConvexPoint:
    change = ConvexPoint(step.rows[: point.y.shape[0]], step.xi, step.u, step.z, step.slack, step.price)
    return jax.tree.map(lambda x, dx: x + length * dx, point, change)


class Aim(NamedTuple):
    """Where the second step of an iteration goes, (L,) each: products of ``mu`` (kept as they are where ``drive`` is
    0), a ``share`` of the residuals removed, ``weight`` of the second-order correction, ``fraction`` of the way to the
    boundary."""

    mu: Array
    share: Array
    drive: Array
    weight: Array
    fraction: Array


@stage
def _aim(
    before: Array, after: Array, count: Array, goal: Array, closed: Array, centred: Array, infeasibility: Array,
    weight: Array,
) -> Aim:  # fmt: skip
    """Mehrotra's ``sigma = ratio^3``, but aiming no lower than ``AIM goal``. In ``closed`` lanes sigma = 1, until the
    point is centred and what is left of the residuals is small next to a product; then the residuals alone."""
    zero, one = jnp.zeros_like(after), jnp.ones_like(after)
    ratio = jnp.where(closed, one, clipped_ratio(after / before))
    lowest = jnp.minimum(jnp.asarray(AIM, goal.dtype) * goal / before, one)
    sigma = jnp.where(closed, one, jnp.maximum(ratio * ratio * ratio, lowest))
    mu = sigma * before / count
    drive = jnp.where(closed & centred & (infeasibility <= SMALL_RESIDUAL * mu), zero, one)
    share, weight = jnp.where(closed, one, 1 - sigma), jnp.where(closed, zero, weight)
    return Aim(mu, share, drive, weight, boundary_fraction(ratio))


_step_length = stage(step_length)


def convex_newton_step(
    program: ConvexConeProgram, point: ConvexPoint, excess: Array, infeasibility: Array, goal: Array,
    closed: Array, centred: Array,
) -> tuple[ConvexPoint, ConvexStep]:  # fmt: skip
    """One predictor-corrector step. Lanes in ``closed`` keep the size of their products, centre, and mend residuals."""
    scaling = nesterov_todd(point.u, point.z)
    frame, lam = _frame(scaling.w, scaling.eta, point.z)
    local = _local(program, point)
    kkt = factor_scaled_kkt(program, frame, local.rates)

    def direction(aim: Aim, affine: ConvexStep | None) -> tuple[ConvexStep, Array]:
        cone, scalar = _targets(program, local, aim.mu, aim.weight, affine)
        h, gains, head, level, rows = _right_hand_side(
            program, point, local, lam, cone, scalar, aim.share, aim.drive
        )
        solution = kkt.solve(ScaledSides(stored_spectral(h), head, level, rows))
        step = _recovered(program, local, frame, h, gains, aim.share, solution)
        return step, _largest_rate(
            largest_rate(program.exists, lam, step.p, step.q), local.masks, point, step
        )

    # Predictor: the affine step, mu = 0, all residuals.
    zero, one = jnp.zeros_like(excess), jnp.ones_like(excess)
    affine, rate = direction(Aim(zero, one, one, one, one), None)
    length = _step_length(rate, one)
    ahead = _moved(point, affine, length)
    after, count = duality_excess(program, ahead)

    # Corrector: mu = sigma mu, less the predictor's second-order error. Far from a fixed barrier's floor the full
    # correction overshoots.
    weight = one if program.cone_floor is None and program.smoothing is None else length
    aim = _aim(excess, after, count, goal, closed, centred, infeasibility, weight)
    step, rate = direction(aim, affine)
    return _moved(point, step, _step_length(rate, aim.fraction)), step
