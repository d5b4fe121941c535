"""11.4, (11.18)-(11.24): a grasped rigid body moves by ``M(q) q'' + B(q, q') + G(q) = G^W(q) f``.

The body frame sits at the centre of mass; at the identity orientation it coincides with the world frame in which
gravity is given. Velocities are (velocity of the centre of mass; angular velocity), m = 6 entries in space and 3 in
the plane, both in world axes, m/s and rad/s. Contact forces turn with the body.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.typing import ArrayLike, DTypeLike

from ..conic import eigenvalues
from ..contacts import Grasp, grasp_map
from ..core import (
    Array,
    Bool,
    Float,
    applied,
    cross,
    identity_orientation,
    orientation_matrix,
    real_array,
    rotate,
    turned,
    unit_roundoff,
    wrench_dimension,
)

if TYPE_CHECKING:
    import trimesh

__all__ = [
    "BodyState",
    "RigidBody",
    "acceleration",
    "advance",
    "coriolis",
    "gravity_term",
    "gravity_vector",
    "mass_matrix",
    "world_grasp_map",
]

STANDARD_GRAVITY = 9.81  # m/s^2, along -z (-y in the plane)


class RigidBody(eqx.Module):
    """Mass and inertia of the object, or of a batch of objects.

    mass     (*batch) kg
    inertia  (*batch, 3, 3) kg m^2 about the centre of mass, body axes; in the plane (*batch), like the mass, or
             (*batch, 1, 1). Kept as (*batch, t, t), t = 3 or 1

    A body has mass > 0 and a symmetric, positive definite inertia whose principal moments obey the triangle inequality
    I_1 <= I_2 + I_3 (equality: a flat body). A single body that does not raises ValueError; in a batch, or under a
    transformation, ``valid`` is False in that lane and every answer about it says INVALID.
    """

    mass: Float[Array, "*batch"]
    inertia: Float[Array, "*batch t t"]

    def __init__(self, mass: Float[ArrayLike, "*batch"], inertia: Float[ArrayLike, "*batch t t"]):
        mass, inertia = real_array(mass, "mass"), real_array(inertia, "inertia")
        if inertia.shape == mass.shape:
            inertia = inertia[..., None, None]
        elif inertia.shape[-2:] not in ((3, 3), (1, 1)):
            raise ValueError(
                f"inertia must have shape (*batch, 3, 3), or in the plane the shape of the mass {mass.shape} or "
                f"(*batch, 1, 1), got {inertia.shape}"
            )
        try:
            batch = jnp.broadcast_shapes(mass.shape, inertia.shape[:-2])
        except ValueError as error:
            raise ValueError(
                f"the batch axes of mass {mass.shape} and inertia {inertia.shape} do not broadcast"
            ) from error
        dtype = jnp.result_type(mass.dtype, inertia.dtype)
        self.mass = jnp.broadcast_to(mass.astype(dtype), batch)
        self.inertia = jnp.broadcast_to(inertia.astype(dtype), (*batch, *inertia.shape[-2:]))
        if not batch and not isinstance(self.mass, Tracer) and not isinstance(self.inertia, Tracer):
            _complain(float(self.mass), np.asarray(self.inertia, np.float64), unit_roundoff(dtype))

    @classmethod
    def from_mesh(
        cls, mesh: trimesh.Trimesh, *, density: float | None = None, mass: float | None = None
    ) -> RigidBody:
        """The body inside a watertight ``trimesh.Trimesh`` in m, of uniform density (kg/m^3) or of this mass (kg).

        Axes are the mesh's; the origin moves to the centre of mass of the volume.
        """
        if (density is None) == (mass is None):
            raise ValueError("give either a density in kg/m^3 or a mass in kg")
        if not getattr(mesh, "is_watertight", False) or not mesh.volume > 0:
            raise ValueError(
                "the mesh encloses no volume: repair it, or give RigidBody(mass, inertia) yourself"
            )
        # In units of its size, since trimesh takes volumes below 1e-13 for none; along its length, width and height,
        # since a thin body's least moment would drown in the rounding of the others.
        size, unit = float(mesh.extents.max()), mesh.copy()
        centred = (unit.vertices - mesh.bounds.mean(axis=0)) / size
        axes = np.linalg.eigh(centred.T @ centred)[1]
        axes[:, 0] *= np.linalg.det(axes)
        unit.vertices, unit.density = centred @ axes, 1.0
        if mass is None:
            mass = density * unit.volume * size**3  # pyright: ignore[reportOptionalOperand]
        return cls(mass, mass / unit.volume * size**2 * (axes @ np.asarray(unit.moment_inertia) @ axes.T))

    @property
    def dimension(self) -> int:
        """2 in the plane, 3 in space."""
        return 3 if self.inertia.shape[-1] == 3 else 2

    @property
    def batch_shape(self) -> tuple[int, ...]:
        """The leading batch axes."""
        return self.mass.shape

    @property
    def dtype(self) -> np.dtype:
        """The arrays' common dtype."""
        return self.mass.dtype

    @property
    @jax.jit
    def valid(self) -> Bool[Array, "*batch"]:
        """Whether the numbers are those of a body."""
        finite = jnp.isfinite(self.mass) & jnp.all(jnp.isfinite(self.inertia), axis=(-1, -2))
        inertia = jnp.where(
            finite[..., None, None], self.inertia, jnp.eye(self.inertia.shape[-1], dtype=self.dtype)
        )
        transposed = jnp.swapaxes(inertia, -1, -2)
        largest = jnp.max(jnp.abs(inertia), axis=(-1, -2))
        slack = 64 * unit_roundoff(self.dtype) * largest
        good = finite & (self.mass > 0)
        good &= jnp.max(jnp.abs(inertia - transposed), axis=(-1, -2)) <= slack
        moments = eigenvalues((inertia + transposed) / 2)
        good &= moments[..., -1] > slack
        if self.dimension == 3:
            good &= moments[..., 0] <= moments[..., 1] + moments[..., 2] + slack
        return good

    @property
    @jax.jit
    def gyration_radius(self) -> Float[Array, "*batch"]:
        """``l = sqrt(tr I / m_B)`` in m: the length by which decisions are scaled."""
        return jnp.sqrt(jnp.trace(self.inertia, axis1=-2, axis2=-1) / self.mass)

    @property
    @jax.jit
    def inverse_inertia(self) -> Float[Array, "*batch t t"]:
        """I^-1 in body axes, in closed form: the cross products of its columns over its determinant."""
        if self.dimension == 2:
            return 1 / self.inertia
        a, b, c = (self.inertia[..., i] for i in range(3))
        rows = jnp.stack([cross(b, c), cross(c, a), cross(a, b)], axis=-2)
        return rows / jnp.sum(a * cross(b, c), axis=-1)[..., None, None]

    @jax.jit
    def where(self, keep: Bool[Array, "*batch"]) -> RigidBody:
        """This body where ``keep``; elsewhere a unit one, so that no NaN enters a computation."""
        unit = jnp.eye(self.inertia.shape[-1], dtype=self.dtype)
        mass = jnp.where(keep, self.mass, jnp.ones_like(self.mass))
        inertia = jnp.where(keep[..., None, None], self.inertia, unit)
        return eqx.tree_at(lambda body: (body.mass, body.inertia), self, (mass, inertia))


