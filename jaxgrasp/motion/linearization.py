"""11.4, (11.28)-(11.29): a grasp linearised about an equilibrium, ``x' = A x + B f`` with deviations x and f.

x = (translation; rotation vector; velocity; angular velocity), 2 m entries in world axes; at the equilibrium world and
body axes coincide.

    A = [[0, I], [A_c, 0]],   A_c = [[0, [gravity]_x], [0, 0]],   B = [[0], [M^-1 G^W]]

With gravity = -g e_z this is the chapter's A_c with the factor g that it leaves out, Q = -[e_z]_x: contact forces that
carry the weight turn with the body. A and B do not depend on which equilibrating forces they are.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.typing import ArrayLike

from ..contacts import Grasp, cleared, folded_grasp_map, grasp_map, is_grasp, length_scale
from ..core import (
    Answer,
    Array,
    Bool,
    Float,
    Int,
    Status,
    applied,
    balance_tolerance,
    real_array,
    skew,
    wrench_dimension,
)
from ..forces import equilibrium
from .rigid_body import RigidBody, gravity_vector

__all__ = [
    "Linearization",
    "Scaled",
    "first_order",
    "is_equilibrium",
    "linearize",
    "scaled_system",
]


class Linearization(Answer):
    """A and B of (11.29), and the equilibrium they belong to.

    status  int32, a ``Status``: NON_MARGINAL, MARGINAL, NO_EQUILIBRIUM, NOT_BALANCED (the given forces), UNDECIDED or
            INVALID; A and B are zero where there is no equilibrium
    A       (*batch, 2 m, 2 m)
    B       (*batch, 2 m, k n): columns of components that do not exist (mu = 0, gamma = 0, inactive) are zero
    force   (*batch, k n) the equilibrating contact forces, N and N m; zero where there are none
    slack   (*batch) N: ``min_i f_n,i - psi_i(f_i)`` of ``force``
    """

    status: Int[Array, "*batch"]
    A: Float[Array, "*batch s s"]
    B: Float[Array, "*batch s kn"]
    force: Float[Array, "*batch kn"]
    slack: Float[Array, "*batch"]

    SENTENCES: ClassVar[Mapping[Status, str]] = {
        Status.NON_MARGINAL: "Non-marginal equilibrium: forces strictly inside every friction cone, so small "
        "changes of them are free.",
        Status.MARGINAL: "Marginal equilibrium: some contact is at the edge of its friction cone, so its force may "
        "change one way only.",
        Status.NO_EQUILIBRIUM: "No equilibrium: no admissible contact forces carry the weight.",
        Status.NOT_BALANCED: "The given forces are no equilibrium: they do not carry the weight, or leave their cones.",
        Status.INVALID: "Invalid: the numbers are not a grasp, a body and a gravity.",
    }


def _spread(grasp: Grasp, body: RigidBody) -> tuple[Grasp, RigidBody]:
    """Both with the same batch axes."""
    if not isinstance(grasp, Grasp):
        raise ValueError(f"the first argument must be a jaxgrasp.Grasp, got {type(grasp).__name__}")
    if not isinstance(body, RigidBody):
        raise ValueError(f"the second argument must be a jaxgrasp.RigidBody, got {type(body).__name__}")
    if grasp.dimension != body.dimension:
        raise ValueError(
            f"the grasp lives in {grasp.dimension} dimensions, the body in {body.dimension}: a planar body has one "
            "moment of inertia, a spatial one a 3 x 3 matrix"
        )
    own, other = grasp.batch_shape, body.batch_shape
    try:
        batch = jnp.broadcast_shapes(own, other)
    except ValueError as error:
        raise ValueError(f"the batch axes of grasp {own} and body {other} do not broadcast") from error

    def wide(x: Array, lead: tuple[int, ...]) -> Array:
        return jnp.broadcast_to(x, (*batch, *x.shape[len(lead) :]))

    spread = jax.tree.map(lambda x: wide(x, own), grasp) if own != batch else grasp
    dtype = grasp.dtype
    return spread, jax.tree.map(lambda x: wide(x.astype(dtype), other), body)


@eqx.filter_jit
def _judged(grasp: Grasp, load: Array, force: Array) -> tuple[Array, Array]:
    """What given forces are, and their slack."""
    d, n = grasp.dimension, grasp.model.force_size(grasp.dimension)
    parts = force.reshape(*force.shape[:-1], grasp.contacts, n)
    slack = jnp.where(grasp.active, cleared(grasp).model.feasibility_slack(parts, d), jnp.inf)
    slack = jnp.min(slack, axis=-1)
    left = applied(grasp_map(grasp), force) + load
    per_length = jnp.where(jnp.arange(load.shape[-1]) < d, 1.0, 1 / length_scale(grasp)[..., None])
    largest = jnp.max(jnp.abs(force), axis=-1) + jnp.max(jnp.abs(load), axis=-1)
    allowed = balance_tolerance(grasp.dtype) * largest
    idle = jnp.all(jnp.where(grasp.active[..., None], 0.0, parts) == 0, axis=(-1, -2))
    balanced = (jnp.max(jnp.abs(left * per_length), axis=-1) <= allowed) & idle
    point = jnp.where(slack > allowed, Status.NON_MARGINAL.value, Status.MARGINAL.value)
    bad = ~balanced | (slack < -allowed)
    point = jnp.where(bad, Status.NOT_BALANCED.value, point).astype(jnp.int32)
    sound = jnp.all(jnp.isfinite(force), axis=-1) & is_grasp(grasp)
    return jnp.where(sound, point, jnp.int32(Status.INVALID.value)), slack


def is_equilibrium(point: Int[Array, "*batch"]) -> Bool[Array, "*batch"]:
    """Whether a ``Status`` is an equilibrium, marginal or not."""
    return (point == Status.NON_MARGINAL.value) | (point == Status.MARGINAL.value)


@eqx.filter_jit
def first_order(
    A_c: Float[Array, "*batch m m"], B_c: Float[Array, "*batch m n"]
) -> tuple[Float[Array, "*batch s s"], Float[Array, "*batch s n"]]:
    """``[[0, I], [A_c, 0]]`` and ``[[0], [B_c]]`` of ``x'' = A_c x + B_c f``."""
    zero, unit = jnp.zeros_like(A_c), jnp.broadcast_to(jnp.eye(A_c.shape[-1], dtype=A_c.dtype), A_c.shape)
    A = jnp.concatenate([jnp.concatenate([zero, unit], -1), jnp.concatenate([A_c, zero], -1)], -2)
    return A, jnp.concatenate([jnp.zeros_like(B_c), B_c], axis=-2)


def linearize(
    grasp: Grasp,
    body: RigidBody,
    *,
    force: Float[ArrayLike, "*batch kn"] | None = None,
    gravity: Float[ArrayLike, "*batch d"] | None = None,
    tolerance: float = 1e-8,
) -> Linearization:
    """``x' = A x + B f~`` (11.29) about the equilibrium in which contact forces carry the body's weight.

    grasp    any batch axes, positions relative to the centre of mass
    body     a ``RigidBody``; its batch axes broadcast with the grasp's
    force    (*batch, k n) equilibrating forces; None: found by ``equilibrium``, strictly inside the cones if any are
    gravity  m/s^2 in the axes of the grasp, one vector or one a lane; None: 9.81 along -z, in the plane along -y

    Works under ``jax.jit`` and ``jax.vmap``; A and B are differentiable. A lane without equilibrium, or with bad
    numbers, says so in ``status``; wrong shapes raise ValueError.
    """
    grasp, body = _spread(grasp, body)
    d, dtype = grasp.dimension, grasp.dtype
    fit, body, g, load = _weight(body, gravity_vector(gravity, d, dtype))
    if force is None:
        found = equilibrium(grasp, load, tolerance=tolerance)
        point, slack, forces = found.status, found.slack, found.force
    else:
        forces = real_array(force, "force").astype(dtype)
        size = grasp.contacts * grasp.model.force_size(d)
        if forces.ndim < 1 or forces.shape[-1] != size:
            raise ValueError(
                f"force must have shape (*batch, {size}): contact after contact in the model's order of components, "
                f"got {forces.shape}"
            )
        forces = jnp.broadcast_to(forces, (*grasp.batch_shape, size))
        point, slack = _judged(grasp, load, forces)
    point = jnp.where(fit, point, jnp.int32(Status.INVALID.value))
    return _about(grasp, body, g, point, forces, slack)


@eqx.filter_jit
def _weight(body: RigidBody, gravity: Array) -> tuple[Array, RigidBody, Array, Array]:
    """Which lanes are fit; body and gravity, harmless where they are not; the body's weight as a load."""
    d, m = body.dimension, wrench_dimension(body.dimension)
    g = jnp.broadcast_to(gravity, (*body.batch_shape, d))
    valid, finite = body.valid, jnp.isfinite(g)
    g = jnp.where(finite, g, 0.0)
    body = body.where(valid)
    weight = body.mass[..., None] * g
    load = jnp.concatenate([weight, jnp.zeros((*weight.shape[:-1], m - d), g.dtype)], axis=-1)
    return valid & jnp.all(finite, axis=-1), body, g, load


