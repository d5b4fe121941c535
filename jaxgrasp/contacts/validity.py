"""Which numbers are a grasp: the one place that says so. The checker has its own copy."""

from __future__ import annotations

from collections.abc import Callable
from functools import reduce

import equinox as eqx
import jax.numpy as jnp
from jax import lax

from ..core import Array, Bool, size_limit
from .grasp import Grasp

__all__ = ["cleared", "is_grasp", "nonzero", "sound"]


def _magnitude(coordinates: tuple[Array, ...]) -> Array:
    size = jnp.abs(coordinates[0])
    for x in coordinates[1:]:
        size = jnp.maximum(size, jnp.abs(x))
    return size


def nonzero(x: Array) -> Array:
    """``x != 0``, also where a processor takes denormal numbers for 0: by the bits but for the sign."""
    return lax.bitcast_convert_type(x, jnp.uint64 if x.dtype == jnp.float64 else jnp.uint32) << 1 != 0


def sound(
    position: tuple[Array, ...],
    normal: tuple[Array, ...],
    friction: Array,
    torsion: Array,
    active: Array,
    largest: Callable[[Array], Array],
) -> Array:
    """Whether the numbers of all active contacts, at least one, are a grasp.

    They are finite; the largest component of each normal is no denormal number; mu and gamma are at least 0. With S of
    ``size_limit`` and P the largest |component| of a position, P is 0 or in [1/S, S], mu <= S, gamma <= S P (<= S for
    P = 0): squares and products of what is computed with neither over- nor underflow.

    Coordinates are apart, so that contacts and grasps may lie on any axes; ``largest`` is the maximum over contacts.
    """
    dtype = friction.dtype
    limit, least = size_limit(dtype), float(jnp.finfo(dtype).tiny)
    usable = (friction >= 0) & (friction <= limit) & (torsion >= 0)
    for x in (*position, *normal):
        usable = usable & jnp.isfinite(x)
    usable = usable & (_magnitude(normal) >= least)
    reach = jnp.where(active, _magnitude(position), jnp.zeros_like(friction))
    size, placed = largest(reach), reduce(jnp.logical_or, [largest(active & nonzero(x)) for x in position])
    spin = largest(jnp.where(active, torsion, jnp.zeros_like(torsion)))
    length = jnp.where(placed, size, jnp.ones_like(size))
    sized = (length >= 1 / limit) & (length <= limit) & (spin <= limit * length)
    return ~largest(active & ~usable) & largest(active) & sized


@eqx.filter_jit
def is_grasp(grasp: Grasp) -> Bool[Array, "*batch"]:
    """Whether at least one contact is active and the numbers of all active ones are sound."""
    position, normal = (
        tuple(x[..., i] for i in range(grasp.dimension)) for x in (grasp.position, grasp.normal)
    )
    model = grasp.model
    coefficients = model.friction_coefficient, model.torsion_coefficient
    return sound(position, normal, *coefficients, grasp.active, lambda x: jnp.max(x, axis=-1))


@eqx.filter_jit
def cleared(grasp: Grasp, live: Bool[Array, "*batch k"] | None = None) -> Grasp:
    """The grasp with harmless numbers where no contact is, by default in padding: whatever stood there is not read.

    ``0 * NaN`` is NaN: what is only masked afterwards spoils derivatives. Contacts without ``live`` become inactive.
    """
    live = grasp.active if live is None else live
    model = grasp.model
    coefficients = (jnp.where(live, c, 0.0) for c in (model.friction_coefficient, model.torsion_coefficient))
    upright = jnp.zeros(grasp.dimension, grasp.dtype).at[-1].set(1.0)
    position = jnp.where(live[..., None], grasp.position, 0.0)
    normal = jnp.where(live[..., None], grasp.normal, upright)
    return Grasp(position, normal, model.with_coefficients(*coefficients), live)
