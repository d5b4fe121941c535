"""Grasped objects in MuJoCo, the only module that imports it: thousands at a time in MJX, one at a time in C.

The model is one body on a free joint, with the object's mass and inertia, and without contacts: the contact forces of
the grasp are applied as a wrench at the centre of mass, and turn with the body. MuJoCo's own conventions stay inside:
a free joint's velocity is (velocity in world axes; angular velocity in body axes), its rotation a quaternion. Outside
there are the states of ``dynamics``, and derivatives live in the tangent space (translation; rotation vector; velocity;
angular velocity), 12 entries in world axes.
"""

from __future__ import annotations

import contextlib
import io
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from ..contacts import Grasp
from ..core import Array, Float, applied, rotate, rotation_between, turned
from .rigid_body import BodyState, RigidBody, gravity_vector, world_grasp_map

if TYPE_CHECKING:
    import mujoco
    import trimesh
    from mujoco import mjx

__all__ = ["MujocoPlant", "mujoco_model", "mujoco_plant", "tangent", "tangent_difference"]

TEMPLATE = """
<mujoco model="grasped object">
  <option timestep="{timestep!r}" gravity="{gravity}"/>
  <asset>{asset}</asset>
  <worldbody>
    <light pos="0.3 -0.3 1" dir="-0.3 0.3 -1"/>
    <body name="object"><freejoint/>
      <inertial pos="0 0 0" mass="{mass!r}" diaginertia="{moments}" quat="{axes}"/>{geometry}
    </body>
  </worldbody>
</mujoco>
"""
SMALLEST = 1e-15  # kg and kg m^2, MuJoCo's own bound
STILL = 1.1e-8  # rad/s, just above MJX's own threshold
GEOMETRY = '<geom name="object" type="mesh" mesh="object" contype="0" conaffinity="0" rgba=".75 .75 .8 1"/>'


def _mjx() -> Any:
    """``mujoco.mjx``, whose import otherwise prints that an optional package is missing."""
    with contextlib.redirect_stdout(io.StringIO()):
        from mujoco import mjx

    return mjx


def _words(values: Any) -> str:
    return " ".join(repr(float(x)) for x in np.asarray(values).ravel())


def mujoco_model(
    body: RigidBody,
    *,
    timestep: float = 0.002,
    gravity: Float[ArrayLike, "*batch d"] | None = None,
    mesh: trimesh.Trimesh | None = None,
) -> mujoco.MjModel:  # pyright: ignore[reportAttributeAccessIssue]
    """A ``mujoco.MjModel`` of one body: mass, inertia, free joint, no contacts; semi-implicit Euler of ``timestep`` s.

    mesh  a ``trimesh.Trimesh`` in body axes (origin at the centre of mass, m) to look at; it takes no part in contacts
    """
    import mujoco

    engine: Any = mujoco  # a compiled module without types
    _spatial(body)
    if body.batch_shape:
        raise ValueError(f"a MuJoCo model holds one body, this one has batch axes {body.batch_shape}")
    if not isinstance(timestep, int | float) or not 0 < timestep < 1:
        raise ValueError(f"timestep must be a positive number of seconds below 1, got {timestep!r}")
    moments, axes = _principal(np.asarray(body.inertia, np.float64)[None])
    _large_enough(float(body.mass), moments[0])
    g = np.asarray(gravity_vector(gravity, 3, body.dtype), np.float64)
    assets, asset = {}, ""
    if mesh is not None:
        asset = '<mesh name="object" file="object.obj" inertia="shell"/>'
        assets = {"object.obj": str(mesh.export(file_type="obj")).encode()}
    xml = TEMPLATE.format(
        timestep=float(timestep),
        gravity=_words(g),
        asset=asset,
        mass=float(body.mass),
        moments=_words(moments[0]),
        axes=_words(axes[0]),
        geometry=GEOMETRY if mesh is not None else "",
    )
    return engine.MjModel.from_xml_string(xml, assets)


def _spatial(body: RigidBody) -> None:
    if not isinstance(body, RigidBody) or body.dimension != 3:
        raise ValueError("MuJoCo simulates spatial bodies: RigidBody(mass, inertia) with a 3 x 3 inertia")


def _large_enough(mass: float, moments: np.ndarray) -> None:
    """MuJoCo takes what is below ``SMALLEST`` for zero."""
    if not min(mass, moments.min()) > SMALLEST:
        raise ValueError(
            f"too small for MuJoCo: mass {mass:.3g} kg and least principal moment {moments.min():.3g} kg m^2 must "
            f"exceed {SMALLEST:g}; give them in smaller units, such as g and mm"
        )