@eqx.filter_jit
def _about(
    grasp: Grasp, body: RigidBody, gravity: Array, point: Array, force: Array, slack: Array
) -> Linearization:
    """The linearisation where ``point`` is an equilibrium, zeros elsewhere."""
    there = is_equilibrium(point)
    A, B = first_order(*_blocks(_sound(grasp), body, gravity))
    keep = there[..., None, None]
    return Linearization(
        point,
        jnp.where(keep, A, 0.0),
        jnp.where(keep, B, 0.0),
        jnp.where(there[..., None], force, 0.0),
        jnp.where(there, slack, -jnp.inf),
    )


@eqx.filter_jit
def _sound(grasp: Grasp) -> Grasp:
    """The grasp with harmless numbers wherever a contact does not exist or its lane is none: no NaN, no derivative."""
    return cleared(grasp, grasp.active & is_grasp(grasp)[..., None])


def _tilt(gravity: Array) -> Array:
    """d (R f) / d theta over m_B for forces that carry the weight: ``[gravity]_x``, (d, t)."""
    if gravity.shape[-1] == 3:
        return skew(gravity)
    return jnp.stack([gravity[..., 1], -gravity[..., 0]], axis=-1)[..., None]


def _blocks(grasp: Grasp, body: RigidBody, gravity: Array) -> tuple[Array, Array]:
    """A_c and ``B_c = M^-1 G^W`` at the identity orientation."""
    d, m = grasp.dimension, wrench_dimension(grasp.dimension)
    scale = jnp.where(grasp.active[..., None], cleared(grasp).model.scaling(d), 0.0)
    exists = (scale > 0).reshape(*scale.shape[:-2], 1, -1)
    G = jnp.where(exists, grasp_map(grasp), 0.0)
    B_c = jnp.concatenate(
        [G[..., :d, :] / body.mass[..., None, None], body.inverse_inertia @ G[..., d:, :]], axis=-2
    )
    tilt = _tilt(gravity)
    upper = jnp.concatenate([jnp.zeros((*tilt.shape[:-2], d, d), tilt.dtype), tilt], axis=-1)
    return jnp.concatenate([upper, jnp.zeros((*tilt.shape[:-2], m - d, m), tilt.dtype)], axis=-2), B_c


