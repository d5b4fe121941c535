"""How far a step may go inside a cone, and the coordinates it is measured in."""

from __future__ import annotations

import jax.numpy as jnp
from jax import lax

from ..backend import stage
from ..core import Array
from .cone import Cone, Scaling, cone_max, determinant, inner, tail_inner

__all__ = ["cone_reach", "in_frame", "nesterov_todd", "rejoined"]


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


@stage
def _determinant_roots(u: Cone, z: Cone) -> tuple[Array, Array]:
    return jnp.sqrt(determinant(u)), jnp.sqrt(determinant(z))


@stage
def _scaling_factors(root_u: Array, root_z: Array) -> tuple[Array, Array, Array, Array]:
    return 1 / root_u, 1 / root_z, jnp.sqrt(root_u / root_z), lax.rsqrt(root_u * root_z)


@stage
def _half_angle(u: Cone, z: Cone, inverse_u: Array, inverse_z: Array) -> Array:
    return lax.rsqrt(2 * (1 + inner(u, z) * inverse_u * inverse_z))


@stage
def _scaling_point(u: Cone, z: Cone, inverse_u: Array, inverse_z: Array, half: Array) -> tuple[Cone, Array]:
    first = (u[0] * inverse_u + z[0] * inverse_z) * half
    rest = ((a * inverse_u - b * inverse_z) * half for a, b in zip(u[1:], z[1:], strict=True))
    return (first, *rest), 1 / (1 + first)


def nesterov_todd(u: Cone, z: Cone) -> Scaling:
    """The scaling with ``W z = W^-1 u``."""
    root_u, root_z = _determinant_roots(u, z)
    inverse_u, inverse_z, eta, root = _scaling_factors(root_u, root_z)
    half = _half_angle(u, z, inverse_u, inverse_z)
    w, inverse = _scaling_point(u, z, inverse_u, inverse_z, half)
    return Scaling(w, inverse, eta, root)
