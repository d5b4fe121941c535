"""11.4, (11.27): computed torque, with contact forces that force optimisation finds in every step.

    G^W(q) f = M(q) (q''_d - K_v e' - K_p e) + B(q, q') + G(q)        so that   e'' + K_v e' + K_p e = 0

(q''_d, not the printed q'_d: erratum 8.) e = (p - p_d; log(R R_d^T)): the orientation error is a rotation vector, and
(11.27) is meant in these coordinates exactly, so the error obeys its linear equation at any size below half a turn.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.typing import ArrayLike

from ..contacts import Grasp, grasp_map, into_cones
from ..core import (
    Array,
    Float,
    Int,
    Status,
    applied,
    cross,
    jacobian_product,
    jacobian_solve,
    real_array,
    rotate,
    rotate_wrench,
    rotation_between,
    turned,
    wrench_dimension,
)
from ..forces import Criterion, SumOfSquares, optimize_forces
from .rigid_body import BodyState, RigidBody, coriolis, gravity_term

__all__ = [
    "Command",
    "ComputedTorque",
    "ContactController",
    "Gains",
    "Reference",
    "tracking_error",
]

CLOSE = 1e-6  # forces that miss the commanded wrench by less than this share of it produce it


class Gains(eqx.Module):
    """K_p (1/s^2) and K_v (1/s): numbers, or (m, m) positive definite matrices."""

    stiffness: Float[Array, "*square"]
    damping: Float[Array, "*square"]

    def __init__(self, stiffness: Float[ArrayLike, "*square"], damping: Float[ArrayLike, "*square"]):
        self.stiffness, self.damping = _gain(stiffness, "stiffness"), _gain(damping, "damping")

    @classmethod
    def of_rate(cls, rate: float, *, damping_ratio: float = 1.0) -> Gains:
        """``K_p = rate^2, K_v = 2 ratio rate``: errors decay like exp(-ratio rate t); ratio 1 without overshoot."""
        if not rate > 0 or not damping_ratio > 0:
            raise ValueError(f"rate and damping_ratio must be positive, got {rate} and {damping_ratio}")
        return cls(rate * rate, 2 * damping_ratio * rate)

    def check(self, timestep: float, dimension: int) -> None:
        """ValueError where gains have the wrong shape, or steps of ``timestep`` s are too long for them.

        Semi-implicit Euler on e'' + k_v e' + k_p e = 0 is stable iff ``h^2 k_p + 2 h k_v < 4`` (and h k_v < 2); for
        matrices the largest eigenvalues count.
        """
        m = wrench_dimension(dimension)
        for gain, name in ((self.stiffness, "stiffness"), (self.damping, "damping")):
            if gain.shape not in ((), (m, m)):
                raise ValueError(f"{name} must be a number or a ({m}, {m}) matrix, got shape {gain.shape}")
        if isinstance(self.stiffness, Tracer) or isinstance(self.damping, Tracer):
            return
        k_p, k_v = (float(np.linalg.eigvalsh(np.atleast_2d(x)).max()) for x in (self.stiffness, self.damping))
        if not timestep**2 * k_p + 2 * timestep * k_v < 4:
            raise ValueError(
                f"a time step of {timestep:g} s is too large for these gains: h^2 K_p + 2 h K_v = "
                f"{timestep**2 * k_p + 2 * timestep * k_v:.3g} must stay below 4; take smaller steps or gains"
            )


def _gain(value: ArrayLike, name: str) -> Array:
    array = real_array(value, name)
    if isinstance(array, Tracer):
        return array
    matrix = np.atleast_2d(array)
    if matrix.ndim != 2 or matrix.shape[0] != matrix.shape[1] or not np.allclose(matrix, matrix.T):
        raise ValueError(f"{name} must be a positive number or a symmetric matrix, got shape {array.shape}")
    if not np.linalg.eigvalsh(matrix).min() > 0:
        raise ValueError(f"{name} must be positive (definite), got {value}")
    return array


class Reference(eqx.Module):
    """Where the object is to be: a set point, or one for each step (a leading axis of that length), then batch axes.

    position, orientation, velocity  as in ``BodyState``; acceleration (.., m): m/s^2 and rad/s^2, world axes
    """

    position: Float[Array, "*steps d"]
    orientation: Float[Array, "*steps o"]
    velocity: Float[Array, "*steps m"]
    acceleration: Float[Array, "*steps m"]

    @classmethod
    def hold(cls, state: BodyState) -> Reference:
        """Stay at the pose of ``state``."""
        zero = jnp.zeros_like(state.velocity)
        return cls(state.position, state.orientation, zero, zero)

    @classmethod
    def along(
        cls, path: Callable[[Float[Array, ""]], Float[Array, " m"]], times: Float[ArrayLike, " steps"]
    ) -> Reference:
        """Follow ``path(t)``, a JAX function from s to (translation in m; rotation vector in rad), (m,).

        Velocities and accelerations are its exact derivatives.
        """
        times = real_array(times, "times")
        one = jnp.ones((), times.dtype)

        def velocity(t: Array) -> Array:
            pose, rate = jax.jvp(path, (t,), (one,))
            d = _dimension(pose)
            return jnp.concatenate([rate[:d], jacobian_product(pose[d:], rate[d:])])

        def point(t: Array) -> Reference:
            pose = path(t)
            d = _dimension(pose)
            start = BodyState.at_rest(d, dtype=pose.dtype)
            rate, change = jax.jvp(velocity, (t,), (one,))
            return cls(pose[:d], turned(start.orientation, pose[d:]), rate, change)

        return jax.vmap(point)(times)


def _dimension(pose: Array) -> int:
    if pose.shape not in ((3,), (6,)):
        raise ValueError(
            f"a path must return (translation; rotation vector), 6 numbers (3 in the plane), got {pose.shape}"
        )
    return 2 if pose.shape[-1] == 3 else 3


class TrackingError(NamedTuple):
    """e and e' (*batch, m), and the angular velocity and acceleration that follow the reference at this error."""

    error: Array
    rate: Array
    carried: Array
    spin: Array


