"""How far a step may go inside a cone, and the coordinates it is measured in."""

from __future__ import annotations

import jax.numpy as jnp
from jax import lax

from .._types import Array
from ..cones import Cone, cone_max, determinant, inner, tail_inner
from .stages import stage

__all__ = ["cone_reach", "in_frame", "rejoined"]


def rejoined(x: Cone) -> Cone:
    """Frame coordinates to head and rotated tails, and back: the same reflection."""
    if len(x) == 1:
        return x
    half = jnp.asarray(0.5**0.5, x[0].dtype)
    return ((x[0] + x[1]) * half, (x[0] - x[1]) * half, *x[2:])


def _cone_rate(lam: Cone, direction: Cone) -> Array:
    """Rate at which ``lam + t direction`` runs into its cone. Source: Vandenberghe 2010, section 8."""
    root = lax.rsqrt(determinant(lam))
    bar = tuple(a * root for a in lam)
    first = bar[0] * direction[0] - tail_inner(bar, direction)
    shift = (first + direction[0]) / (1 + bar[0])
    tails = tuple(a - shift * b for a, b in zip(direction[1:], bar[1:], strict=True))
    size = jnp.sqrt(inner(tails, tails)) if tails else jnp.zeros_like(first)
    return (size - first) * root


@stage
def cone_reach(exists: Array, lam: Cone, p: Cone, q: Cone) -> Array:
    return cone_max(exists * jnp.maximum(_cone_rate(lam, p), _cone_rate(lam, q)))


@stage
def in_frame(h: Cone) -> Cone:
    return rejoined(h)
