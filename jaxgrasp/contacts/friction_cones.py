"""Contact forces and their friction cones: how near the edge, and the nearest forces inside."""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp

from ..core import Array, Float, largest_of, safe_root
from .grasp import Grasp
from .validity import cleared

__all__ = ["cone_use", "into_cones", "nearest_admissible"]


def _scaled(grasp: Grasp, force: Array) -> tuple[Array, Array, int]:
    """(*batch, k, n) forces over their scaling, zero where a component does not exist; the scaling; f_n's place."""
    scale = jnp.where(grasp.active[..., None], cleared(grasp).model.scaling(grasp.dimension), 0.0)
    parts = force.reshape(*force.shape[:-1], grasp.contacts, scale.shape[-1])
    safe = jnp.where(scale > 0, scale, 1.0)
    return jnp.where(scale > 0, parts / safe, 0.0), scale, grasp.model.normal_index(grasp.dimension)


def _split(scaled: Array, index: int) -> tuple[Array, Array]:
    """Normal component and psi."""
    normal = scaled[..., index]
    square = jnp.sum(scaled * scaled, axis=-1) - normal * normal
    return normal, safe_root(square)


@eqx.filter_jit
def cone_use(grasp: Grasp, force: Float[Array, "*batch kn"]) -> Float[Array, "*batch"]:
    """``max_i psi_i(f_i) / f_n,i``: 0 for normal forces alone, 1 at the edge of friction, infinite beyond all cones."""
    scaled, _, index = _scaled(grasp, force)
    normal, psi = _split(scaled, index)
    use = jnp.where(psi == 0, 0.0, psi / jnp.where(normal > 0, normal, 1.0))
    use = jnp.where((normal < 0) | ((normal == 0) & (psi > 0)), jnp.inf, use)
    return largest_of(use)


@eqx.filter_jit
def into_cones(
    grasp: Grasp, force: Float[Array, "*batch kn"], *, cap: Float[Array, "*batch k"] | None = None
) -> Float[Array, "*batch kn"]:
    """``force`` with friction cut down to its cone, pulls to zero, and normal forces to ``cap``: last digits only."""
    scaled, scale, index = _scaled(grasp, force)
    normal, psi = _split(scaled, index)
    kept = jnp.maximum(normal, 0.0)
    if cap is not None:
        kept = jnp.minimum(kept, cap)
    share = jnp.where(psi > kept, kept / jnp.where(psi > 0, psi, 1.0), 1.0)
    parts = (scaled * share[..., None]).at[..., index].set(kept) * scale
    return parts.reshape(force.shape)


@eqx.filter_jit
def nearest_admissible(grasp: Grasp, force: Float[Array, "*batch kn"]) -> Float[Array, "*batch kn"]:
    """The forces in the cones nearest to ``force``, distances measured in (f_x / mu, f_y / mu, f_n, tau_n / gamma).

    Each contact is projected onto its unit second-order cone: itself inside, zero in the polar cone, else halfway.
    """
    scaled, scale, index = _scaled(grasp, force)
    normal, psi = _split(scaled, index)
    level = jnp.where(psi <= normal, normal, jnp.where(psi <= -normal, 0.0, (normal + psi) / 2))
    share = jnp.where(psi > level, level / jnp.where(psi > 0, psi, 1.0), 1.0)
    parts = (scaled * share[..., None]).at[..., index].set(level) * scale
    return parts.reshape(force.shape)