def tangent(state: BodyState, change: Float[Array, "*batch 12"]) -> BodyState:
    """``state`` moved by (translation; rotation vector; velocity; angular velocity), world axes."""
    m = state.velocity.shape[-1]
    return state.displaced(change[..., :m], change[..., m:])


def tangent_difference(state: BodyState, reference: BodyState) -> Float[Array, "*batch 12"]:
    """The change that takes ``reference`` to ``state``: the inverse of ``tangent``."""
    turn = rotation_between(state.orientation, reference.orientation)
    return jnp.concatenate(
        [state.position - reference.position, turn, state.velocity - reference.velocity], axis=-1
    )


class MujocoPlant(eqx.Module):
    """MJX's model of each object of a batch; made by ``mujoco_plant``. Works under ``jit``, ``vmap``, ``grad``.

    model     an ``mjx.Model`` whose mass and inertia carry the batch axes
    template  an ``mjx.Data`` of that model
    """

    model: mjx.Model
    template: mjx.Data
    batch_shape: tuple[int, ...] = eqx.field(static=True)

    @property
    def timestep(self) -> Float[Array, ""]:
        """Seconds of one step."""
        return self.model.opt.timestep

    def _over_batch(self, function: Any, *arguments: Any) -> Any:
        axes = jax.tree.map(lambda _: None, self.model)
        axes = axes.replace(**dict.fromkeys(BATCHED, 0))
        for _ in self.batch_shape:
            function = jax.vmap(function, in_axes=(axes, *[0] * len(arguments)))
        return function(self.model, *arguments)

    def _data(self, state: BodyState, wrench: Array) -> Any:
        qpos = jnp.concatenate([state.position, state.orientation])
        spin = rotate(state.orientation, state.velocity[3:], inverse=True)
        qvel = jnp.concatenate([state.velocity[:3], spin])
        applied = jnp.zeros((2, 6), wrench.dtype).at[1].set(wrench)
        return self.template.replace(qpos=qpos, qvel=qvel, xfrc_applied=applied)

    def _step(self, model: Any, state: BodyState, wrench: Array) -> BodyState:
        with jax.numpy_dtype_promotion("standard"):  # MJX mixes integers, booleans and floats
            data = _mjx().step(model, self._data(state, wrench))
        # MJX takes angular velocities below 1e-8 for none: right to rounding in value, but its derivative of the
        # rotation by the angular velocity is then 0 instead of h. There the rotation is ours.
        spin = rotate(state.orientation, data.qvel[3:])
        still = jnp.all(jnp.abs(data.qvel[3:]) <= STILL)
        orientation = jnp.where(still, turned(state.orientation, model.opt.timestep * spin), data.qpos[3:])
        spin = rotate(orientation, data.qvel[3:])
        return BodyState(data.qpos[:3], orientation, jnp.concatenate([data.qvel[:3], spin]))

    def _qacc(self, model: Any, state: BodyState, wrench: Array) -> Array:
        with jax.numpy_dtype_promotion("standard"):
            qacc = _mjx().forward(model, self._data(state, wrench)).qacc
        return jnp.concatenate([qacc[:3], rotate(state.orientation, qacc[3:])])

    @eqx.filter_jit
    def advance(self, state: BodyState, wrench: Float[Array, "*batch 6"]) -> BodyState:
        """One step of MuJoCo under ``wrench`` (N, N m; world axes, at the centre of mass)."""
        return self._over_batch(self._step, state, wrench)

    @eqx.filter_jit
    def acceleration(self, state: BodyState, wrench: Float[Array, "*batch 6"]) -> Float[Array, "*batch 6"]:
        """MuJoCo's ``qacc`` in world axes, m/s^2 and rad/s^2."""
        return self._over_batch(self._qacc, state, wrench)

    @eqx.filter_jit
    def roll_out(self, state: BodyState, grasp: Grasp, force: Float[Array, "t *batch kn"]) -> BodyState:
        """The states (T, *batch) after each of T steps with the contact forces ``force[0]``, ``force[1]`` .."""

        def step(now: BodyState, f: Array) -> tuple[BodyState, BodyState]:
            after = self.advance(now, applied(world_grasp_map(grasp, now.orientation), f))
            return after, after

        return jax.lax.scan(step, state, force)[1]

    @eqx.filter_jit
    def step_derivatives(
        self, state: BodyState, grasp: Grasp, force: Float[Array, "*batch kn"]
    ) -> tuple[Float[Array, "*batch 12 12"], Float[Array, "*batch 12 kn"]]:
        """A and B of MuJoCo's own step, ``x+ = A x + B f`` for tangent vectors at ``state`` and at its successor."""
        return self._derivatives(state, grasp, force, self._step_change)

    @eqx.filter_jit
    def acceleration_derivatives(
        self, state: BodyState, grasp: Grasp, force: Float[Array, "*batch kn"]
    ) -> tuple[Float[Array, "*batch 6 12"], Float[Array, "*batch 6 kn"]]:
        """d qacc / d x and d qacc / d f in world axes, x a tangent vector at ``state``."""
        return self._derivatives(state, grasp, force, lambda model, s, _, w: self._qacc(model, s, w))

    def _step_change(self, model: Any, state: BodyState, reference: BodyState, wrench: Array) -> Array:
        return tangent_difference(self._step(model, state, wrench), reference)

    def _derivatives(
        self, state: BodyState, grasp: Grasp, force: Array, function: Any
    ) -> tuple[Array, Array]:
        def one(model: Any, state: BodyState, grasp: Grasp, force: Array) -> tuple[Array, Array]:
            def changed(x: Array, f: Array) -> Array:
                moved = tangent(state, x)
                wrench = world_grasp_map(grasp, moved.orientation) @ f
                return function(model, moved, after, wrench)

            nominal = world_grasp_map(grasp, state.orientation) @ force
            after = self._step(model, state, nominal)
            return jax.jacfwd(changed, argnums=(0, 1))(jnp.zeros(12, force.dtype), force)

        # One grasp after another: MJX's independent batched LAPACK calls wait for each other for ever on few cores.
        return self._over_batch(jax.custom_batching.sequential_vmap(one), state, grasp, force)


