"""Arrays as Arrow's nested lists, and back."""

from __future__ import annotations

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from ..core import UserError

__all__ = ["dense", "fixed_lists", "nullable_lists"]


def fixed_lists(values: np.ndarray, kind: pa.DataType) -> pa.Array:
    """``values`` (n, ...) as the type ``kind``: fixed-size lists in each other, or plain numbers."""
    sizes, leaf = [], kind
    while pa.types.is_fixed_size_list(leaf):
        sizes.append(leaf.list_size)
        leaf = leaf.value_type
    array = pa.array(np.ascontiguousarray(values).reshape(-1), leaf)
    for size in reversed(sizes):
        array = pa.FixedSizeListArray.from_arrays(array, size)
    return array


def nullable_lists(values: np.ndarray, kind: pa.DataType, missing: np.ndarray) -> pa.Array:
    """``values`` (n, size, ...) as lists of the type ``kind``, null in the rows where ``missing``."""
    ends = np.concatenate([[0], np.cumsum(np.where(missing, 0, values.shape[1]))]).astype(np.int32)
    kept = fixed_lists(values[~missing], kind.value_type)
    return pa.ListArray.from_arrays(pa.array(ends), kept, mask=pa.array(missing))


def dense(array: pa.Array, name: str) -> np.ndarray:
    """Nested lists of one size as an array; nulls become NaN (False for booleans)."""
    kind = array.type
    if not (pa.types.is_list(kind) or pa.types.is_large_list(kind) or pa.types.is_fixed_size_list(kind)):
        if pa.types.is_boolean(kind):
            return np.asarray(pc.fill_null(array, False).to_numpy(zero_copy_only=False), bool)
        if not (pa.types.is_floating(kind) or pa.types.is_integer(kind)):
            raise UserError(f"the column {name} must hold numbers, not {kind}")
        if pa.types.is_integer(kind) and not array.null_count:
            return array.to_numpy(zero_copy_only=False)
        wide = kind if pa.types.is_float32(kind) else pa.float64()
        return pc.fill_null(array.cast(wide), float("nan")).to_numpy(zero_copy_only=False)
    valid = np.asarray(array.is_valid().to_numpy(zero_copy_only=False), bool)
    if pa.types.is_fixed_size_list(kind):
        size = kind.list_size
    else:
        sizes = np.unique(
            pc.call_function("list_value_length", [array]).drop_null().to_numpy(zero_copy_only=False)
        )
        if len(sizes) > 1:
            raise UserError(
                f"the column {name} holds lists of different lengths, {sizes.min()} to {sizes.max()}; pad to "
                "one length and mark the padding False in the column active"
            )
        size = int(sizes[0]) if len(sizes) else 0
    inner = dense(array.flatten(), name)
    inner = inner.reshape(int(valid.sum()), size, *inner.shape[1:])
    if valid.all():
        return inner
    fill = np.full(
        (len(array), *inner.shape[1:]), False if inner.dtype == bool else np.nan, np.result_type(inner, bool)
    )
    fill[valid] = inner
    return fill
