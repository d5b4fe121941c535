"""What both derivative rules need: rows made harmless where there is no derivative, and solves tile by tile."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ._types import Array
from .lanes import batched, map_tiles
from .margin import Contacts

__all__ = ["in_tiles", "kept", "masked", "safe_contacts", "zero_tangent"]


def zero_tangent(x: Array) -> Any:
    """The tangent of a result that has none."""
    if jnp.issubdtype(x.dtype, jnp.floating):
        return jnp.zeros_like(x)
    return np.zeros(x.shape, jax.dtypes.float0)


def kept(ok: Array, x: Array, value: Any) -> Array:
    """Row arrays x with ``value`` in the lanes that are not ``ok``."""
    mask = ok.reshape(*ok.shape, *([1] * (x.ndim - 1)))
    return jnp.where(mask, x, jnp.asarray(value, x.dtype))


def masked(ok: Array, x: Array, dx: Any) -> Any:
    """Tangent rows dx of x, zero in the lanes that are not ``ok``."""
    if not jnp.issubdtype(x.dtype, jnp.floating):
        return dx
    return kept(ok, dx, 0.0)


def safe_contacts(ok: Array, contacts: Contacts) -> Contacts:
    """Harmless numbers in lanes without a derivative and in padding, so that no NaN enters, forwards or backwards."""
    axis = np.eye(contacts.position.shape[-1])[-1]
    live = kept(ok, contacts.active, True)
    used = live & ok[:, None]
    point = used[..., None]
    return Contacts(
        jnp.where(point, contacts.position, jnp.asarray(axis, contacts.position.dtype)),
        jnp.where(point, contacts.normal, jnp.asarray(axis, contacts.normal.dtype)),
        jnp.where(used, contacts.friction, jnp.ones_like(contacts.friction)),
        jnp.where(used, contacts.torsion, jnp.ones_like(contacts.torsion)),
        live,
    )


def in_tiles(kernel: Callable[[Any], Any], width: int) -> Callable[[Any], Any]:
    """``kernel`` on rows, a tile of ``width`` at a time; ``vmap`` adds rows. Their first leaf is (N, k, .)."""

    def run(rows: Any, count: Array, _: Array) -> Any:
        return map_tiles(kernel, rows, count, width)

    folded = batched(run, lambda rows: jax.tree.leaves(rows)[0].shape[:-2], width)
    return lambda rows: folded(rows, jnp.zeros((), jnp.int32))
