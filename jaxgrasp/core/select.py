"""What is chosen lane by lane: the code of a table, a part of a batch."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from .arrays import Array, Index, on_host, placed

__all__ = ["bracket_width", "first_of", "largest_of", "least_of", "nan_where", "part_of"]

Batch = TypeVar("Batch")  # a pytree of arrays with the batch axes in front


def part_of(batch: Batch, index: Index) -> Batch:
    """``x[index]`` of every array x of ``batch``, as NumPy indexes. IndexError where there is no such part.

    NumPy does it where it can: it compiles nothing, and refuses an index that is too large.
    """
    if not on_host((batch, index)):
        return jax.tree.map(lambda x: x[index], batch)
    where = jax.tree.map(lambda i: np.asarray(i) if isinstance(i, jax.Array) else i, index)
    return jax.tree.map(lambda x: placed(np.asarray(np.asarray(x)[where])), batch)


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


@jax.jit
def bracket_width(lower: Array, upper: Array) -> Array:
    """``upper - lower`` of a bracket; 0 where both are the same infinity."""
    same = lower == upper
    return jnp.where(same, jnp.zeros_like(lower), upper - lower)


@jax.custom_jvp
def largest_of(x: Array) -> Array:
    """``max x`` along the last axis; its derivative is that of the first that is largest.

    A compiler may compute x twice, with other rounding: then nothing is equal to the maximum, and the derivative of
    ``jnp.max`` is 0 / 0. An index is one whatever the rounding.
    """
    return jnp.max(x, axis=-1)


@largest_of.defjvp
def _largest_of_jvp(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
    (x,), (dx,) = primals, tangents
    first = jax.lax.argmax(x, x.ndim - 1, jnp.int32)[..., None]
    chosen = jnp.arange(x.shape[-1], dtype=jnp.int32) == first
    return largest_of(x), jnp.sum(jnp.where(chosen, dx, 0.0), axis=-1)


def least_of(x: Array) -> Array:
    """``min x`` along the last axis, with derivatives as ``largest_of``."""
    return -largest_of(-x)


def nan_where(mask: Array, x: Array) -> Array:
    """``x``, NaN where ``mask``. It is made there and nowhere else: ``jax.debug_nans`` would find a constant."""
    one = jnp.ones_like(x)
    return jnp.where(mask, jnp.sqrt(jnp.where(mask, -one, one)), x)
