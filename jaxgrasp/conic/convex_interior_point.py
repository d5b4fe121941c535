"""The primal-dual interior-point method for a ``ConvexConeProgram``, one tile of lanes at a time.

Newton steps follow the central path ``u_i o z_i = (phi_i + mu) e``, ``slack price = floor + mu`` for mu to 0. The start
is dual feasible and one step length serves both sides, so every y bounds the optimum from below; ``B u = b`` is reached
on the way. Where it cannot be reached, y and its steps turn into a proof of that, which the caller recognises: no phase
one, and no embedding.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from ..backend import stage
from ..core import Array, Status, first_of, unit_roundoff
from .cone import cone_max, cone_min, cone_sum, inner, interior_distance
from .convex_cone_program import ConvexConeProgram, ConvexPoint
from .convex_newton_step import convex_newton_step, duality_excess
from .products import vector_norm
from .stopping import StallRule, first_code, iterate_until_stopped

__all__ = ["ConvexState", "begin_convex_cone_program", "solve_convex_cone_program"]

STALL = StallRule(patience=4)
CENTRED = 1e3  # tails of u o z, in products, that still leave forces right to 1e-7 at a gap of 1e-8
ALMOST = 1e-6  # slow steps count only once |b - B u| is below this, or below ..
ALMOST_ROUNDING = 80  # .. so many eps: before, growth of y is progress


class ConvexState(NamedTuple):
    """A tile between iterations.

    excess         (L,) sum of |product - floor|: the duality gap once B u = b
    infeasibility  (L,) |b - B u| plus what caps and bounds lack
    centred        (L,) bool: u_i and z_i are aligned; <u, z> = mu alone leaves the direction of u open to sqrt(mu)
    ray            (m + q, L) the multipliers that answered, where the lane stopped DECIDED
    """

    point: ConvexPoint
    excess: Array
    infeasibility: Array
    centred: Array
    ray: Array
    iterations: Array
    stalled: Array
    stop: Array


class Question(NamedTuple):
    """What is asked of a tile.

    tolerance  (L,) or a number: duality gap to reach, relative to the objective
    proves     ``(program, rows) -> (L,) bool``: multipliers that prove the constraints contradictory
    rounding   |b - B u| that is rounding
    """

    tolerance: Array
    proves: Callable[[ConvexConeProgram, Array], Array]
    rounding: float


class Measures(NamedTuple):
    """A point in numbers, (L,) each: ``close`` where gap and infeasibility are small enough to end at."""

    excess: Array
    infeasibility: Array
    centred: Array
    close: Array


class Interior(NamedTuple):
    """How far inside a point lies (L,): smallest primal and dual slack, largest u_0."""

    primal: Array
    dual: Array
    largest: Array


class Multipliers(NamedTuple):
    """The multipliers of a point and of the step to it (m + q, L), and whether they prove infeasibility (L,)."""

    rows: Array
    step: Array
    proven: Array
    proven_by_step: Array


@stage
def _infeasibility(program: ConvexConeProgram, point: ConvexPoint) -> Array:
    applied, product = program.products(point.u)
    total = vector_norm(program.rhs - applied)
    missing = program.bound_residuals(point.u, product, point.slack)
    if missing.cap is not None:  # beside a large cap even its rounding is large
        missing = missing._replace(
            cap=missing.cap / jnp.maximum(point.slack.cap, jnp.ones_like(point.slack.cap))
        )
    for lacking in missing:
        if lacking is not None:
            total = total + cone_sum(jnp.abs(lacking))
    return total


@stage
def _interior(program: ConvexConeProgram, point: ConvexPoint) -> Interior:

    def least(x: Array, mask: Array) -> Array:
        return cone_min(jnp.where(mask > 0, x, jnp.full_like(x, jnp.inf)))

    primal = least(interior_distance(point.u), program.exists)
    dual = least(interior_distance(point.z), program.exists)
    for mask, slack, price in zip(program.masks(), point.slack, point.price, strict=True):
        if mask is not None:
            primal = jnp.minimum(primal, least(slack, mask))
            dual = jnp.minimum(dual, least(price, mask))
    return Interior(primal, dual, cone_max(program.exists * jnp.abs(point.u[0])))


@stage
def _centred(program: ConvexConeProgram, point: ConvexPoint) -> Array:
    """Whether ``|u_0 z_t + z_0 u_t|`` is small next to ``<u, z>`` in every cone (L,)."""
    u, z = point.u, point.z
    square = jnp.zeros_like(u[0])
    for a, b in zip(u[1:], z[1:], strict=True):
        tail = u[0] * b + z[0] * a
        square = square + tail * tail
    most = jnp.asarray(CENTRED, square.dtype) * inner(u, z)
    return cone_max(program.exists * (square - most * most)) <= 0


@stage
def _select(taken: Array, new: ConvexPoint, old: ConvexPoint) -> ConvexPoint:
    return jax.tree.map(lambda a, b: jnp.where(taken, a, b), new, old)


def _almost(infeasibility: Array) -> Array:
    return infeasibility <= max(ALMOST, ALMOST_ROUNDING * unit_roundoff(infeasibility.dtype))


@stage
def _closed(goal: Array, excess: Array, infeasibility: Array) -> Array:
    """Whether the gap is small enough, and what is left is to meet the constraints to rounding."""
    return (excess <= goal) & _almost(infeasibility)


@stage
def _goal(program: ConvexConeProgram, point: ConvexPoint, tolerance: Array) -> Array:
    """The gap to reach (L,)."""
    return tolerance * program.size(point)


@stage
def _running_and(stop: Array, primal: Array, dual: Array) -> Array:
    return (stop == Status.RUNNING.value) & (primal > 0) & (dual > 0)


@stage
def _rows(point: ConvexPoint) -> Array:
    return point.rows()


def _multipliers(
    program: ConvexConeProgram, point: ConvexPoint, step: Array, question: Question
) -> Multipliers:
    rows = _rows(point)
    return Multipliers(rows, step, question.proves(program, rows), question.proves(program, step))


@stage
def _next_state(
    state: ConvexState, point: ConvexPoint, now: Measures, was_close: Array, interior: Interior,
    multipliers: Multipliers, rounding: float,
) -> ConvexState:  # fmt: skip
    """The state after a step; why the lanes that stop here do so."""
    running = state.stop == Status.RUNNING.value
    slow = STALL.slow(now.excess, state.excess) & STALL.slow(now.infeasibility, state.infeasibility)
    slow = slow & _almost(now.infeasibility) & running
    stalled = STALL.count(slow, state.stalled)
    met = now.infeasibility <= jnp.maximum(0.1 * interior.primal, rounding * (1 + interior.largest))
    sound = (interior.primal > 0) & (interior.dual > 0)
    proven, by_step = multipliers.proven, multipliers.proven_by_step
    stop = first_of(
        [
            (sound & now.close & met & now.centred, Status.CONVERGED),
            ((proven | by_step) & ~was_close, Status.DECIDED),
            (~sound, Status.BREAKDOWN),
            (STALL.broken(stalled), Status.STALLED),
        ],
        Status.RUNNING,
    )
    ray = jnp.where(running & by_step, multipliers.step, jnp.where(running, multipliers.rows, state.ray))
    iterations = jnp.where(running, state.iterations + 1, state.iterations)
    stop = jnp.where(running, stop, state.stop)
    return ConvexState(point, now.excess, now.infeasibility, now.centred, ray, iterations, stalled, stop)


def begin_convex_cone_program(program: ConvexConeProgram, point: ConvexPoint, skip: Array) -> ConvexState:
    """The state before the first step; lanes in ``skip`` never run."""
    excess, _ = duality_excess(program, point)
    zero = jnp.zeros(excess.shape, jnp.int32)
    infeasibility, centred = _infeasibility(program, point), jnp.zeros_like(skip)
    return ConvexState(point, excess, infeasibility, centred, _rows(point), zero, zero, first_code(skip))


def advance_convex_cone_program(
    program: ConvexConeProgram, state: ConvexState, question: Question
) -> ConvexState:
    """One iteration of every running lane: step, keep it where it is sound, measure, judge."""
    goal = _goal(program, state.point, question.tolerance)
    was_close = _closed(goal, state.excess, state.infeasibility)
    moved, step = convex_newton_step(
        program, state.point, state.excess, state.infeasibility, goal, was_close, state.centred
    )
    interior = _interior(program, moved)
    point = _select(_running_and(state.stop, interior.primal, interior.dual), moved, state.point)
    now = _measures(program, point, question.tolerance)
    multipliers = _multipliers(program, point, step.rows, question)
    return _next_state(state, point, now, was_close, interior, multipliers, question.rounding)


def _measures(program: ConvexConeProgram, point: ConvexPoint, tolerance: Array) -> Measures:
    excess, _ = duality_excess(program, point)
    infeasibility = _infeasibility(program, point)
    close = _closed(_goal(program, point, tolerance), excess, infeasibility)
    return Measures(excess, infeasibility, _centred(program, point), close)


def solve_convex_cone_program(
    program: ConvexConeProgram,
    state: ConvexState,
    tolerance: Array,
    proves: Callable[[ConvexConeProgram, Array], Array],
    budget: Array,
    rounding: float,
) -> ConvexState:
    """Iterate until every lane has stopped or ``budget`` more steps are spent; the rest as in ``Question``."""
    question = Question(tolerance, proves, rounding)
    return iterate_until_stopped(
        lambda state: advance_convex_cone_program(program, state, question), state, budget
    )
