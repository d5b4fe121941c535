"""One primal-dual Newton step of a ``ConvexProgram``: Mehrotra's predictor and corrector in Nesterov-Todd scaling.

All changes follow from p = W^-1 du, the level's dxi and the rows' dr that ``kkt`` solves for. Near the solution prices
over slacks grow like 1 / gap, so a price's change must not be read off a slack's; ``_completed`` says what is done.

Sources: Nesterov, Todd 1997; Mehrotra 1992; Vandenberghe 2010.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from ..backend import stage
from ..core import Array
from .arrow_blocks import Frame, frame_of
from .cone import Cone, cone_max, cone_sum, determinant, inner, scaled_product, tail_inner
from .convex_program import Bounds, ConvexProgram, Optional, Point
from .kkt import Direction, factor
from .scaling import cone_reach, in_frame, nesterov_todd, rejoined

__all__ = ["Step", "measure", "newton_step"]

LONGEST_FRACTION, SHORTEST_FRACTION = 0.999, 0.9  # of the way to the boundary
AIM = 0.5  # of the gap to reach: no step aims lower, because a nearer central point is reached by a full step
SMALL_RESIDUAL = 0.1  # of a product: the step that removes it then leaves the products as they are


class Step(NamedTuple):
    """A Newton direction; p and q are the scaled changes of u and z, their tails in the frame's basis."""

    p: Cone
    q: Cone
    u: Cone
    z: Cone
    xi: Optional
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


def _map(function: Callable, *bounds: Bounds) -> Bounds:
    """``function`` on the families that exist."""
    return Bounds(*(None if parts[0] is None else function(*parts) for parts in zip(*bounds, strict=True)))


@stage
def _local(program: ConvexProgram, point: Point) -> Local:
    masks, floors = program.masks(), program.floors()
    applied, product = program.products(point.u)
    rates = _map(lambda m, s, p: m * p / s, masks, point.slack, point.price)
    missing = program.bound_residuals(point.u, product, point.slack)
    return Local(masks, floors, rates, missing, program.rhs - applied)


@stage
def _frame(w: Cone, eta: Array, z: Cone) -> tuple[Frame, Cone]:
    """The frame of the scaling, and lambda = W z in rotated coordinates."""
    frame = frame_of(w, eta)
    return frame, rejoined(frame.scale(frame.to_frame(z)))


@stage
def measure(program: ConvexProgram, u: Cone, z: Cone, slack: Bounds, price: Bounds) -> tuple[Array, Array]:
    """Sum of ``|product - floor|`` over all inequalities, and their number."""
    product = inner(u, z)
    floor = program.cone_target()
    if floor is not None:
        product = jnp.abs(product - floor)
    total, count = cone_sum(program.exists * product), cone_sum(program.exists)
    for mask, least, a, b in zip(program.masks(), program.floors(), slack, price, strict=True):
        if mask is not None:
            total = total + cone_sum(mask * jnp.abs(a * b - least))
            count = count + cone_sum(mask)
    return total, count


@stage
def _aims(
    program: ConvexProgram, local: Local, mu: Array, weight: Array, affine: Step | None
) -> tuple[Cone, Bounds]:
    """Targets of the products: floor + mu, less ``weight`` times the predictor's second-order error."""
    zero = jnp.zeros_like(program.exists)
    floor = program.cone_target()
    first = zero + mu if floor is None else floor + mu
    cone: Cone = (first, *(zero for _ in program.columns[1:]))
    scalar = _map(lambda floor: floor + mu, local.floors)
    if affine is not None:
        error = scaled_product(affine.p, affine.q)
        cone = tuple(a - weight * b for a, b in zip(cone, error, strict=True))
        scalar = _map(lambda a, s, p: a - weight * s * p, scalar, affine.slack, affine.price)
    return cone, scalar


@stage
def _right_hand_side(
    program: ConvexProgram,
    point: Point,
    local: Local,
    lam: Cone,
    cone: Cone,
    scalar: Bounds,
    share: Array,
    drive: Array,
) -> tuple[Cone, Bounds, Array, Optional, Array]:
    """h, the gains ``target / slack - price``, and the head, level and rows of the Newton system."""
    exists = program.exists
    head = (lam[0] * cone[0] - tail_inner(lam, cone)) / determinant(lam)
    solved = (head, *((c - a * head) / lam[0] for a, c in zip(lam[1:], cone[1:], strict=True)))
    h = tuple(drive * exists * (a - b) for a, b in zip(solved, lam, strict=True))
    gains = _map(lambda m, t, s, p: drive * m * (t / s - p), local.masks, scalar, point.slack, point.price)
    pushed = _map(lambda g, r, x: g - share * r * x, gains, local.rates, local.missing)
    level = None if gains.level is None else cone_sum(gains.level)
    rows = share * local.residual
    if pushed.upper is not None and pushed.lower is not None and local.rates.upper is not None:
        rows = jnp.concatenate(
            [rows, (pushed.lower - pushed.upper) / (local.rates.upper + local.rates.lower)]
        )
    return h, gains, exists * pushed.net(), level, rows


