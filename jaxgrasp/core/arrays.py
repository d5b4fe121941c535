"""Array vocabulary: shapes in annotations, and users' numbers as arrays of a floating dtype."""

from __future__ import annotations

from types import EllipsisType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.typing import ArrayLike, DTypeLike
from jaxtyping import Array, Bool, Float, Int

from .forks import check_process

__all__ = [
    "Array",
    "ArrayLike",
    "Bool",
    "Float",
    "Index",
    "Int",
    "as_array",
    "on_host",
    "placed",
    "real_array",
    "require_precision",
    "uniform",
    "widened",
]

# What a batch is indexed by, as NumPy does it.
Index = int | slice | EllipsisType | ArrayLike | tuple[int | slice | EllipsisType | ArrayLike, ...]


def real_array(value: ArrayLike, name: str, means: str = "a number or an array of numbers") -> Array:
    """``value`` as an array of a floating dtype; ValueError, with what it ``means``, where it holds no real numbers."""
    try:
        array = as_array(value)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name} must be {means}, got {value!r}") from error
    if jnp.issubdtype(array.dtype, jnp.floating):
        require_precision(array.dtype, name)
        return array
    if not jnp.issubdtype(array.dtype, jnp.integer):
        raise ValueError(f"{name} must hold real numbers, got dtype {array.dtype}")
    return array.astype(jnp.result_type(float))


def require_precision(dtype: DTypeLike, name: str) -> None:
    """ValueError for float16, bfloat16 and other floating dtypes than float32 and float64."""
    if jnp.dtype(dtype) not in (np.float32, np.float64):
        raise ValueError(
            f"{name} has dtype {jnp.dtype(dtype).name}, but proofs need float32 or float64: convert first, e.g. "
            'with .astype("float32")'
        )


def as_array(value: ArrayLike) -> Array:
    """``jnp.asarray(value)``; what NumPy can read compiles nothing."""
    if isinstance(value, np.ndarray | list | tuple):
        try:
            known = np.array(value)  # a copy: JAX may keep the memory, and the caller may change it
        except TypeError:
            return jnp.asarray(value)  # numbers that are being traced
        if known.dtype.kind in "fiub":
            return placed(known)
    return jnp.asarray(value)


def placed(array: np.ndarray) -> Array:
    """``array``, which nobody changes any more, as JAX's: ``jnp.asarray`` would compile a program for each shape."""
    check_process()
    return jax.device_put(array)


def uniform(shape: tuple[int, ...], value: float, dtype: DTypeLike) -> Array:
    """``value`` everywhere in ``shape``."""
    return placed(np.full(shape, value, dtype))


def _here(leaf: Any) -> bool:
    if isinstance(leaf, Tracer):
        return False
    return not isinstance(leaf, jax.Array) or all(device.platform == "cpu" for device in leaf.devices())


def on_host(tree: Any) -> bool:
    """Whether NumPy can read all leaves of ``tree`` as they are: known numbers in the CPU's memory.

    Moving numbers about is then NumPy's: JAX would compile a program for each shape.
    """
    return all(_here(x) for x in jax.tree.leaves(tree))


def widened(value: Array, shape: tuple[int, ...]) -> Array:
    """``value`` broadcast to ``shape``; ValueError where it does not."""
    if value.shape == shape:
        return value
    if on_host(value):
        return placed(np.broadcast_to(np.asarray(value), shape))
    return jnp.broadcast_to(value, shape)
