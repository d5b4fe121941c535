"""A table of (condition, code) read lane by lane."""

from __future__ import annotations

from collections.abc import Sequence

import jax.numpy as jnp

from .arrays import Array

__all__ = ["first_of"]


def first_of(table: Sequence[tuple[Array, int]], otherwise: Array | int) -> Array:
    """The code of the first condition that holds, lane by lane; ``otherwise`` where none does. int32.

    table      (condition (*lanes,) bool, code) from the strongest to the weakest
    otherwise  a code, or codes (*lanes,) int32
    """
    if isinstance(otherwise, int):
        otherwise = jnp.full(table[0][0].shape, int(otherwise), jnp.int32)
    for condition, code in reversed(table):
        otherwise = jnp.where(condition, jnp.int32(int(code)), otherwise)
    return otherwise
