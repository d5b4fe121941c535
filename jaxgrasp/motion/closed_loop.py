"""Closed loops: thousands of grasped objects under a controller and disturbances, all steps in one call."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.typing import ArrayLike

from ..contacts import Grasp, cone_use, grasp_map
from ..core import (
    Answer,
    Array,
    Bool,
    Float,
    Index,
    Int,
    Status,
    applied,
    real_array,
    rotate_wrench,
    wrench_dimension,
)
from .computed_torque import ContactController, Reference, tracking_error
from .mujoco import MujocoPlant
from .rigid_body import BodyState, RigidBody, advance

__all__ = ["ClosedLoop", "Simulation", "close_loop"]


@dataclass(frozen=True, eq=False)
class Simulation:
    """``steps`` steps of ``timestep`` s under ``gravity``: how a closed loop is run, and what is kept of it.

    steps     of the loop; the reference and the disturbance may have one entry for each
    timestep  s
    gravity   (*batch, d) m/s^2, world axes; None: 9.81 along -z, in the plane along -y
    plant     a ``mujoco_plant`` of the same body, timestep and gravity; None: the analytic ``advance``
    record    keep all states and forces

    ValueError where steps or timestep are not positive, and where the plant makes steps of another length.
    """

    steps: int
    timestep: float = 0.002
    gravity: Float[ArrayLike, "*batch d"] | None = None
    plant: MujocoPlant | None = None
    record: bool = False

    def __post_init__(self):
        steps, timestep, plant = self.steps, self.timestep, self.plant
        if not timestep > 0 or not steps > 0:
            raise ValueError(f"steps and timestep must be positive, got {steps} and {timestep}")
        if plant is not None and abs(float(plant.timestep) - timestep) > 1e-6 * timestep:
            raise ValueError(
                f"the plant steps {float(plant.timestep):g} s, the loop {timestep:g} s: make them equal"
            )


class ClosedLoop(Answer):
    """What happened, steps first: all of it is (T, *batch).

    status          int32, a ``Status`` for each step
    position_error  m, ``|p - p_d|`` before the step; orientation_error: rad, ``|log(R R_d^T)|``
    cone_use        ``max_i psi_i / f_n,i`` of the applied forces: 1 at the edge of friction
    largest_normal  N, of the applied forces
    final           ``BodyState`` after the last step, (*batch)
    states, force   every state before its step, every applied force (T, *batch, ..); None unless ``record``
    """

    status: Int[Array, "*lead"]
    position_error: Float[Array, "*lead"]
    orientation_error: Float[Array, "*lead"]
    cone_use: Float[Array, "*lead"]
    largest_normal: Float[Array, "*lead"]
    final: BodyState
    states: BodyState | None
    force: Float[Array, "*lead kn"] | None

    SENTENCES: ClassVar[Mapping[Status, str]] = {
        Status.INFEASIBLE: "Infeasible: no admissible forces produce the commanded wrench; the last ones are kept.",
        Status.UNDECIDED: "Undecided: the solver stopped before it had forces or a proof that there are none; the "
        "last ones are kept.",
        Status.INVALID: "Invalid: the numbers are not a grasp, a body and a state; no forces are applied.",
    }

    def __getitem__(self, index: Index) -> ClosedLoop:
        """The loops at ``index`` of the batch, all steps of each."""
        if len(self.batch_shape) < 2:
            raise IndexError("a single loop has no batch axis to index")
        final = jax.tree.map(lambda x: x[index], self.final)
        index = (slice(None), *index) if isinstance(index, tuple) else (slice(None), index)
        rest = eqx.tree_at(lambda loop: loop.final, self, None)
        return eqx.tree_at(
            lambda loop: loop.final,
            jax.tree.map(lambda x: x[index], rest),
            final,
            is_leaf=lambda x: x is None,
        )

    @property
    def infeasible(self) -> Bool[Array, "*batch"]:
        """(*batch) bool: some step had no admissible forces for its command, or its forces were projected."""
        return jnp.any(self.status != Status.COMMANDED.value, axis=0)

    def settled(self, *, position: float, orientation: float) -> Int[Array, "*batch"]:
        """The first step from which both errors stay below ``position`` m and ``orientation`` rad; T if never."""
        out = ~((self.position_error <= position) & (self.orientation_error <= orientation))
        steps = jnp.arange(1, out.shape[0] + 1, dtype=jnp.int32).reshape(-1, *[1] * (out.ndim - 1))
        return jnp.max(jnp.where(out, steps, 0), axis=0)


class _Setting(NamedTuple):
    """What stays the same in all steps."""

    grasp: Grasp
    body: RigidBody
    controller: ContactController
    gravity: Any
    plant: MujocoPlant | None


def _size(v: Array) -> Array:
    return jnp.sqrt(jnp.sum(v * v, axis=-1))


@functools.partial(jax.jit, static_argnames=("steps", "record", "moving"))
def _run(setting: _Setting, state: BodyState, reference: Reference, pushes, steps, timestep, record, moving):
    grasp, body, controller, gravity, plant = setting
    G, sound = grasp_map(grasp), body.valid
    body = body.where(sound)
    d = grasp.dimension
    index = grasp.model.normal_index(d)

    def step(carry: tuple[BodyState, Array], at: tuple[Any, Any]) -> tuple[Any, Any]:
        now, last = carry
        target = at[0] if moving else reference
        command = controller.command(grasp, body, now, reference=target, last=last, gravity=gravity)
        invalid = ((command.status == Status.INVALID.value) | ~sound)[..., None]
        status = jnp.where(sound, command.status, jnp.int32(Status.INVALID.value))
        command = command._replace(force=jnp.where(invalid, 0.0, command.force), status=status)
        wrench = rotate_wrench(now.orientation, applied(G, command.force))
        if at[1] is not None:
            wrench = wrench + at[1]
        if plant is None:
            after = advance(body, now, wrench, timestep=timestep, gravity=gravity)
        else:
            after = plant.advance(now, wrench)
        after = jax.tree.map(lambda new, old: jnp.where(invalid, old, new), after, now)
        error = tracking_error(now, target).error
        normal = command.force.reshape(*command.force.shape[:-1], grasp.contacts, -1)[..., index]
        seen = (
            command.status,
            _size(error[..., :d]),
            _size(error[..., d:]),
            cone_use(grasp, command.force),
            jnp.max(normal, axis=-1),
        )
        return (after, command.force), (seen, (now, command.force) if record else None)

    start = (state, jnp.zeros((*grasp.batch_shape, grasp.contacts * grasp.model.force_size(d)), grasp.dtype))
    (final, _), (seen, path) = jax.lax.scan(
        step, start, (reference if moving else None, pushes), length=steps
    )
    states, force = path if record else (None, None)
    status, position, orientation, use, largest = seen
    return ClosedLoop(status, position, orientation, use, largest, final, states, force)


def _laid_out(reference: Reference, batch: tuple[int, ...], steps: int, dtype) -> tuple[Reference, bool]:
    """The reference ready to be scanned over, and whether it moves. One that fits both ways is a set point a lane."""
    lead = reference.position.shape[:-1]
    if lead in ((), batch):
        return jax.tree.map(lambda x: x.astype(dtype), reference), False
    if lead not in ((steps,), (steps, *batch)):
        raise ValueError(
            f"the reference's axes before the last must be (), the batch axes {batch}, or one a step, {(steps,)} or "
            f"{(steps, *batch)}; got {lead}"
        )
    own = batch if lead != (steps,) else (1,) * len(batch)
    return jax.tree.map(lambda x: x.astype(dtype).reshape(steps, *own, x.shape[-1]), reference), True


def _wide(
    grasp: Grasp, body: RigidBody, state: BodyState, batch: tuple[int, ...]
) -> tuple[RigidBody, BodyState]:
    """Body and state with the grasp's batch axes and dtype."""

    def wide(x: Array, own: int) -> Array:
        """Trailing ``own`` axes kept, batch axes in front of them."""
        return jnp.broadcast_to(x.astype(grasp.dtype), (*batch, *x.shape[x.ndim - own :]))

    try:
        body = eqx.tree_at(lambda b: (b.mass, b.inertia), body, (wide(body.mass, 0), wide(body.inertia, 2)))
        return body, jax.tree.map(lambda x: wide(x, 1), state)
    except ValueError as error:
        raise ValueError(f"body and state must broadcast to the grasp's batch axes {batch}") from error