def _complain(mass: float, inertia: np.ndarray, eps: float) -> None:
    if not (np.isfinite(mass) and mass > 0):
        raise ValueError(f"mass must be a positive number of kg, got {mass}")
    if not np.isfinite(inertia).all():
        raise ValueError("inertia must hold finite numbers")
    slack = 64 * eps * np.abs(inertia).max()
    if np.abs(inertia - inertia.T).max() > slack:
        raise ValueError(
            "inertia must be symmetric: average it with its transpose if the difference is rounding"
        )
    moments = np.linalg.eigvalsh(inertia)
    if not moments[0] > slack:
        raise ValueError(
            f"inertia must be positive definite, its principal moments are {moments} kg m^2: give the body some "
            "extent in every direction"
        )
    if len(moments) == 3 and moments[2] > moments[0] + moments[1] + slack:
        raise ValueError(
            f"no body has the principal moments {moments} kg m^2: each must be at most the sum of the other two "
            "(triangle inequality); check units and signs of the products of inertia"
        )


class BodyState(eqx.Module):
    """Where the object is and how it moves.

    position     (*batch, d) of the centre of mass, world axes, m
    orientation  (*batch, 4) unit quaternion (w, x, y, z), body to world; in the plane (*batch, 1), an angle in rad
    velocity     (*batch, m) (velocity; angular velocity), world axes, m/s and rad/s
    """

    position: Float[Array, "*batch d"]
    orientation: Float[Array, "*batch o"]
    velocity: Float[Array, "*batch m"]

    @property
    def dimension(self) -> int:
        """2 in the plane, 3 in space."""
        return self.position.shape[-1]

    @classmethod
    def at_rest(
        cls, dimension: int = 3, batch: tuple[int, ...] = (), *, dtype: DTypeLike = float
    ) -> BodyState:
        """At the origin, not turned, not moving: the equilibrium configuration of the chapter."""
        dtype = jnp.result_type(dtype)
        turn = identity_orientation(dimension, dtype)
        return cls(
            jnp.zeros((*batch, dimension), dtype),
            jnp.broadcast_to(turn, (*batch, *turn.shape)),
            jnp.zeros((*batch, wrench_dimension(dimension)), dtype),
        )

    def displaced(
        self, displacement: Float[Array, "*batch m"], velocity: Float[ArrayLike, "*batch m"] = 0.0
    ) -> BodyState:
        """Moved by (translation in m; rotation vector in rad), world axes, and ``velocity`` faster."""
        d = self.dimension
        return BodyState(
            self.position + displacement[..., :d],
            turned(self.orientation, displacement[..., d:]),
            self.velocity + velocity,
        )


