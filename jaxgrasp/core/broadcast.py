"""A user's value on every lane: one number for all, one per grasp, or one per load."""

from __future__ import annotations

import jax.numpy as jnp

from .arrays import Array, widened

__all__ = ["spread"]


def spread(
    value: Array, own: tuple[int, ...], batch: tuple[int, ...], name: str, loads: tuple[int, ...] = ()
) -> Array:
    """``value`` broadcast to ``(*batch, *own)``, then over the axes ``loads`` in between: (*batch, *loads, *own).

    ValueError with the ``name`` of the value where it does not broadcast.
    """
    try:
        full = widened(jnp.asarray(value), (*batch, *own))
    except ValueError as error:
        raise ValueError(
            f"{name} must broadcast to shape {(*batch, *own)}, got {jnp.shape(value)}"
        ) from error
    if not loads:
        return full
    return widened(full.reshape(*batch, *([1] * len(loads)), *own), (*batch, *loads, *own))
