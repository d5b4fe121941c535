"""What unit effort can do: the wrench space of a grasp, its support function, its extreme forces.

    W = {G f : f in C, effort(f) <= 1},     h(d) = max over W of d . w = sum_i h_i+   (Linf)   or   max_i h_i+   (L1)
    h_i(d) = v_n + |(mu v_t, gamma v_tau)|,   v = G_i^T d

Effort is counted in normal forces: L1 their sum, Linf their largest. In scaled forces s (f_t = mu s_t, f_n = s_0, ..)
every contact is the unit cone, so h_i = v_0 + |v_t| with v = A_i^T d; no cone is linearised. Torques count in units of
``torque_scale``, which makes a wrench (F; tau / torque_scale) and its size one number in N. Sources: Ferrari, Canny
1992 (both norms); Boyd, Wegbreit 2007 (support functions of exact cones).
"""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.typing import ArrayLike

from ..contacts import Grasp, cleared, folded_grasp_map, length_scale, normal_first
from ..core import Array, Bool, Float, largest_of, real_array, safe_root, wrench_dimension

__all__ = [
    "NORMS",
    "contact_support",
    "effort_map",
    "extreme_force",
    "scaled",
    "signed_supports",
    "support",
    "torque_lengths",
]

NORMS = ("L1", "Linf")


def torque_lengths(
    grasp: Grasp, torque_scale: Float[ArrayLike, "*batch"] | None = None
) -> Float[Array, "*batch"]:
    """The length torques are divided by, m: as given, or L, the largest distance of a contact from the centre.

    It stands for the object's radius: derivatives hold it fixed.
    """
    if torque_scale is None:
        return lax.stop_gradient(length_scale(grasp))
    try:
        given = real_array(torque_scale, "torque_scale").astype(grasp.dtype)
        return jnp.broadcast_to(given, grasp.batch_shape)
    except (TypeError, ValueError) as error:
        raise ValueError(
            f"torque_scale must be a length in m, or one a grasp, shape {grasp.batch_shape}; got {torque_scale!r}"
        ) from error


def _normal_first(grasp: Grasp) -> np.ndarray:
    """Where the components of a scaled force stand in the chapter's order."""
    components = grasp.model.components(grasp.dimension)
    return np.array([components.index(c) for c in normal_first(components)])


@eqx.filter_jit
def effort_map(grasp: Grasp, length: Float[Array, "*batch"]) -> Float[Array, "*batch k m n"]:
    """``A_i``: scaled contact forces, normal component first, to wrenches (F; tau / length). Zero where inactive."""
    m, n = wrench_dimension(grasp.dimension), grasp.model.force_size(grasp.dimension)
    rows = jnp.arange(m) < grasp.dimension
    A = folded_grasp_map(grasp) * jnp.where(rows, 1.0, 1 / length[..., None])[..., None]
    blocks = jnp.moveaxis(A.reshape(*A.shape[:-1], grasp.contacts, n), -3, -2)
    return blocks[..., _normal_first(grasp)]


@eqx.filter_jit
def scaled(grasp: Grasp, force: Float[Array, "*batch kn"]) -> Float[Array, "*batch k n"]:
    """s with f = (mu, mu, 1, gamma) s, normal component first; 0 where a component does not exist."""
    scale = cleared(grasp).model.scaling(grasp.dimension)
    s = force.reshape(*force.shape[:-1], *scale.shape[-2:])
    s = jnp.where(scale > 0, s / jnp.where(scale > 0, scale, 1.0), 0.0)
    return s[..., _normal_first(grasp)]


def contact_support(A: Array, direction: Array) -> tuple[Array, Array, Array]:
    """``h_i(d)`` (k,), the unit force that attains it (k, n), and |v_t| (k,), for A (k, m, n) and d (m,)."""
    v = jnp.einsum("kmn,m->kn", A, direction)
    tail = safe_root(jnp.sum(v[:, 1:] ** 2, axis=-1))
    unit = v[:, 1:] / jnp.where(tail > 0, tail, 1.0)[:, None]
    return v[:, 0] + tail, jnp.concatenate([jnp.ones_like(v[:, :1]), unit], axis=-1), tail


def extreme_force(A: Array, active: Array, norm: str, direction: Array) -> tuple[Array, Array]:
    """``h(d)`` and the scaled forces (k, n) of unit effort that attain it."""
    value, force, _ = contact_support(A, direction)
    if norm == "L1":
        value = jnp.where(active, value, -jnp.inf)
        best = jnp.argmax(value)
        used = (jnp.arange(value.shape[0]) == best) & (value[best] > 0)
    else:
        used = active & (value > 0)
    return jnp.sum(jnp.where(used, value, 0.0)), jnp.where(used[:, None], force, 0.0)


def support(A: Array, active: Array, norm: str, direction: Array) -> tuple[Array, Array, Array]:
    """``h(d)``, the outermost wrench (m,) of W along d, and its scaled forces (k, n)."""
    value, force = extreme_force(A, active, norm, direction)
    return value, jnp.einsum("kmn,kn->m", A, force), force


@eqx.filter_jit
def signed_supports(
    A: Float[Array, "*batch k m n"],
    active: Bool[Array, "*batch k"],
    norm: str,
    direction: Float[Array, "*batch D m"],
) -> Float[Array, "*batch D"]:
    """``h`` of directions (*batch, D, m) for A (*batch, k, m, n); ``max_i h_i < 0`` where no contact pushes along d."""
    v = jnp.einsum("...kmn,...dm->...dkn", A, direction)
    h = v[..., 0] + safe_root(jnp.sum(v[..., 1:] ** 2, axis=-1))
    h = jnp.where(active[..., None, :], h, -jnp.inf)
    most = largest_of(h)
    if norm == "L1":
        return most
    return jnp.where(most > 0, jnp.sum(jnp.maximum(h, 0.0), axis=-1), most)
