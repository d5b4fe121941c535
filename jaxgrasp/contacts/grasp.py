"""A grasp: contacts on a rigid body, its grasp map G, rank, null space and internal forces.

The body frame sits at the centre of mass. Contact i has position p_i (m), inward unit normal n_i and
tangents with t_1 x t_2 = n. A wrench is (force in N; torque about the centre of mass in N m), m = 6 entries
in space and 3 in the plane; a twist is (velocity in m/s; angular velocity in rad/s).
"""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from ..core import Array, ArrayLike, Bool, Float, Index, as_array, part_of, placed, real_array, widened
from .models import ContactModel

__all__ = ["Grasp"]


def _vectors(value: ArrayLike, name: str) -> Array:
    array = real_array(value, name, "an array of shape (*batch, k, 3) or (*batch, k, 2)")
    if array.ndim < 2 or array.shape[-1] not in (2, 3) or array.shape[-2] < 1:
        raise ValueError(
            f"{name} must have shape (*batch, k, 3) in space or (*batch, k, 2) in the plane with k >= 1 "
            f"contacts, got {array.shape}"
        )
    return array


def _per_contact(value: Array, shape: tuple[int, ...], name: str) -> Array:
    try:
        return widened(value, shape)
    except ValueError as error:
        raise ValueError(
            f"{name} must be a number or broadcast to one value per contact, shape {shape}, got {value.shape}"
        ) from error


class Grasp(eqx.Module):
    """Contacts of one grasp, or of a batch of them, on a rigid body.

    position  (*batch, k, 3) or (*batch, k, 2)  contact points relative to the centre of mass, body axes, m
    normal    the same shape                    inward normals; any length but zero
    model     a contact model                   coefficients broadcast to one per contact, (*batch, k)
    active    (*batch, k) bool, optional        False marks padding: that contact does not exist

    Wrong shapes and types raise ValueError; wrong numbers (NaN, zero normal, mu < 0) make the lane INVALID.
    """

    position: Float[Array, "*batch k d"]
    normal: Float[Array, "*batch k d"]
    model: ContactModel
    active: Bool[Array, "*batch k"]

    def __init__(
        self,
        position: Float[ArrayLike, "*batch k d"],
        normal: Float[ArrayLike, "*batch k d"],
        model: ContactModel,
        active: Bool[ArrayLike, "*batch k"] | None = None,
    ):
        position, normal = _vectors(position, "position"), _vectors(normal, "normal")
        if not isinstance(model, ContactModel):
            raise ValueError(
                f"model must be a contact model such as jaxgrasp.HardFinger(friction=0.5), got {model!r}"
            )
        if position.shape[-2:] != normal.shape[-2:]:
            raise ValueError(
                "position and normal must agree in contacts and dimension, "
                f"got {position.shape} and {normal.shape}"
            )
        try:
            shape = jnp.broadcast_shapes(position.shape, normal.shape)
        except ValueError as error:
            raise ValueError(
                f"the batch axes of position {position.shape} and normal {normal.shape} do not broadcast"
            ) from error
        model.components(shape[-1])  # a planar soft finger raises here
        dtype = jnp.result_type(position.dtype, normal.dtype)
        self.position = widened(position.astype(dtype), shape)
        self.normal = widened(normal.astype(dtype), shape)
        contacts = shape[:-1]
        self.model = model.with_coefficients(
            _per_contact(model.friction_coefficient.astype(dtype), contacts, "friction"),
            _per_contact(model.torsion_coefficient.astype(dtype), contacts, "torsion"),
        )
        if active is None:
            self.active = placed(np.ones(contacts, bool))
        else:
            mask = as_array(active)
            if mask.dtype != jnp.bool_:
                raise ValueError(f"active must be boolean, one per contact, got dtype {mask.dtype}")
            self.active = _per_contact(mask, contacts, "active")

    @property
    def dimension(self) -> int:
        """2 in the plane, 3 in space."""
        return self.position.shape[-1]

    @property
    def contacts(self) -> int:
        """k, counting padding."""
        return self.position.shape[-2]

    @property
    def batch_shape(self) -> tuple[int, ...]:
        """Axes in front of the contacts'; () for a single grasp."""
        return self.position.shape[:-2]

    @property
    def dtype(self) -> np.dtype:
        """The dtype of all its real numbers."""
        return self.position.dtype

    def __getitem__(self, index: Index) -> Grasp:
        """The grasps at ``index`` of the batch."""
        if not self.batch_shape:
            raise IndexError("a single grasp has no batch axis to index")
        return part_of(self, index)
