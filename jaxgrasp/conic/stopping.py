"""When a lane of an interior-point method stops: the reasons, the stall rule, and the loop that asks for both."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import jax.numpy as jnp

from ..backend import while_loop
from ..core import Array, Status

__all__ = ["StallRule", "first_code", "iterate_until_stopped"]

State = TypeVar("State", bound=Any)  # a named pytree with an entry ``stop`` (L,)


class StallRule(NamedTuple):
    """A lane gives up after ``patience`` slow steps in a row; a slow step leaves more than ``ratio`` of a measure."""

    patience: int
    ratio: float = 0.9

    def slow(self, after: Array, before: Array) -> Array:
        """Whether the step from ``before`` to ``after`` (L,) was slow."""
        return after > self.ratio * before

    def count(self, slow: Array, stalled: Array) -> Array:
        """Slow steps in a row (L,) int32."""
        return jnp.where(slow, stalled + 1, jnp.zeros_like(stalled))

    def broken(self, stalled: Array) -> Array:
        """Whether the lanes have been slow for too long."""
        return stalled >= self.patience


def first_code(skip: Array) -> Array:
    """``Status`` before the first step: SKIPPED in the lanes of ``skip``, RUNNING elsewhere."""
    return jnp.where(skip, jnp.int32(Status.SKIPPED.value), jnp.int32(Status.RUNNING.value))


def iterate_until_stopped(advance: Callable[[State], State], state: State, budget: Array) -> State:
    """``advance`` until no lane is RUNNING or ``budget`` steps are spent."""

    def unfinished(carry: tuple[Array, State]) -> Array:
        count, state = carry
        return (count < budget) & jnp.any(state.stop == Status.RUNNING.value)

    def body(carry: tuple[Array, State]) -> tuple[Array, State]:
        count, state = carry
        return count + 1, advance(state)

    return while_loop(unfinished, body, (jnp.int32(0), state), budget)[1]
