"""Array vocabulary: shapes in annotations, and users' numbers as arrays of a floating dtype."""

from __future__ import annotations

from types import EllipsisType

import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Int

__all__ = ["Array", "ArrayLike", "Bool", "Float", "Index", "Int", "real_array"]

# What a batch is indexed by, as NumPy does it.
Index = int | slice | EllipsisType | ArrayLike | tuple[int | slice | EllipsisType | ArrayLike, ...]


def real_array(value: ArrayLike, name: str, means: str = "a number or an array of numbers") -> Array:
    """``value`` as an array of a floating dtype; ValueError, with what it ``means``, where it holds no real numbers."""
    try:
        array = jnp.asarray(value)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name} must be {means}, got {value!r}") from error
    if jnp.issubdtype(array.dtype, jnp.floating):
        return array
    if not jnp.issubdtype(array.dtype, jnp.integer):
        raise ValueError(f"{name} must hold real numbers, got dtype {array.dtype}")
    return array.astype(jnp.result_type(float))
