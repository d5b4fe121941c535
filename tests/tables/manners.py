"""Every public function that computes, on one small grasp: what ``test_manners.py`` puts under transformations.

A function maps a grasp to numbers that padding must not change. The grasp is a planar pinch whose lengths are scaled
by a number, with a third contact that is no contact if asked for.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import jaxgrasp as jg
from jaxgrasp import contacts, lmi, quality

LOAD = np.array([0.3, -1.0, 0.1])
LOADS = np.array([[0.3, -1.0, 0.1], [0.0, 0.5, -0.2]])
JACOBIAN = np.array([[0.3, 0.1], [1.0, -0.2], [0.2, 0.5], [0.1, 1.0]])
LIMITS = np.array([np.inf, 5.0])
POSITION = np.array([[-1.0, 0.0], [1.0, 0.1], [0.3, -0.8]])
NORMAL = np.array([[1.0, 0.1], [-1.0, 0.0], [-0.2, 1.0]])


def pinch(scale: Any = 1.0, padding: float | None = None, dtype: Any = None) -> jg.Grasp:
    """Three fingers on a disc, lengths times ``scale``; ``padding`` in all numbers of a fourth that is no contact."""
    dtype = jnp.result_type(float) if dtype is None else dtype
    k = len(POSITION)
    position, normal = jnp.asarray(scale, dtype) * jnp.asarray(POSITION, dtype), jnp.asarray(NORMAL, dtype)
    mu = np.full(k, 0.5)
    active = np.ones(k, bool)
    if padding is not None:
        junk = jnp.full((1, 2), padding, dtype)
        position, normal = jnp.concatenate([position, junk]), jnp.concatenate([normal, junk])
        mu, active = np.append(mu, padding), np.append(active, False)
    return jg.Grasp(position, normal, jg.HardFinger(jnp.asarray(mu, dtype)), active)


def _real(force: Any) -> Any:
    """The components of the three fingers."""
    return force[..., : 2 * len(POSITION)]


def _limits(grasp: jg.Grasp) -> Any:
    rows = jnp.concatenate([jnp.asarray(JACOBIAN), jnp.zeros((2, 2))])
    return jnp.resize(rows, (2 * grasp.contacts, 2)).astype(grasp.dtype), jnp.asarray(LIMITS, grasp.dtype)


def _body() -> jg.RigidBody:
    return jg.RigidBody(1.0, 0.4)


def _inside(grasp: jg.Grasp) -> Any:
    """Forces with a tangential part of 0.2 N beside 1 N."""
    return jnp.resize(jnp.array([0.2, 1.0], grasp.dtype), 2 * grasp.contacts)


class Case(NamedTuple):
    """``of(grasp)``: numbers of one grasp, padding or not; ``smooth``: they have derivatives in the positions."""

    of: Callable[[jg.Grasp], Any]
    smooth: bool = True


def _forces(grasp: jg.Grasp, criterion: Any, **limits: Any) -> Any:
    found = jg.optimize_forces(grasp, LOAD, criterion=criterion, **limits)
    return found.cost, found.lower, _real(found.force), found.load_twist


CASES: dict[str, Case] = {
    "grasp_map": Case(lambda g: _real(jg.grasp_map(g))),
    "grasp_rank": Case(jg.grasp_rank, False),
    "null_space": Case(
        lambda g: jnp.abs(_real(contacts.internal_force_part(g, jnp.ones(2 * g.contacts, g.dtype)))), False
    ),
    "contact_frames": Case(lambda g: jg.contact_frames(g)[: len(POSITION)]),
    "force_vectors": Case(lambda g: jg.force_vectors(g, jnp.ones(2 * g.contacts, g.dtype))[: len(POSITION)]),
    "contacts.folded_grasp_map": Case(lambda g: _real(contacts.folded_grasp_map(g))),
    "contacts.length_scale": Case(contacts.length_scale),
    "contacts.cone_use": Case(lambda g: contacts.cone_use(g, _inside(g))),
    "contacts.nearest_admissible": Case(lambda g: _real(contacts.nearest_admissible(g, jg.grasp_map(g)[0]))),
    "wrench_resistance": Case(lambda g: jg.wrench_resistance(g).margin),
    "optimize_forces": Case(lambda g: _forces(g, jg.Gentlest())),
    "optimize_forces, robust": Case(lambda g: _forces(g, jg.Robust(0.1))),
    "optimize_forces, sum of squares": Case(lambda g: _forces(g, jg.SumOfSquares(), max_normal=np.inf)),
    "optimize_forces, least norm, limits": Case(
        lambda g: _forces(g, jg.LeastNorm(), torque_limits=_limits(g))
    ),
    "equilibrium": Case(lambda g: jg.equilibrium(g, LOAD).slack),
    "squeeze": Case(lambda g: jg.squeeze(g, LOAD).effort),
    "resistible_wrenches": Case(lambda g: jg.resistible_wrenches(g, LOADS).cost),
    "epsilon_quality": Case(lambda g: jg.epsilon_quality(g, torque_scale=1.0).lower),
    "critical_friction": Case(lambda g: jg.critical_friction(g).factor),
    "guaranteed_radius": Case(lambda g: jg.guaranteed_radius(g).radius),
    "task_quality": Case(lambda g: jg.task_quality(g, LOADS).multiple),
    "quality.friction_sweep": Case(lambda g: quality.friction_sweep(g, np.array([0.8, 1.5])).margin),
    "quality.grasp_isotropy": Case(lambda g: quality.grasp_isotropy(g, torque_scale=1.0)),
    "quality.grasp_volume": Case(lambda g: quality.grasp_volume(g, torque_scale=1.0)),
    "linearize": Case(lambda g: _real(jg.linearize(g, _body()).B)),
    "controllability": Case(lambda g: jg.controllability(g, _body()).singular_values, False),
    "regulator": Case(lambda g: _real(jnp.swapaxes(jg.regulator(g, _body()).gain, -1, -2)), False),
    "lmi.friction_lmi": Case(lambda g: lmi.friction_lmi(g).S[:6, :6, :6], False),
    "lmi.lmi_forces": Case(lambda g: lmi.lmi_forces(g, LOAD, criterion=jg.SumOfSquares()).upper, False),
}

# Functions for people, files or long loops, which take known numbers, and what they do instead of being transformed.
HOST = {
    "trace": "a log of one grasp for people",
    "place_contacts": "searches in rounds on the host",
    "check": "proves in NumPy",
    "prove": "proves in NumPy and integers",
    "save_grasp": "writes a file",
    "load_grasp": "reads a file",
    "close_loop": "simulates; its steps are compiled inside",
}


def row(tree: Any) -> Any:
    """All numbers of ``tree`` in one row."""
    return jnp.concatenate([jnp.ravel(jnp.asarray(x)).astype(float) for x in jax.tree.leaves(tree)])


def on_two_devices(names: list[str]) -> None:
    """Print for each case how far its values under ``jax.shard_map`` are from those without; two devices are there."""
    mesh = jax.sharding.Mesh(np.array(jax.devices()), ("device",))
    assert mesh.size == 2
    split = jax.sharding.PartitionSpec("device")
    for name in names:

        def of(scales: Any, name: str = name) -> Any:
            return jax.vmap(lambda s: row(CASES[name].of(pinch(s))))(scales)

        scales = jnp.array([1.0, 1.3])
        plain = np.asarray(jax.jit(of)(scales))
        mapped = jax.jit(jax.shard_map(of, mesh=mesh, in_specs=split, out_specs=split))
        sharded = jax.device_put(scales, jax.sharding.NamedSharding(mesh, split))
        for found in (mapped(scales), jax.jit(of)(sharded)):
            found = np.asarray(found)
            worst = np.max(np.abs(found - plain)) if np.all(np.isfinite(found)) else np.inf
            print(f"{worst:.3e}  {name}", flush=True)


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    on_two_devices(sys.argv[1:])