@eqx.filter_jit
def tracking_error(state: BodyState, reference: Reference) -> TrackingError:
    """``e = (p - p_d; log(R R_d^T))`` and its exact rate ``e' = (v - v_d; J_l(e)^-1 (omega - R R_d^T omega_d))``."""
    d = state.dimension
    turn = rotation_between(state.orientation, reference.orientation)
    shift = state.position - reference.position

    def carried(v: Array) -> Array:  # from where the reference is to where the object is
        return rotate(state.orientation, rotate(reference.orientation, v, inverse=True))

    spin = carried(reference.velocity[..., d:])
    slip = state.velocity[..., d:] - spin
    rate = [state.velocity[..., :d] - reference.velocity[..., :d], jacobian_solve(turn, slip)]
    follow = carried(reference.acceleration[..., d:])
    if d == 3:
        follow = follow + cross(slip, spin)
    linear = jnp.broadcast_to(reference.acceleration[..., :d], shift.shape)
    return TrackingError(
        jnp.concatenate([shift, turn], axis=-1),
        jnp.concatenate(rate, axis=-1),
        jnp.concatenate([linear, jnp.broadcast_to(follow, turn.shape)], axis=-1),
        slip,
    )


class Command(NamedTuple):
    """force (*batch, k n) in the cones; status int32, a ``Status``; wrench (*batch, m) asked for, body axes."""

    force: Array
    status: Array
    wrench: Array


class ContactController(eqx.Module):
    """Chooses the contact forces of each step."""

    @abstractmethod
    def command(
        self,
        grasp: Grasp,
        body: RigidBody,
        state: BodyState,
        *,
        reference: Reference,
        last: Float[Array, "*batch kn"],
        gravity: Float[ArrayLike, "*batch d"] | None,
    ) -> Command:
        """The forces to apply now; ``last`` (*batch, k n) were applied before, and are admissible."""

    @abstractmethod
    def check(self, timestep: float, dimension: int) -> None:
        """ValueError where it cannot work in steps of ``timestep`` s."""


def _gained(gain: Array, v: Array) -> Array:
    gain = gain.astype(v.dtype)
    return gain * v if gain.ndim == 0 else applied(gain, v)


