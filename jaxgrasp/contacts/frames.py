"""Contact frames, and contact forces in contact, body or world axes.

    F_i = [t_1 t_2 n]        f_vec = B f,   B_i = [t_1 t_2 n 0; 0 0 0 n]        J_contact = B^T J_vec

Components in the contact's own frame are what cones and criteria are written in. A person, a simulator or a hand's
kinematics often speak of vectors in the axes of the body or of the world.
"""

from __future__ import annotations

from typing import Literal

import equinox as eqx
import jax.numpy as jnp
from jax.typing import ArrayLike

from ..core import Array, Float, contact_frame, normalize, orientation_matrix, real_array
from .grasp import Grasp
from .models import Component
from .validity import cleared

__all__ = ["Axes", "TorqueLimits", "component_vectors", "contact_frames", "force_vectors"]

Axes = Literal["contact", "body", "world"]


def contact_frames(grasp: Grasp) -> Float[Array, "*batch k d d"]:
    """``F_i = [t_1 t_2 n]`` in space, ``[t n]`` in the plane: the axes of contact i as columns, in body axes.

    Rotations where the contact is in space: ``t_1 x t_2 = n``; in the plane ``t x n = +e_z``. No unit. ``F_i f_i`` is
    the force of a hard finger, in N and body axes, and ``F_i^T J_i`` the rows of a hand Jacobian in contact axes (for
    all contact models at once: ``TorqueLimits(J, tau_max, axes="body")``). Those of the last axis where a contact is
    inactive; NaN where an active one has a normal that is zero or not finite.

    ValueError where ``grasp`` is no ``Grasp``. Source: Duff et al., Building an orthonormal basis, revisited, 2017.
    """
    if not isinstance(grasp, Grasp):
        raise ValueError(f"contact_frames takes a jaxgrasp.Grasp, got {type(grasp).__name__}")
    normal = normalize(cleared(grasp).normal)
    return jnp.stack([*contact_frame(normal), normal], axis=-1)


def component_vectors(
    grasp: Grasp, *, axes: Axes = "body", orientation: Float[ArrayLike, "*batch o"] | None = None
) -> Float[Array, "*batch k r n"]:
    """``B_i``: what a unit of each force component is as a vector, ``f_vec,i = B_i f_i``.

    axes         "body" or "world"; "contact" gives the identity
    orientation  of the body in the world, for "world": (*batch, 4) unit quaternion (w, x, y, z), in the plane
                 (*batch, 1) an angle in rad

    r = d (force) for frictionless and hard contacts, 2 d in space for soft ones (force; torque about the contact).
    No unit. ValueError for unknown axes or a missing orientation.
    """
    components = grasp.model.components(grasp.dimension)
    if axes == "contact":
        n = len(components)
        return jnp.broadcast_to(jnp.eye(n, dtype=grasp.dtype), (*grasp.batch_shape, grasp.contacts, n, n))
    if axes not in ("body", "world"):
        raise ValueError(f"axes must be 'contact', 'body' or 'world', got {axes!r}")
    frames = contact_frames(grasp)
    if axes == "world":
        if orientation is None:
            raise ValueError("world axes need orientation=(w, x, y, z) of the body, in the plane (angle,)")
        turn = orientation_matrix(real_array(orientation, "orientation").astype(grasp.dtype))
        frames = turn[..., None, :, :] @ frames
    column = {
        Component.TANGENT_1: frames[..., 0],
        Component.TANGENT_2: frames[..., -2],
        Component.NORMAL: frames[..., -1],
    }
    nothing = jnp.zeros_like(frames[..., -1])
    if Component.SPIN not in components:
        return jnp.stack([column[c] for c in components], axis=-1)
    columns = [
        jnp.concatenate([nothing, frames[..., -1]] if c is Component.SPIN else [column[c], nothing], axis=-1)
        for c in components
    ]
    return jnp.stack(columns, axis=-1)


def force_vectors(
    grasp: Grasp,
    force: Float[ArrayLike, "*batch kn"],
    *,
    axes: Axes = "body",
    orientation: Float[ArrayLike, "*batch o"] | None = None,
) -> Float[Array, "*batch k r"]:
    """``f_vec,i = B_i f_i``: contact forces as vectors in body or world axes, contact by contact.

    force        (*batch, k n) components in contact axes, as every answer gives them; N, torques N m
    axes         "body", "world" or "contact"; orientation: as for ``component_vectors``

    Returns (*batch, k, r): r = d, the force in N; for soft fingers r = 2 d, force in N and torque in N m about the
    contact. ValueError for a wrong shape or unknown axes.
    """
    B = component_vectors(grasp, axes=axes, orientation=orientation)
    n = B.shape[-1]
    force = real_array(force, "force")
    if force.ndim < 1 or force.shape[-1] != grasp.contacts * n:
        raise ValueError(f"force must have shape (*batch, {grasp.contacts * n}), got {force.shape}")
    parts = force.reshape(*force.shape[:-1], grasp.contacts, n)
    return jnp.sum(B * parts[..., None, :], axis=-1)


class TorqueLimits(eqx.Module):
    """``|J^T f| <= tau_max``: what the joints of a hand can produce, with J in the axes of your choice.

    jacobian     (*batch, R, q) maps joint rates to the velocities of the contacts, row for row of the forces in these
                 axes: contact axes R = k n, body and world axes R = k d (soft fingers: 2 k d, velocity then rotation)
    torque       (q) or (*batch, q), N m, positive; infinite: no limit
    axes         "contact" (default), "body" or "world"
    orientation  of the body in the world, for world axes, as for ``component_vectors``

    A plain pair (J, tau_max) means contact axes.
    """

    jacobian: Float[Array, "*batch R q"]
    torque: Float[Array, "*batch q"]
    orientation: Float[Array, "*batch o"] | None
    axes: Axes = eqx.field(static=True)

    def __init__(
        self,
        jacobian: Float[ArrayLike, "*batch R q"],
        torque: Float[ArrayLike, "*batch q"],
        *,
        axes: Axes = "contact",
        orientation: Float[ArrayLike, "*batch o"] | None = None,
    ):
        if axes not in ("contact", "body", "world"):
            raise ValueError(f"axes must be 'contact', 'body' or 'world', got {axes!r}")
        self.jacobian, self.torque = (
            real_array(jacobian, "the hand Jacobian J"),
            real_array(torque, "tau_max"),
        )
        self.orientation = None if orientation is None else real_array(orientation, "orientation")
        self.axes = axes

    def in_contact_axes(self, grasp: Grasp) -> tuple[Float[Array, "*batch kn q"], Float[Array, "*batch q"]]:
        """``J_contact = B^T J`` and tau_max, in N m per N: what the solver takes."""
        if self.axes == "contact":
            return self.jacobian, self.torque
        B = component_vectors(grasp, axes=self.axes, orientation=self.orientation)
        k, r, n = grasp.contacts, B.shape[-2], B.shape[-1]
        if self.jacobian.ndim < 2 or self.jacobian.shape[-2] != k * r:
            raise ValueError(
                f"the hand Jacobian J in {self.axes} axes must have shape (*batch, {k * r}, q): {r} rows for each of "
                f"{k} contacts, one column for each joint, got {self.jacobian.shape}"
            )
        rows = self.jacobian.reshape(*self.jacobian.shape[:-2], k, r, -1).astype(grasp.dtype)
        turned = jnp.einsum("...krn,...krq->...knq", B, rows)
        return turned.reshape(*turned.shape[:-3], k * n, turned.shape[-1]), self.torque
