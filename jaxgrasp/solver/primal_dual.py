"""The primal-dual interior-point method for a ``ConvexProgram``, one tile of lanes at a time.

Newton steps follow the central path ``u_i o z_i = (phi_i + mu) e``, ``slack price = floor + mu`` for mu to 0, with
Nesterov-Todd scaling and Mehrotra's predictor and corrector. The start is dual feasible and one step length serves both
sides, so every y bounds the optimum from below; ``B u = b`` is reached on the way. Where it cannot be reached, y and
its steps turn into a proof of that, which the caller recognises: no phase one, and no embedding.

Sources: Nesterov, Todd 1997; Mehrotra 1992; Vandenberghe 2010.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from .._types import Array
from ..cones import (
    Cone,
    cone_max,
    cone_min,
    cone_sum,
    determinant,
    inner,
    interior_distance,
    scaled_product,
    tail_inner,
)
from .blocks import Frame, frame_of
from .convex import Bounds, ConvexProgram, Optional, Point
from .interior_point import Stop, nesterov_todd
from .kkt import Direction, factor
from .stages import stage
from .steps import cone_reach, in_frame, reciprocal, rejoined

__all__ = ["Answered", "State", "begin", "solve"]

LONGEST_FRACTION, SHORTEST_FRACTION = 0.999, 0.9  # of the way to the boundary
STALL_RATIO = 0.9  # a step that leaves more of the gap than this is slow
PATIENCE = 4  # slow steps in a row before a lane gives up
ALMOST = 1e-6  # slow steps count only once |b - B u| is below this: before, growth of y is progress


class State(NamedTuple):
    """A tile between iterations.

    excess         (L,) sum of |product - floor|: the duality gap once B u = b
    infeasibility  (L,) |b - B u| plus what caps and bounds lack
    ray            (m + q, L) the multipliers that answered, where the lane stopped DECIDED
    """

    point: Point
    excess: Array
    infeasibility: Array
    ray: Array
    iterations: Array
    stalled: Array
    stop: Array


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


Answered = Callable[[ConvexProgram, Array], Array]  # (program, rows) -> (L,) bool: rows prove infeasibility


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
def _measure(program: ConvexProgram, u: Cone, z: Cone, slack: Bounds, price: Bounds) -> tuple[Array, Array]:
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
def _infeasibility(program: ConvexProgram, point: Point) -> Array:
    applied, product = program.products(point.u)
    residual = program.rhs - applied
    square = jnp.zeros_like(residual[0])
    for i in range(residual.shape[0]):
        square = square + residual[i] * residual[i]
    total = jnp.sqrt(square)
    for missing in program.bound_residuals(point.u, product, point.slack):
        if missing is not None:
            total = total + cone_sum(jnp.abs(missing))
    return total


@stage
def _room(program: ConvexProgram, point: Point) -> tuple[Array, Array, Array]:
    """Smallest primal and smallest dual slack, largest u_0 (L,)."""

    def least(x: Array, mask: Array) -> Array:
        return cone_min(jnp.where(mask > 0, x, jnp.full_like(x, jnp.inf)))

    primal = least(interior_distance(point.u), program.exists)
    dual = least(interior_distance(point.z), program.exists)
    for mask, slack, price in zip(program.masks(), point.slack, point.price, strict=True):
        if mask is not None:
            primal = jnp.minimum(primal, least(slack, mask))
            dual = jnp.minimum(dual, least(price, mask))
    return primal, dual, cone_max(program.exists * jnp.abs(point.u[0]))


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
    if price.upper is not None and price.lower is not None:
        rows = jnp.concatenate([rows[: local.residual.shape[0]], price.upper - price.lower])
    dz = program.gradient(du, rows, price.net())
    return Step(p, q, du, tuple(exists * x for x in dz), solution.xi, rows, slack, price)


@stage
def _reach(reach: Array, masks: Bounds, point: Point, step: Step) -> Array:
    """The largest rate over all inequalities; the step to the boundary is 1 / rate, and at most 1."""
    reach = jnp.maximum(reach, jnp.ones_like(reach))
    for mask, a, b, da, db in zip(masks, point.slack, point.price, step.slack, step.price, strict=True):
        if mask is not None:
            rate = jnp.maximum(-da / a, -db / b)
            reach = jnp.maximum(reach, cone_max(jnp.where(mask > 0, rate, jnp.zeros_like(rate))))
    return reach


@stage
def _moved(point: Point, step: Step, length: Array) -> Point:
    change = Point(step.rows[: point.y.shape[0]], step.xi, step.u, step.z, step.slack, step.price)
    return jax.tree.map(lambda x, dx: x + length * dx, point, change)


@stage
def _centring(before: Array, after: Array, count: Array, closed: Array) -> tuple[Array, Array, Array, Array]:
    """Mehrotra's ``sigma = ratio^3``; the target mu, the drive, the fraction of the way to the boundary."""
    ratio = jnp.minimum(jnp.maximum(after / before, jnp.zeros_like(after)), jnp.ones_like(after))
    sigma = ratio * ratio * ratio
    drive = jnp.where(closed, jnp.zeros_like(after), jnp.ones_like(after))
    fraction = jnp.maximum(
        jnp.minimum(1 - 0.3 * ratio, jnp.full_like(ratio, LONGEST_FRACTION)), SHORTEST_FRACTION
    )
    return sigma * before / count, 1 - drive * sigma, drive, fraction


