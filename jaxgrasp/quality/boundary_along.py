"""Where a ray leaves the wrenches of unit effort, and the normal there: convex programs climb to the weakest direction.

    rho(d) = max {rho : rho d in W} = 1 / min {effort(f) : G f = d, f in C}

The optimal multipliers of that program are the normal n of a supporting hyperplane of W at rho d, and h(n) <= h(d) for
unit n and d. Repeated, it ends at a local minimum of h on the sphere, in two or three shots: maximising the convex |d|
over the polar of W by linearisation. Several starts find the smallest one, which is epsilon.
"""

from __future__ import annotations

import jax.numpy as jnp

from ..contacts import Grasp
from ..core import Array, Float, Status
from ..forces import Gentlest, SmallestSum, optimize_forces

__all__ = ["facet_normal"]


def facet_normal(
    grasp: Grasp, norm: str, length: Float[Array, " B"], direction: Float[Array, "B D m"]
) -> Float[Array, "B D m"]:
    """Unit normals of W where the rays along ``direction`` leave it: ``h(normal) <= h(direction)``.

    norm    effort, "L1" or "Linf"           length  m: wrenches are (F; tau / length)

    Where the ray never enters W, a direction along which no contact pushes; where the solver stalls, the ray's own.
    """
    force = jnp.arange(direction.shape[-1], dtype=jnp.int32) < grasp.dimension
    scale = jnp.where(force, 1.0, length[..., None])[:, None]
    found = optimize_forces(
        grasp, -direction * scale, criterion=SmallestSum() if norm == "L1" else Gentlest()
    )
    held = (found.status == Status.OPTIMAL.value)[..., None]
    normal = -scale * jnp.where(held, found.load_twist, found.escape_twist)
    square = jnp.sum(normal * normal, axis=-1, keepdims=True)
    sound = jnp.isfinite(square) & (square > 0)
    return jnp.where(sound, normal / jnp.sqrt(jnp.where(sound, square, 1.0)), direction)