def gravity_vector(
    gravity: Float[ArrayLike, "*batch d"] | None, dimension: int, dtype: DTypeLike
) -> Float[Array, "*batch d"]:
    """Gravity in m/s^2, world axes; None: 9.81 along -z, or -y in the plane."""
    standard = np.array([0.0] * (dimension - 1) + [-STANDARD_GRAVITY])
    array = real_array(standard if gravity is None else gravity, "gravity")
    if array.ndim < 1 or array.shape[-1] != dimension:
        raise ValueError(
            f"gravity must be a vector of {dimension} numbers in m/s^2, such as "
            f"{(0.0,) * (dimension - 1) + (-STANDARD_GRAVITY,)}, got shape {array.shape}"
        )
    return array.astype(dtype)


@eqx.filter_jit
def mass_matrix(body: RigidBody, orientation: Float[Array, "*batch o"]) -> Float[Array, "*batch m m"]:
    """``M(q) = [[m_B I, 0], [0, I^W]]`` (11.22), ``I^W = R I^B R^T``; kg and kg m^2."""
    d, t = body.dimension, body.inertia.shape[-1]
    inertia = body.inertia
    if t == 3:
        R = orientation_matrix(orientation)
        inertia = R @ inertia @ jnp.swapaxes(R, -1, -2)
    lead = jnp.broadcast_shapes(body.batch_shape, inertia.shape[:-2])
    linear = jnp.broadcast_to(body.mass[..., None, None] * jnp.eye(d, dtype=body.dtype), (*lead, d, d))
    inertia = jnp.broadcast_to(inertia, (*lead, t, t))
    upper = jnp.concatenate([linear, jnp.zeros((*lead, d, t), body.dtype)], axis=-1)
    lower = jnp.concatenate([jnp.zeros((*lead, t, d), body.dtype), inertia], axis=-1)
    return jnp.concatenate([upper, lower], axis=-2)