@stage
def _length(reach: Array, fraction: Array) -> Array:
    return 1 / jnp.maximum(jnp.ones_like(reach), reach / fraction)


def newton_step(program: ConvexProgram, point: Point, excess: Array, closed: Array) -> tuple[Point, Step]:
    """One predictor-corrector step. Lanes in ``closed`` keep their products and only mend their residuals."""
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
    length = reciprocal(reach)
    ahead = _moved(point, affine, length)
    after, count = _measure(program, ahead.u, ahead.z, ahead.slack, ahead.price)
    mu, share, drive, fraction = _centring(excess, after, count, closed)
    # Far from a fixed barrier's floor the full second-order correction overshoots.
    weight = one if program.cone_floor is None and program.smoothing is None else length
    step, reach = direction(mu, share, drive, weight, affine)
    return _moved(point, step, _length(reach, fraction)), step


@stage
def _select(taken: Array, new: Point, old: Point) -> Point:
    return jax.tree.map(lambda a, b: jnp.where(taken, a, b), new, old)


@stage
def _closed(size: Array, excess: Array, infeasibility: Array, tolerance: Array) -> Array:
    return (excess <= tolerance * size) & (infeasibility <= ALMOST)


@stage
def _size(program: ConvexProgram, point: Point) -> Array:
    return program.size(point)


def closed(program: ConvexProgram, state: State, tolerance: Array) -> Array:
    """Whether the gap is small enough, and what is left is to meet the constraints to rounding."""
    return _closed(_size(program, state.point), state.excess, state.infeasibility, tolerance)


@stage
def _judged(
    state: State, point: Point, excess: Array, infeasibility: Array, primal: Array, dual: Array, close: Array,
    was_close: Array, proven: Array, by_step: Array, rows: Array, change: Array, largest: Array, fine: float,
) -> State:  # fmt: skip
    """Take the step in the lanes where it is sound; say why the others stop."""
    running = state.stop == Stop.RUNNING.value
    slow = (excess > STALL_RATIO * state.excess) & (infeasibility > STALL_RATIO * state.infeasibility)
    slow = slow & (infeasibility < ALMOST) & running
    stalled = jnp.where(slow, state.stalled + 1, jnp.zeros_like(state.stalled))
    met = infeasibility <= jnp.maximum(0.1 * primal, fine * (1 + largest))
    sound = (primal > 0) & (dual > 0)

    def code(stop: Stop, where: Array, otherwise: Array) -> Array:
        return jnp.where(where, jnp.int32(stop.value), otherwise)

    stop = code(Stop.STALLED, stalled >= PATIENCE, jnp.zeros_like(state.stop))
    stop = code(Stop.BREAKDOWN, ~sound, stop)
    stop = code(Stop.DECIDED, (proven | by_step) & ~was_close, stop)
    stop = code(Stop.CONVERGED, sound & close & met, stop)
    ray = jnp.where(running & by_step, change, jnp.where(running, rows, state.ray))
    iterations = jnp.where(running, state.iterations + 1, state.iterations)
    return State(point, excess, infeasibility, ray, iterations, stalled, jnp.where(running, stop, state.stop))


def advance(program: ConvexProgram, state: State, tolerance: Array, proves: Answered, fine: float) -> State:
    """One iteration of every running lane."""
    was_close = closed(program, state, tolerance)
    moved, step = newton_step(program, state.point, state.excess, was_close)
    primal, dual, largest = _room(program, moved)
    point = _select(_running_and(state.stop, primal, dual), moved, state.point)
    excess, _ = _measure(program, point.u, point.z, point.slack, point.price)
    infeasibility = _infeasibility(program, point)
    close = closed(
        program, state._replace(point=point, excess=excess, infeasibility=infeasibility), tolerance
    )
    rows = _rows(point)
    return _judged(
        state, point, excess, infeasibility, primal, dual, close, was_close, proves(program, rows),
        proves(program, step.rows), rows, step.rows, largest, fine,
    )  # fmt: skip


@stage
def _running_and(stop: Array, primal: Array, dual: Array) -> Array:
    return (stop == Stop.RUNNING.value) & (primal > 0) & (dual > 0)


@stage
def _rows(point: Point) -> Array:
    return point.rows()


def begin(program: ConvexProgram, point: Point, skip: Array) -> State:
    """The state before the first step; lanes in ``skip`` never run."""
    excess, _ = _measure(program, point.u, point.z, point.slack, point.price)
    zero = jnp.zeros(excess.shape, jnp.int32)
    code = jnp.where(skip, jnp.int32(Stop.SKIPPED.value), jnp.int32(Stop.RUNNING.value))
    return State(point, excess, _infeasibility(program, point), _rows(point), zero, zero, code)


def solve(
    program: ConvexProgram, state: State, tolerance: Array, proves: Answered, budget: Array, fine: float
) -> State:
    """Iterate until every lane has stopped or ``budget`` more steps are spent.

    tolerance  of the duality gap, relative to the objective
    proves     ``(program, rows) -> (L,) bool``: multipliers that prove the constraints contradictory
    fine       |b - B u| that is rounding
    """

    def unfinished(carry: tuple[Array, State]) -> Array:
        count, state = carry
        return (count < budget) & jnp.any(state.stop == Stop.RUNNING.value)

    def body(carry: tuple[Array, State]) -> tuple[Array, State]:
        count, state = carry
        return count + 1, advance(program, state, tolerance, proves, fine)

    return lax.while_loop(unfinished, body, (jnp.int32(0), state))[1]
