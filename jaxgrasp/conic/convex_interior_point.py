"""The primal-dual interior-point method for a ``ConvexProgram``, one tile of lanes at a time.

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
from jax import lax

from ..backend import stage
from ..core import Array, Status
from .cone import cone_max, cone_min, cone_sum, inner, interior_distance
from .convex_newton import measure, newton_step
from .convex_program import ConvexProgram, Point

__all__ = ["Answered", "State", "begin_convex_program", "solve_convex_program"]

STALL_RATIO = 0.9  # a step that leaves more of the gap than this is slow
PATIENCE = 4  # slow steps in a row before a lane gives up
CENTRED = 1e3  # tails of u o z, in products, that still leave forces right to 1e-7 at a gap of 1e-8
ALMOST = 1e-6  # slow steps count only once |b - B u| is below this: before, growth of y is progress


class State(NamedTuple):
    """A tile between iterations.

    excess         (L,) sum of |product - floor|: the duality gap once B u = b
    infeasibility  (L,) |b - B u| plus what caps and bounds lack
    centred        (L,) bool: u_i and z_i are aligned; <u, z> = mu alone leaves the direction of u open to sqrt(mu)
    ray            (m + q, L) the multipliers that answered, where the lane stopped DECIDED
    """

    point: Point
    excess: Array
    infeasibility: Array
    centred: Array
    ray: Array
    iterations: Array
    stalled: Array
    stop: Array


Answered = Callable[[ConvexProgram, Array], Array]  # (program, rows) -> (L,) bool: rows prove infeasibility


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
def _centred(program: ConvexProgram, point: Point) -> Array:
    """Whether ``|u_0 z_t + z_0 u_t|`` is small next to ``<u, z>`` in every cone (L,)."""
    u, z = point.u, point.z
    square = jnp.zeros_like(u[0])
    for a, b in zip(u[1:], z[1:], strict=True):
        tail = u[0] * b + z[0] * a
        square = square + tail * tail
    most = jnp.asarray(CENTRED, square.dtype) * inner(u, z)
    return cone_max(program.exists * (square - most * most)) <= 0


@stage
def _select(taken: Array, new: Point, old: Point) -> Point:
    return jax.tree.map(lambda a, b: jnp.where(taken, a, b), new, old)


@stage
def _closed(goal: Array, excess: Array, infeasibility: Array) -> Array:
    """Whether the gap is small enough, and what is left is to meet the constraints to rounding."""
    return (excess <= goal) & (infeasibility <= ALMOST)


@stage
def _goal(program: ConvexProgram, point: Point, tolerance: Array) -> Array:
    """The gap to reach (L,)."""
    return tolerance * program.size(point)


@stage
def _judged(
    state: State, point: Point, excess: Array, infeasibility: Array, centred: Array, primal: Array,
    dual: Array, close: Array, was_close: Array, proven: Array, by_step: Array, rows: Array, change: Array,
    largest: Array, fine: float,
) -> State:  # fmt: skip
    """Take the step in the lanes where it is sound; say why the others stop."""
    running = state.stop == Status.RUNNING.value
    slow = (excess > STALL_RATIO * state.excess) & (infeasibility > STALL_RATIO * state.infeasibility)
    slow = slow & (infeasibility < ALMOST) & running
    stalled = jnp.where(slow, state.stalled + 1, jnp.zeros_like(state.stalled))
    met = infeasibility <= jnp.maximum(0.1 * primal, fine * (1 + largest))
    sound = (primal > 0) & (dual > 0)

    def code(stop: Status, where: Array, otherwise: Array) -> Array:
        return jnp.where(where, jnp.int32(stop.value), otherwise)

    stop = code(Status.STALLED, stalled >= PATIENCE, jnp.zeros_like(state.stop))
    stop = code(Status.BREAKDOWN, ~sound, stop)
    stop = code(Status.DECIDED, (proven | by_step) & ~was_close, stop)
    stop = code(Status.CONVERGED, sound & close & met & centred, stop)
    ray = jnp.where(running & by_step, change, jnp.where(running, rows, state.ray))
    iterations = jnp.where(running, state.iterations + 1, state.iterations)
    stop = jnp.where(running, stop, state.stop)
    return State(point, excess, infeasibility, centred, ray, iterations, stalled, stop)


def advance(program: ConvexProgram, state: State, tolerance: Array, proves: Answered, fine: float) -> State:
    """One iteration of every running lane."""
    goal = _goal(program, state.point, tolerance)
    was_close = _closed(goal, state.excess, state.infeasibility)
    moved, step = newton_step(
        program, state.point, state.excess, state.infeasibility, goal, was_close, state.centred
    )
    primal, dual, largest = _room(program, moved)
    point = _select(_running_and(state.stop, primal, dual), moved, state.point)
    excess, _ = measure(program, point.u, point.z, point.slack, point.price)
    infeasibility = _infeasibility(program, point)
    close = _closed(_goal(program, point, tolerance), excess, infeasibility)
    rows, centred = _rows(point), _centred(program, point)
    return _judged(
        state, point, excess, infeasibility, centred, primal, dual, close, was_close, proves(program, rows),
        proves(program, step.rows), rows, step.rows, largest, fine,
    )  # fmt: skip


@stage
def _running_and(stop: Array, primal: Array, dual: Array) -> Array:
    return (stop == Status.RUNNING.value) & (primal > 0) & (dual > 0)


@stage
def _rows(point: Point) -> Array:
    return point.rows()


def begin_convex_program(program: ConvexProgram, point: Point, skip: Array) -> State:
    """The state before the first step; lanes in ``skip`` never run."""
    excess, _ = measure(program, point.u, point.z, point.slack, point.price)
    zero = jnp.zeros(excess.shape, jnp.int32)
    code = jnp.where(skip, jnp.int32(Status.SKIPPED.value), jnp.int32(Status.RUNNING.value))
    infeasibility, centred = _infeasibility(program, point), jnp.zeros_like(skip)
    return State(point, excess, infeasibility, centred, _rows(point), zero, zero, code)


def solve_convex_program(
    program: ConvexProgram, state: State, tolerance: Array, proves: Answered, budget: Array, fine: float
) -> State:
    """Iterate until every lane has stopped or ``budget`` more steps are spent.

    tolerance  of the duality gap, relative to the objective
    proves     ``(program, rows) -> (L,) bool``: multipliers that prove the constraints contradictory
    fine       |b - B u| that is rounding
    """

    def unfinished(carry: tuple[Array, State]) -> Array:
        count, state = carry
        return (count < budget) & jnp.any(state.stop == Status.RUNNING.value)

    def body(carry: tuple[Array, State]) -> tuple[Array, State]:
        count, state = carry
        return count + 1, advance(program, state, tolerance, proves, fine)

    return lax.while_loop(unfinished, body, (jnp.int32(0), state))[1]