def _pushes(grasp: Grasp, disturbance: ArrayLike, steps: int) -> Array:
    """The disturbance ready to be scanned over: (steps, *batch or ones, m)."""
    batch, m = grasp.batch_shape, wrench_dimension(grasp.dimension)
    pushes = real_array(disturbance, "disturbance").astype(grasp.dtype)
    if pushes.shape not in ((steps, m), (steps, *batch, m)):
        raise ValueError(
            f"disturbance must have shape ({steps}, {m}) or ({steps}, *batch, {m}), got {pushes.shape}"
        )
    return pushes.reshape(steps, *[1] * len(batch), m) if batch and pushes.ndim == 2 else pushes


def close_loop(
    grasp: Grasp,
    body: RigidBody,
    *,
    controller: ContactController,
    state: BodyState,
    simulation: Simulation,
    reference: Reference | None = None,
    disturbance: Float[ArrayLike, "*lead m"] | None = None,
) -> ClosedLoop:
    """``M q'' + B + G = G^W f + w`` with f the controller's: control, contact forces, motion, all steps in one call.

    grasp, body  batch axes in front; the body's broadcast to the grasp's
    controller   ``ComputedTorque`` or ``Regulator``; it knows neither the disturbance nor the future
    state        where the objects start, (*batch)
    simulation   a ``Simulation``: steps, timestep, gravity, plant, whether to record
    reference    where they should be: a set point, or one for each step; None: at the origin, not turned
    disturbance  w, (steps, m) or (steps, *batch, m): a wrench at the centre of mass, world axes, N and N m

    Applied forces always lie in their friction cones; ``status`` says for each step whether they are the commanded
    ones. A lane with bad numbers is INVALID and stays where it is. ValueError for wrong shapes, and for gains that
    are too large for the time step.
    """
    if not isinstance(controller, ContactController):
        raise ValueError(
            f"controller must be a ComputedTorque or a Regulator, got {type(controller).__name__}"
        )
    if not isinstance(simulation, Simulation):
        raise ValueError(f"simulation must be a jaxgrasp.motion.Simulation, got {type(simulation).__name__}")
    if grasp.dimension != body.dimension or grasp.dimension != state.dimension:
        raise ValueError("grasp, body and state must all be spatial or all planar")
    controller.check(simulation.timestep, grasp.dimension)
    batch, dtype, steps = grasp.batch_shape, grasp.dtype, simulation.steps
    body, state = _wide(grasp, body, state, batch)
    if reference is None:
        reference = Reference.hold(BodyState.at_rest(grasp.dimension, (), dtype))
    reference, moving = _laid_out(reference, batch, steps, dtype)
    pushes = None if disturbance is None else _pushes(grasp, disturbance, steps)
    setting = _Setting(grasp, body, controller, simulation.gravity, simulation.plant)
    timestep = jnp.asarray(simulation.timestep, dtype)
    return _run(setting, state, reference, pushes, steps, timestep, simulation.record, moving)
