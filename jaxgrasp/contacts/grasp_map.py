"""The grasp map G (11.1), its folded form, rank, null space and internal forces."""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp

from ..conic import null_basis, singular_values
from ..core import (
    Array,
    Float,
    Int,
    contact_frame,
    cross,
    largest_of,
    normalize,
    rank_tolerance,
    wrench_dimension,
)
from .grasp import Grasp
from .models import Component
from .validity import cleared

__all__ = [
    "contact_wrenches",
    "folded_grasp_map",
    "grasp_map",
    "grasp_rank",
    "grasp_singular_values",
    "internal_force_part",
    "length_scale",
    "null_space",
]


@eqx.filter_jit
def contact_wrenches(
    position: Float[Array, "*batch k d"],
    normal: Float[Array, "*batch k d"],
    components: tuple[Component, ...],
) -> Float[Array, "*batch k m n"]:
    """``G_i = [t1 t2 n 0; p x t1, p x t2, p x n, n]``, the columns chosen by ``components``.

    ``normal`` must have unit length. Column j is the wrench of a unit force (or torque) along component j.
    """
    tangents = contact_frame(normal)
    direction = {
        Component.TANGENT_1: tangents[0],
        Component.TANGENT_2: tangents[-1],
        Component.NORMAL: normal,
    }
    columns = []
    for component in components:
        if component is Component.SPIN:
            columns.append(jnp.concatenate([jnp.zeros_like(normal), normal], axis=-1))
        else:
            d = direction[component]
            columns.append(jnp.concatenate([d, cross(position, d)], axis=-1))
    return jnp.stack(columns, axis=-1)


def _stacked(grasp: Grasp, *, folded: bool) -> Array:
    grasp = cleared(grasp)
    columns = contact_wrenches(
        grasp.position, normalize(grasp.normal), grasp.model.components(grasp.dimension)
    )
    if folded:
        columns = columns * grasp.model.scaling(grasp.dimension)[..., None, :]
    columns = jnp.where(grasp.active[..., None, None], columns, 0.0)
    joined = jnp.moveaxis(columns, -3, -2)  # (*batch, m, k, n)
    return joined.reshape(*joined.shape[:-2], -1)


@eqx.filter_jit
def grasp_map(grasp: Grasp) -> Float[Array, "*batch m kn"]:
    """``G = [G_1 .. G_k]`` with ``w = G f`` (11.1): contact forces in N (N m) to the wrench they apply.

    Returns (*batch, m, k n); force components in the chapter's order; columns of inactive contacts are zero.
    """
    return _stacked(grasp, folded=False)


@eqx.filter_jit
def folded_grasp_map(grasp: Grasp) -> Float[Array, "*batch m kn"]:
    """``A = G diag(mu, mu, 1, gamma)``: the grasp map on scaled forces s, each contact in |s_t| <= s_n.

    Its range is the span of what the friction cones can do, so its rank is the one that counts.
    """
    return _stacked(grasp, folded=True)


@eqx.filter_jit
def length_scale(grasp: Grasp) -> Float[Array, "*batch"]:
    """``L = max_i |p_i|`` over the active contacts in m, or 1 where that is zero."""
    largest = largest_of(jnp.sum(cleared(grasp).position ** 2, axis=-1))
    there = largest > 0
    return jnp.where(there, jnp.sqrt(jnp.where(there, largest, 1.0)), 1.0)


def _per_length(grasp: Grasp, matrix: Array) -> Array:
    """Divide torque rows by L, so that no rank decision depends on the unit of length."""
    m = wrench_dimension(grasp.dimension)
    row = jnp.arange(m) < grasp.dimension
    return matrix * jnp.where(row, 1.0, 1 / length_scale(grasp)[..., None])[..., None]


@eqx.filter_jit
def grasp_singular_values(grasp: Grasp) -> Float[Array, "*batch m"]:
    """Singular values of the folded map with lengths divided by L, largest first; no unit."""
    return singular_values(_per_length(grasp, folded_grasp_map(grasp)))


@eqx.filter_jit
def grasp_rank(grasp: Grasp) -> Int[Array, "*batch"]:
    """Rank of the folded grasp map: singular values above ``64 eps`` times the largest one."""
    values = grasp_singular_values(grasp)
    return jnp.sum(values > rank_tolerance(grasp.dtype) * values[..., :1], axis=-1)


@eqx.filter_jit
def null_space(grasp: Grasp) -> Float[Array, "*batch kn kn"]:
    """Orthonormal V with ``G V = 0``, basis of the internal forces (11.15), padded with zero columns.

    Only components that exist carry internal force: none at inactive contacts, no tangential one where mu =
    0, no spin where gamma = 0. With c such components and r the rank of the folded map, the first c - r
    columns are the basis (erratum 6: c - m only at full rank); the rest are zero, so the shape does not
    depend on the numbers.
    """
    G = _per_length(grasp, grasp_map(grasp))
    scale = jnp.where(grasp.active[..., None], grasp.model.scaling(grasp.dimension), 0.0)
    exists = (scale != 0).reshape(*scale.shape[:-2], -1)
    return null_basis(jnp.where(exists[..., None, :], G, 0.0), exists, rank_tolerance(grasp.dtype))


@eqx.filter_jit
def internal_force_part(grasp: Grasp, force: Float[Array, "*batch kn"]) -> Float[Array, "*batch kn"]:
    """``V V^T f``: the internal (squeeze) part of f in N, the one that applies no net wrench."""
    V = null_space(grasp)
    return jnp.einsum("...ij,...kj,...k->...i", V, V, force)