@eqx.filter_jit
def coriolis(body: RigidBody, state: BodyState) -> Float[Array, "*batch m"]:
    """``B(q, q') = (0; omega x I^W omega)`` (11.22), N and N m; zero in the plane."""
    d = state.dimension
    if d == 2:
        return jnp.zeros_like(state.velocity)
    omega = state.velocity[..., d:]
    momentum = rotate(
        state.orientation, applied(body.inertia, rotate(state.orientation, omega, inverse=True))
    )
    torque = cross(omega, momentum)
    return jnp.concatenate([jnp.zeros_like(torque), torque], axis=-1)


@eqx.filter_jit
def gravity_term(
    body: RigidBody, *, gravity: Float[ArrayLike, "*batch d"] | None = None
) -> Float[Array, "*batch m"]:
    """``G(q) = m_B g grad h = (-m_B gravity; 0)`` (11.23) in N: what the fingers must hold up."""
    d = body.dimension
    g = gravity_vector(gravity, d, body.dtype)
    force = -body.mass[..., None] * g
    return jnp.concatenate(
        [force, jnp.zeros((*force.shape[:-1], wrench_dimension(d) - d), body.dtype)], axis=-1
    )


@eqx.filter_jit
def world_grasp_map(grasp: Grasp, orientation: Float[Array, "*batch o"]) -> Float[Array, "*batch m kn"]:
    """``G^W(q) = diag(R, R) G`` (11.23): contact forces, which turn with the body, to the wrench in world axes."""
    G, d = grasp_map(grasp), grasp.dimension
    R = orientation_matrix(orientation)
    torque = R @ G[..., d:, :] if d == 3 else jnp.broadcast_to(G[..., d:, :], (*R.shape[:-2], 1, G.shape[-1]))
    return jnp.concatenate([R @ G[..., :d, :], torque], axis=-2)


@eqx.filter_jit
def acceleration(
    body: RigidBody,
    state: BodyState,
    wrench: Float[Array, "*batch m"],
    *,
    gravity: Float[ArrayLike, "*batch d"] | None = None,
) -> Float[Array, "*batch m"]:
    """``q'' = M^-1 (w - B - G)`` (11.21): m/s^2 and rad/s^2, world axes, under ``wrench`` (world axes, N, N m)."""
    d = state.dimension
    linear = wrench[..., :d] / body.mass[..., None] + gravity_vector(gravity, d, body.dtype)
    torque = wrench[..., d:]
    if d == 2:
        return jnp.concatenate([linear, torque / body.inertia[..., 0]], axis=-1)
    # in body axes the inertia and its inverse are constant
    omega = rotate(state.orientation, state.velocity[..., d:], inverse=True)
    torque = rotate(state.orientation, torque, inverse=True) - cross(omega, applied(body.inertia, omega))
    return jnp.concatenate(
        [linear, rotate(state.orientation, applied(body.inverse_inertia, torque))], axis=-1
    )


@eqx.filter_jit
def advance(
    body: RigidBody,
    state: BodyState,
    wrench: Float[Array, "*batch m"],
    *,
    timestep: float | Float[Array, ""],
    gravity: Float[ArrayLike, "*batch d"] | None = None,
) -> BodyState:
    """One semi-implicit Euler step of ``timestep`` s: ``v+ = v + h q''(q, v)``, ``q+ = q moved by h v+``.

    The scheme of MuJoCo's default integrator; the rotation is integrated exactly for the new angular velocity.
    """
    velocity = state.velocity + timestep * acceleration(body, state, wrench, gravity=gravity)
    moved = BodyState(state.position, state.orientation, velocity)
    return moved.displaced(timestep * velocity)
