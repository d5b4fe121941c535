"""Random grasps of many kinds for the tests: generic ones, and the degenerate ones that break solvers."""

from __future__ import annotations

import numpy as np

KINDS = (
    "sphere",  # inward normals through the centre
    "tilted",  # the same, normals off by a few tenths
    "scatter",  # anything
    "box",  # on the faces of a cube
    "half space",  # all normals push one way
    "duplicate",  # two contacts coincide
    "collinear",  # all contacts on one line
    "remote",  # a small cluster far from the centre of mass
)


def random_contacts(rng: np.random.Generator, grasps: int, k: int, dimension: int):
    """Positions and normals (grasps, k, dimension) and the index of each grasp's kind."""
    shape = (grasps, k, dimension)
    p, noise = rng.normal(size=shape), rng.normal(size=shape)
    ball = p / np.linalg.norm(p, axis=-1, keepdims=True)
    kind = rng.integers(len(KINDS), size=grasps)
    position, normal = ball.copy(), -ball
    for i, name in enumerate(KINDS):
        here = kind == i
        if name == "tilted":
            normal[here] += 0.3 * noise[here]
        elif name == "scatter":
            position[here], normal[here] = p[here], noise[here]
        elif name == "box":
            count = int(here.sum())
            q, n = rng.uniform(-1, 1, (count, k, dimension)), np.zeros((count, k, dimension))
            axis, side = (
                rng.integers(dimension, size=(count, k, 1)),
                rng.choice([-1.0, 1.0], size=(count, k, 1)),
            )
            np.put_along_axis(q, axis, side, -1)
            np.put_along_axis(n, axis, -side, -1)
            position[here], normal[here] = q, n
        elif name == "half space":
            tilted = noise[here]
            tilted[..., 0] = np.abs(tilted[..., 0]) + 0.2
            position[here], normal[here] = p[here], tilted
        elif name == "duplicate" and k > 1:
            position[here, 1], normal[here, 1] = position[here, 0], normal[here, 0]
        elif name == "collinear":
            position[here] = ball[here][:, :1] * rng.uniform(-1, 1, (int(here.sum()), k, 1))
            normal[here] = noise[here]
        elif name == "remote":
            position[here] = 1e-2 * (ball[here] + 5 * noise[here][:, :1])
    return position, normal, kind


def random_coefficients(rng: np.random.Generator, grasps: int, k: int):
    """mu from 0 to 3 (zeros, uniform and mixed grasps) and gamma from 0 to 0.5, each (grasps, k)."""
    friction = 3 * rng.uniform(0, 1, (grasps, 1)) ** 2 * np.ones((grasps, k))
    friction[rng.random(grasps) < 0.1] = 0.0
    mixed = rng.random(grasps) < 0.3
    friction[mixed] = (rng.uniform(0, 3, (grasps, k)) * (rng.random((grasps, k)) < 0.7))[mixed]
    torsion = rng.uniform(0, 0.5, (grasps, k)) * (rng.random((grasps, k)) < 0.8)
    return friction, torsion


def random_active(rng: np.random.Generator, grasps: int, k: int):
    """Masks with 1 to k active contacts, padding last."""
    return np.arange(k) < rng.integers(1, k + 1, (grasps, 1))


def random_rotation(rng: np.random.Generator, dimension: int = 3) -> np.ndarray:
    q, r = np.linalg.qr(rng.normal(size=(dimension, dimension)))
    q = q * np.sign(np.diag(r))
    if np.linalg.det(q) < 0:
        q[:, 0] = -q[:, 0]
    return q


def ball(rng, count, k, tilt=0.3, dimension=3):
    """Hard fingers on a unit sphere or circle with tilted normals: position, normal, friction."""
    position = rng.normal(size=(count, k, dimension))
    position /= np.linalg.norm(position, axis=-1, keepdims=True)
    return position, -position + tilt * rng.normal(size=position.shape), rng.uniform(0.3, 0.8, (count, k))
