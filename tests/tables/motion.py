"""Random bodies and states for the tests of section 11.4."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from grasps import random_rotation

import jaxgrasp as jg


def random_inertias(rng: np.random.Generator, count: int) -> np.ndarray:
    """(count, 3, 3) of solids of unit mass and a radius of gyration of about 1: any axes, any flatness a solid has."""
    spread = rng.uniform(0.05, 1.0, (count, 3))  # second moments of the mass along the principal axes
    moments = spread.sum(1, keepdims=True) - spread
    turns = np.stack([random_rotation(rng) for _ in range(count)])
    return np.einsum("nij,nj,nkj->nik", turns, moments, turns)


def random_bodies(
    rng, count: int, dimension: int, dtype="float64", mass=(0.5, 2.0), size=1.0
) -> jg.RigidBody:
    """Bodies of a mass in kg and a size in m."""
    m = rng.uniform(*mass, count)
    if dimension == 2:
        return jg.RigidBody(
            jnp.asarray(m, dtype), jnp.asarray(m * size**2 * rng.uniform(0.5, 2, count), dtype)
        )
    inertia = m[:, None, None] * size**2 * random_inertias(rng, count)
    inertia = (inertia + inertia.transpose(0, 2, 1)) / 2
    return jg.RigidBody(jnp.asarray(m, dtype), jnp.asarray(inertia, dtype))


def random_states(rng, count: int, dimension: int, dtype="float64", speed=1.0) -> jg.BodyState:
    """Anywhere, turned anyhow, moving."""
    m = 6 if dimension == 3 else 3
    turn = rng.normal(size=(count, 4)) if dimension == 3 else rng.uniform(-3, 3, (count, 1))
    if dimension == 3:
        turn /= np.linalg.norm(turn, axis=1, keepdims=True)
    position, velocity = rng.normal(size=(count, dimension)), speed * rng.normal(size=(count, m))
    return jg.BodyState(jnp.asarray(position, dtype), jnp.asarray(turn, dtype), jnp.asarray(velocity, dtype))
