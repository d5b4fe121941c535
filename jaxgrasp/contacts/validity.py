"""Which numbers are a grasp: the one place that says so. The checker has its own copy."""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp

from ..core import Array, Bool
from .grasp import Grasp

__all__ = ["is_grasp", "sound_contacts"]


def sound_contacts(
    position: tuple[Array, ...], normal: tuple[Array, ...], friction: Array, torsion: Array
) -> Array:
    """Whether each contact's numbers are finite, with a normal of some length, mu >= 0 and gamma >= 0.

    Coordinates are apart, so that contacts and grasps may lie on any axes.
    """
    usable = jnp.isfinite(friction) & jnp.isfinite(torsion) & (friction >= 0) & (torsion >= 0)
    points = jnp.zeros_like(usable)
    for x in normal:
        points = points | (x != 0)
    for x in (*position, *normal):
        usable = usable & jnp.isfinite(x)
    return usable & points


@eqx.filter_jit
def is_grasp(grasp: Grasp) -> Bool[Array, "*batch"]:
    """Whether at least one contact is active and the numbers of all active ones are sound."""
    position, normal = (
        tuple(x[..., i] for i in range(grasp.dimension)) for x in (grasp.position, grasp.normal)
    )
    model, live = grasp.model, grasp.active
    sound = sound_contacts(position, normal, model.friction_coefficient, model.torsion_coefficient)
    return jnp.all(sound | ~live, axis=-1) & jnp.any(live, axis=-1)
