"""The primal-dual interior-point method for a ``LinearConeProgram``, one tile of lanes at a time.

Each Newton step follows the central path ``u o z = mu e`` of the barrier problem

    minimise  <c, u> - mu sum_i log det u_i   subject to  B u = b

A lane that has finished is frozen whole; a step that would lose the interior or the best gap is not taken, so every
lane keeps its best point.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from ..backend import stage
from ..core import Array, Status, first_of
from .cone import cone_all, cone_sum, determinant, inner
from .linear_cone_program import LinearConeProgram
from .linear_newton_step import LinearPoint, LinearStep, linear_newton_step
from .stopping import StallRule, first_code, iterate_until_stopped

__all__ = [
    "LinearState",
    "advance_linear_cone_program",
    "begin_linear_cone_program",
    "solve_linear_cone_program",
]

STALL = StallRule(patience=3)


class LinearState(NamedTuple):
    """A tile between iterations."""

    point: LinearPoint
    gap: Array  # <u, z>
    iterations: Array
    stalled: Array  # consecutive slow steps
    stop: Array  # Status, int32


Decision = Callable[[LinearConeProgram, LinearPoint], Array]


@stage
def _gap(exists: Array, point: LinearPoint) -> tuple[Array, Array]:
    """``<u, z>`` and whether the point is strictly interior."""
    gap = cone_sum(exists * inner(point.u, point.z))
    inside = jnp.isfinite(gap)
    for x in (point.u, point.z):
        inside = inside & cone_all(determinant(x) > 0)
    return gap, inside


def begin_linear_cone_program(program: LinearConeProgram, point: LinearPoint, skip: Array) -> LinearState:
    """The state before the first step; lanes in ``skip`` never run."""
    gap, _ = _gap(program.exists, point)
    zero = jnp.zeros(gap.shape, jnp.int32)
    return LinearState(point, gap, zero, zero, first_code(skip))


def advance_linear_cone_program(
    program: LinearConeProgram, state: LinearState, tolerance: Array, decided: Decision | None = None
) -> tuple[LinearState, LinearStep]:
    """One iteration of every lane that is still running: take the steps that improve, say why the others stop."""
    moved, step = linear_newton_step(program, state.point)
    gap, inside = _gap(program.exists, moved)
    running = state.stop == Status.RUNNING.value
    taken = running & inside & (gap < state.gap)
    point = jax.tree.map(lambda new, old: jnp.where(taken, new, old), moved, state.point)
    stalled = STALL.count(taken & STALL.slow(gap, state.gap), state.stalled)
    goal = tolerance * jnp.maximum(jnp.ones_like(gap), jnp.abs(program.dual_value(point.y)))
    table = [
        (taken & (gap <= goal), Status.CONVERGED),
        *([] if decided is None else [(taken & decided(program, point), Status.DECIDED)]),
        (~inside, Status.BREAKDOWN),
        (~taken | STALL.broken(stalled), Status.STALLED),
    ]
    after = LinearState(
        point,
        jnp.where(taken, gap, state.gap),
        jnp.where(running, state.iterations + 1, state.iterations),
        stalled,
        jnp.where(running, first_of(table, Status.RUNNING), state.stop),
    )
    return after, step


def solve_linear_cone_program(
    program: LinearConeProgram,
    state: LinearState,
    tolerance: Array,
    budget: Array,
    decided: Decision | None = None,
) -> LinearState:
    """Iterate until every lane has stopped or ``budget`` more steps are spent.

    tolerance  gap to reach, relative to max(1, |optimal value|)
    decided    optional question ``(program, point) -> (L,) bool``: the lane stops as soon as it is answered
    """
    return iterate_until_stopped(
        lambda state: advance_linear_cone_program(program, state, tolerance, decided)[0], state, budget
    )