class Scaled(NamedTuple):
    """A_c (*batch, m, m) and folded B_c (*batch, m, k n) without units, and the units they were divided by.

    Lengths in radii of gyration l, times in sqrt(l / g), forces in weights m_B g; where there is no gravity, in the
    units of 1 m/s^2. B_c acts on scaled forces s, each contact in |s_t| <= s_n.
    """

    A_c: Float[Array, "*batch m m"]
    B_c: Float[Array, "*batch m kn"]
    length: Float[Array, "*batch"]
    time: Float[Array, "*batch"]
    force: Float[Array, "*batch"]


@eqx.filter_jit
def scaled_system(grasp: Grasp, body: RigidBody, gravity: Any = None) -> Scaled:
    """The second-order system ``x'' = A_c x + B_c s`` in units of the body, for decisions that depend on no unit."""
    grasp, body = _spread(grasp, body)
    d, grasp = grasp.dimension, _sound(grasp)
    body = body.where(body.valid)
    g = jnp.broadcast_to(gravity_vector(gravity, d, grasp.dtype), (*grasp.batch_shape, d))
    g = jnp.where(jnp.isfinite(g), g, 0.0)
    size = jnp.sqrt(jnp.sum(g * g, axis=-1))
    size = jnp.where(size > 0, size, jnp.ones_like(size))
    length = body.gyration_radius
    G = folded_grasp_map(grasp)
    inertia = body.inertia / (body.mass * length * length)[..., None, None]
    unit = RigidBody(jnp.ones_like(body.mass), inertia)
    torque = unit.inverse_inertia @ (G[..., d:, :] / length[..., None, None])
    A_c, _ = _blocks(grasp, unit, g / size[..., None])
    return Scaled(
        A_c,
        jnp.concatenate([G[..., :d, :], torque], axis=-2),
        length,
        jnp.sqrt(length / size),
        body.mass * size,
    )