BATCHED = ("body_mass", "body_subtreemass", "body_inertia", "body_iquat")


def _principal(inertia: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Principal moments (N, 3), the largest at most the sum of the others, and the quaternions (N, 4) of their axes."""
    moments, axes = np.linalg.eigh(inertia)
    moments[:, 2] = np.minimum(
        moments[:, 2], moments[:, 0] + moments[:, 1]
    )  # a flat body's is equal but for rounding
    axes[np.linalg.det(axes) < 0, :, 0] *= -1
    # Shepperd: from the largest of the four squares, so that nothing is divided by a small number
    a, trace = axes, np.trace(axes, axis1=-2, axis2=-1)
    squares = np.stack([trace, a[:, 0, 0], a[:, 1, 1], a[:, 2, 2]], axis=-1)
    w = [1 + trace, a[:, 2, 1] - a[:, 1, 2], a[:, 0, 2] - a[:, 2, 0], a[:, 1, 0] - a[:, 0, 1]]
    x = [w[1], 1 + 2 * a[:, 0, 0] - trace, a[:, 0, 1] + a[:, 1, 0], a[:, 0, 2] + a[:, 2, 0]]
    y = [w[2], x[2], 1 + 2 * a[:, 1, 1] - trace, a[:, 1, 2] + a[:, 2, 1]]
    z = [w[3], x[3], y[3], 1 + 2 * a[:, 2, 2] - trace]
    rows = np.stack([np.stack(r, axis=-1) for r in (w, x, y, z)], axis=1)
    chosen = rows[np.arange(len(a)), squares.argmax(-1)]
    return moments, chosen / np.linalg.norm(chosen, axis=-1, keepdims=True)


def mujoco_plant(
    body: RigidBody, *, timestep: float = 0.002, gravity: Float[ArrayLike, "*batch d"] | None = None
) -> MujocoPlant:
    """MJX models of all bodies of a batch, semi-implicit Euler steps of ``timestep`` s, gravity in m/s^2, world axes.

    The body must be concrete (its principal axes are found once, on the host) and valid in every lane.
    """
    _spatial(body)
    if not bool(np.all(body.valid)):
        bad = np.argwhere(~np.asarray(body.valid))[0].tolist()
        raise ValueError(f"body {bad} is none (mass or inertia): leave it out, or see RigidBody.valid")
    first = jax.tree.map(lambda x: x[(0,) * len(body.batch_shape)], body)
    host = mujoco_model(first, timestep=timestep, gravity=gravity)
    mjx, shape, dtype = _mjx(), body.batch_shape, body.dtype
    model = mjx.put_model(host, impl="jax")
    moments, axes = _principal(np.asarray(body.inertia, np.float64).reshape(-1, 3, 3))
    mass = np.asarray(body.mass, np.float64).reshape(-1)
    _large_enough(float(mass.min()), moments)

    def both(world: np.ndarray, object_: np.ndarray) -> Array:
        pair = np.stack([np.broadcast_to(world, object_.shape), object_], axis=1)
        return jnp.asarray(pair.reshape(*shape, *pair.shape[1:]), dtype)

    model = model.replace(
        body_mass=both(np.zeros(()), mass),
        body_subtreemass=both(mass, mass),
        body_inertia=both(np.zeros(3), moments),
        body_iquat=both(np.array([1.0, 0, 0, 0]), axes),
    )
    return MujocoPlant(model, mjx.make_data(host, impl="jax"), shape)
