"""Random problems of force optimisation for the tests: every model and criterion, loads of four kinds, limits."""

from __future__ import annotations

import numpy as np
from grasps import KINDS, random_active, random_coefficients, random_contacts

import jaxgrasp as jg

K, JOINTS = 5, 3
MODELS = {
    "soft": (lambda mu, gamma: jg.SoftFinger(mu, gamma), 3),
    "hard": (lambda mu, gamma: jg.HardFinger(mu), 3),
    "planar hard": (lambda mu, gamma: jg.HardFinger(mu), 2),
    "frictionless": (lambda mu, gamma: jg.Frictionless(np.zeros_like(mu)), 3),
}
CRITERIA = {
    "gentlest": (lambda x: jg.Gentlest(), None),
    "robust": (jg.Robust, 0.7),
    "smallest sum": (lambda x: jg.SmallestSum(), None),
    "sum of squares": (lambda x: jg.SumOfSquares(), None),
    "least norm": (lambda x: jg.LeastNorm(x), 0.2),
}


def in_general_position(name, count, seed):
    """(count,) bool: those of ``problems`` that no symmetry and no load on an edge makes special."""
    _, dimension = MODELS[name]
    rng = np.random.default_rng(seed)  # drawn as there
    *_, kind = random_contacts(rng, count, K, dimension)
    random_coefficients(rng, count, K)
    random_active(rng, count, K)
    rng.normal(size=(count, 3 if dimension == 2 else 6))
    load = rng.integers(4, size=count)
    return np.isin([KINDS[i] for i in kind], ("tilted", "scatter", "half space", "remote")) & (load != 2)


def problems(name, limits, count, seed):
    """Random grasps of all kinds and loads of four: any, balanced inside, balanced on the edge, just beyond it."""
    model, dimension = MODELS[name]
    rng = np.random.default_rng(seed)
    position, normal, _ = random_contacts(rng, count, K, dimension)
    friction, torsion = random_coefficients(rng, count, K)
    active = random_active(rng, count, K)
    probe = jg.Grasp(position, normal, model(friction, torsion), active)
    components = [c.value for c in probe.model.components(dimension)]
    n, m = len(components), 3 if dimension == 2 else 6
    wrench = rng.normal(size=(count, m))
    kind = rng.integers(4, size=count)
    G = np.asarray(jg.contacts.folded_grasp_map(probe)).reshape(count, m, K, n)
    head = components.index("f_n")
    s = rng.normal(size=(count, K, n))
    tails = np.delete(s, head, -1)
    share = rng.uniform(0, 0.9, (count, K)) ** 0.5
    share[kind == 2] = 1.0
    share[kind == 3] = 1.0 + 10.0 ** rng.uniform(-5, -2, (kind == 3).sum())[:, None]
    norm = np.maximum(np.linalg.norm(tails, axis=-1), 1e-12) if n > 1 else np.ones((count, K))
    press = rng.uniform(0.2, 1.0, (count, K))
    s = s * (share * press / norm)[..., None]
    s[..., head] = press
    made = -np.einsum("lmkn,lkn->lm", G, np.where(active[..., None], s, 0.0))
    wrench[kind > 0] = made[kind > 0]
    wrench *= 10.0 ** rng.uniform(-1, 2, (count, 1))
    cap = limit = None
    if limits:
        size = np.linalg.norm(wrench, axis=-1)[:, None]
        cap = np.where(rng.random((count, K)) < 0.5, size * 10.0 ** rng.uniform(-0.5, 1, (count, K)), np.inf)
        jacobian = rng.normal(size=(count, K * n, JOINTS)) * (rng.random((count, 1, JOINTS)) < 0.7)
        limit = (jacobian, size * 10.0 ** rng.uniform(-0.3, 1.5, (count, JOINTS)))
    return probe, components, wrench, cap, limit
