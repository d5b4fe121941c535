"""Problems where answers are smooth, as dictionaries of arrays, and directions to move each input in."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

import jaxgrasp as jg


def planar_problem(seed=3, grasps=12):
    """Three planar hard fingers around the origin, a load, caps and joint limits."""
    rng = np.random.default_rng(seed)
    angle = np.array([0.3, 2.4, 4.4]) + 0.2 * rng.normal(size=(grasps, 3))
    position = np.stack([np.cos(angle), np.sin(angle)], -1)
    return {
        "position": position,
        "normal": -position + 0.1 * rng.normal(size=position.shape),
        "friction": rng.uniform(0.5, 0.9, (grasps, 3)),
        "wrench": rng.normal(size=(grasps, 3)),
        "cap": rng.uniform(2.0, 4.0, (grasps, 3)),
        "jacobian": rng.normal(size=(grasps, 6, 2)),
        "torque": rng.uniform(3.0, 5.0, (grasps, 2)),
    }


def soft_problem(seed=3, grasps=10):
    """Three soft fingers in space."""
    rng = np.random.default_rng(seed)
    angle = np.array([0.0, 2.1, 4.2]) + 0.2 * rng.normal(size=(grasps, 3))
    position = np.stack([np.cos(angle), np.sin(angle), 0.2 * rng.normal(size=angle.shape)], -1)
    return {
        "position": position,
        "normal": -position + 0.1 * rng.normal(size=position.shape),
        "friction": rng.uniform(0.5, 0.9, (grasps, 3)),
        "torsion": rng.uniform(0.1, 0.3, (grasps, 3)),
        "wrench": rng.normal(size=(grasps, 6)),
    }


def grasp_of(x):
    if "torsion" in x:
        return jg.Grasp(x["position"], x["normal"], jg.SoftFinger(x["friction"], x["torsion"]))
    return jg.Grasp(x["position"], x["normal"], jg.HardFinger(x["friction"]))


def hard_problem(seed=5, grasps=10):
    """Four hard fingers in space."""
    rng = np.random.default_rng(seed)
    corners = np.array([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]) / np.sqrt(3)
    position = corners + 0.2 * rng.normal(size=(grasps, 4, 3))
    return {
        "position": position,
        "normal": -position + 0.1 * rng.normal(size=position.shape),
        "friction": rng.uniform(0.5, 0.9, (grasps, 4)),
        "wrench": rng.normal(size=(grasps, 6)),
    }


def as_arrays(x):
    return {name: jnp.asarray(value) for name, value in x.items()}


def direction(x, seed=10):
    rng = np.random.default_rng(seed)
    return {name: jnp.asarray(rng.normal(size=value.shape)) for name, value in x.items()}


def moved(x, t, length):
    return {name: x[name] + length * t[name] for name in x}


def only(t, key):
    return {name: value if name == key else jnp.zeros_like(value) for name, value in t.items()}
