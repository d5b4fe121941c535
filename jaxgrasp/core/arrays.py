"""Array vocabulary: shapes in annotations, and users' numbers as arrays of a floating dtype."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

__all__ = ["Array", "Bool", "Float", "Int", "real_array"]


def real_array(value: Any, name: str, means: str = "a number or an array of numbers") -> Array:
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