@stage
def _completed(
    program: ConvexProgram,
    local: Local,
    frame: Frame,
    h: Cone,
    gains: Bounds,
    share: Array,
    solution: Direction,
) -> Step:
    """All other changes from p, dxi and dr; dz by stationarity, so that the dual stays feasible."""
    exists, rates, masks = program.exists, local.rates, local.masks
    p = rejoined(solution.p)
    q = tuple(a - b for a, b in zip(h, p, strict=True))
    du = frame.from_frame(frame.scale(solution.p))
    slack = _map(lambda x: share * x, local.missing)
    if slack.level is not None and masks.level is not None:
        slack = slack._replace(level=masks.level * (solution.xi - du[0]))
    if slack.cap is not None:
        slack = slack._replace(cap=slack.cap - masks.cap * du[0])
    if slack.head is not None:
        slack = slack._replace(head=du[0])
    if slack.upper is not None:
        _, change = program.products(du)
        slack = slack._replace(upper=slack.upper - change, lower=slack.lower + change)
    price = _map(lambda g, r, s: g - r * s, gains, rates, slack)
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
        error = (frame.head_of_unscaled(in_frame(q)) - dz[0]) / jnp.where(
            total > 0, total, jnp.ones_like(total)
        )
        error = exists * error
        if price.level is not None:
            price = price._replace(level=price.level + error * rates.level)
        if price.cap is not None:
            price = price._replace(cap=price.cap + error * rates.cap)
        if price.head is not None:
            price = price._replace(head=price.head - error * rates.head)
        dz = (dz[0] + error * total, *dz[1:])
    return Step(p, q, du, tuple(exists * x for x in dz), solution.xi, rows, slack, price)


@stage
def _reach(reach: Array, masks: Bounds, point: Point, step: Step) -> Array:
    """The largest rate over all inequalities; the step to the boundary is 1 / rate."""
    for mask, a, b, da, db in zip(masks, point.slack, point.price, step.slack, step.price, strict=True):
        if mask is not None:
            rate = jnp.maximum(-da / a, -db / b)
            reach = jnp.maximum(reach, cone_max(jnp.where(mask > 0, rate, jnp.zeros_like(rate))))
    return reach


@stage
def _moved(point: Point, step: Step, length: Array) -> Point:
    change = Point(step.rows[: point.y.shape[0]], step.xi, step.u, step.z, step.slack, step.price)
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
    ratio = jnp.where(closed, one, jnp.minimum(jnp.maximum(after / before, zero), one))
    lowest = jnp.minimum(jnp.asarray(AIM, goal.dtype) * goal / before, one)
    sigma = jnp.where(closed, one, jnp.maximum(ratio * ratio * ratio, lowest))
    mu = sigma * before / count
    drive = jnp.where(closed & centred & (infeasibility <= SMALL_RESIDUAL * mu), zero, one)
    fraction = jnp.maximum(
        jnp.minimum(1 - 0.3 * ratio, jnp.full_like(ratio, LONGEST_FRACTION)), SHORTEST_FRACTION
    )
    share, weight = jnp.where(closed, one, 1 - sigma), jnp.where(closed, zero, weight)
    return Aim(mu, share, drive, weight, fraction)


@stage
def _length(reach: Array, fraction: Array) -> Array:
    """At most 1: a full step removes the residuals for good."""
    return 1 / jnp.maximum(jnp.ones_like(reach), reach / fraction)


def newton_step(
    program: ConvexProgram, point: Point, excess: Array, infeasibility: Array, goal: Array, closed: Array,
    centred: Array,
) -> tuple[Point, Step]:  # fmt: skip
    """One predictor-corrector step. Lanes in ``closed`` keep the size of their products, centre, and mend residuals."""
    scaling = nesterov_todd(point.u, point.z)
    frame, lam = _frame(scaling.w, scaling.eta, point.z)
    local = _local(program, point)
    kkt = factor(program, frame, local.rates)

    def direction(
        mu: Array, share: Array, drive: Array, weight: Array, affine: Step | None
    ) -> tuple[Step, Array]:
        cone, scalar = _aims(program, local, mu, weight, affine)
        h, gains, head, level, rows = _right_hand_side(program, point, local, lam, cone, scalar, share, drive)
        solution = kkt.solve(in_frame(h), head, level, rows)
        step = _completed(program, local, frame, h, gains, share, solution)
        reach = cone_reach(program.exists, lam, step.p, step.q)
        return step, _reach(reach, local.masks, point, step)

    zero, one = jnp.zeros_like(excess), jnp.ones_like(excess)
    affine, reach = direction(zero, one, one, one, None)
    length = _length(reach, one)
    ahead = _moved(point, affine, length)
    after, count = measure(program, ahead.u, ahead.z, ahead.slack, ahead.price)
    # Far from a fixed barrier's floor the full second-order correction overshoots.
    weight = one if program.cone_floor is None and program.smoothing is None else length
    aim = _aim(excess, after, count, goal, closed, centred, infeasibility, weight)
    step, reach = direction(aim.mu, aim.share, aim.drive, aim.weight, affine)
    return _moved(point, step, _length(reach, aim.fraction)), step