class ComputedTorque(ContactController):
    """(11.27) with optimal contact forces: for grasps that can produce every wrench they need.

    gains          ``Gains``; criterion: which of all admissible forces (default ``SumOfSquares()``)
    max_normal     N, a number or one per contact; None: no limit
    torque_limits  (J, tau_max) as for ``optimize_forces``: ``|J^T f| <= tau_max``, J fixed to the object; None: none
    tolerance      of the optimisation: how nearly optimal the forces are. How nearly they produce the wrench is checked
                   apart, and in their cones they always are
    """

    gains: Gains
    criterion: Criterion
    max_normal: Float[Array, "*batch k"] | None
    torque_limits: tuple[Float[Array, "*batch kn q"], Float[Array, "*batch q"]] | None
    tolerance: float = eqx.field(static=True)

    def __init__(
        self,
        gains: Gains,
        *,
        criterion: Criterion | None = None,
        max_normal: Float[ArrayLike, "*batch k"] | None = None,
        torque_limits: tuple[Float[ArrayLike, "*batch kn q"], Float[ArrayLike, "*batch q"]] | None = None,
        tolerance: float = 1e-6,
    ):
        self.gains = gains
        self.criterion = SumOfSquares() if criterion is None else criterion
        self.max_normal = None if max_normal is None else real_array(max_normal, "max_normal")
        self.torque_limits = None
        if torque_limits is not None:
            jacobian, largest = torque_limits
            self.torque_limits = (real_array(jacobian, "the hand Jacobian J"), real_array(largest, "tau_max"))
        self.tolerance = tolerance

    def check(self, timestep: float, dimension: int) -> None:
        """ValueError where the gains do not fit the body or steps of ``timestep`` s."""
        self.gains.check(timestep, dimension)

    def wrench(
        self,
        body: RigidBody,
        state: BodyState,
        *,
        reference: Reference,
        gravity: Float[ArrayLike, "*batch d"] | None = None,
    ) -> Float[Array, "*batch m"]:
        """``M (q''_d - K_v e' - K_p e) + B + G`` in world axes, N and N m."""
        d = state.dimension
        at = tracking_error(state, reference)
        wanted = -_gained(self.gains.damping, at.rate) - _gained(self.gains.stiffness, at.error)
        turn, rate = at.error[..., d:], at.rate[..., d:]
        # omega - R R_d^T omega_d = J_l(e) e', so its rate is J_l(e) e'' plus the rate of J_l times e'
        bend = jax.jvp(lambda e: jacobian_product(e, rate), (turn,), (rate,))[1]
        angular = jacobian_product(turn, wanted[..., d:]) + bend
        q_dd = jnp.concatenate([wanted[..., :d], angular], axis=-1) + at.carried
        if d == 2:
            torque = body.inertia[..., 0] * q_dd[..., d:]
        else:
            inner = rotate(state.orientation, q_dd[..., d:], inverse=True)
            torque = rotate(state.orientation, applied(body.inertia, inner))
        inertial = jnp.concatenate([body.mass[..., None] * q_dd[..., :d], torque], axis=-1)
        return inertial + coriolis(body, state) + gravity_term(body, gravity=gravity)

    def command(
        self,
        grasp: Grasp,
        body: RigidBody,
        state: BodyState,
        *,
        reference: Reference,
        last: Float[Array, "*batch kn"],
        gravity: Float[ArrayLike, "*batch d"] | None,
    ) -> Command:
        """The optimal forces that produce ``wrench``, or the last ones with the reason why not."""
        world = self.wrench(body, state, reference=reference, gravity=gravity)
        asked = rotate_wrench(state.orientation, world, inverse=True)
        found = optimize_forces(
            grasp,
            -asked,
            criterion=self.criterion,
            max_normal=self.max_normal,
            torque_limits=self.torque_limits,
            tolerance=self.tolerance,
        )
        cap = None if self.max_normal is None else self.max_normal.astype(asked.dtype)
        force = into_cones(grasp, found.force, cap=cap)
        made = applied(grasp_map(grasp), force)
        close = jnp.max(jnp.abs(made - asked), axis=-1) <= CLOSE * jnp.max(jnp.abs(asked), axis=-1)
        return _settled(found.status, force, close, last, asked)


def _settled(status: Int[Array, "*batch"], force: Array, close: Array, last: Array, asked: Array) -> Command:
    """The forces of a solved step, or the last ones with the reason."""
    solved = (status == Status.OPTIMAL.value) | (status == Status.STALLED.value)
    good = solved & close
    said = jnp.where(good, Status.COMMANDED.value, Status.UNDECIDED.value)
    said = jnp.where(status == Status.INFEASIBLE.value, Status.INFEASIBLE.value, said)
    invalid = status == Status.INVALID.value
    said = jnp.where(invalid, Status.INVALID.value, said).astype(jnp.int32)
    kept = jnp.where(good[..., None], force, last)
    return Command(jnp.where(invalid[..., None], 0.0, kept), said, asked)
