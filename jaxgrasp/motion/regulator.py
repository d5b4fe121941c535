"""Linear-quadratic regulation about an equilibrium: for grasps that are controllable, wrench resistant or not.

    f = f_0 - K x,   K minimises   sum_j |x_j|^2 + effort^2 |f~_j|^2   over   x_(j+1) = A x_j + B f~_j

in units of the body (lengths in radii of gyration, times in sqrt(l / g), forces in weights and friction cones), where
A and B are the semi-implicit Euler image of (11.29), which is what the simulation steps. The forces are then projected
onto their friction cones, and the step says whether that changed them. Source for the Riccati equation: Chu, Fan, Lin,
Wang, Structure-preserving algorithms for periodic discrete-time algebraic Riccati equations, 2004 (doubling).
"""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jax.typing import ArrayLike

from ..backend import fori_loop
from ..conic import solve
from ..contacts import Grasp, cleared, grasp_map, nearest_admissible
from ..core import Array, Bool, Float, Int, Status, applied
from .computed_torque import Command, ContactController, Reference, tracking_error
from .linearization import Scaled, is_equilibrium, linearize, scaled_system
from .rigid_body import BodyState, RigidBody

__all__ = ["Regulator", "regulator", "riccati"]

DOUBLINGS = 24  # 2^24 steps of the finite-horizon problem: infinite for all purposes


def riccati(
    A: Float[Array, "*batch s s"], B: Float[Array, "*batch s n"], Q: Float[Array, "*batch s s"], weight: Any
) -> Float[Array, "*batch s s"]:
    """X with ``X = A^T X (I + B B^T X / weight)^-1 A + Q``, by doubling; diverges where (A, B) cannot be stabilised."""
    unit = jnp.broadcast_to(jnp.eye(A.shape[-1], dtype=A.dtype), A.shape)

    def transposed(x: Array) -> Array:
        return jnp.swapaxes(x, -1, -2)

    def double(_: int, now: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        A, G, H = now
        W = unit + G @ H
        solved = solve(W, jnp.concatenate([A, G], axis=-1))
        solved_A, solved_G = solved[..., : A.shape[-1]], solved[..., A.shape[-1] :]
        G_next = G + A @ solved_G @ transposed(A)
        H_next = H + transposed(A) @ H @ solved_A
        return A @ solved_A, (G_next + transposed(G_next)) / 2, (H_next + transposed(H_next)) / 2

    return fori_loop(0, DOUBLINGS, double, (A, B @ transposed(B) / weight, Q))[2]


class Regulator(ContactController):
    """f_0 and K of each lane, made by ``regulator``.

    force       (*batch, k n) f_0, N       gain  (*batch, k n, 2 m) K: N for m, rad, m/s, rad/s
    stabilizes  (*batch) bool: A - B K is stable; elsewhere K = 0 and every step says UNREGULATED
    point       int32, an ``Status``: the equilibrium
    timestep    s, the step the gain was made for
    """

    force: Float[Array, "*batch kn"]
    gain: Float[Array, "*batch kn s"]
    stabilizes: Bool[Array, "*batch"]
    point: Int[Array, "*batch"]
    timestep: float

    def check(self, timestep: float, dimension: int) -> None:
        """ValueError where it was made for steps of another length than ``timestep`` s."""
        if abs(timestep - float(self.timestep)) > 1e-6 * timestep:
            raise ValueError(
                f"the regulator was made for steps of {float(self.timestep):g} s, not {timestep:g} s: make another"
            )

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
        """``f_0 - K x``, each contact's force moved to the nearest one in its cone."""
        d = state.dimension
        at = tracking_error(state, reference)
        away = state.velocity - reference.velocity
        x = jnp.concatenate([at.error, away[..., :d], at.spin], axis=-1)
        wanted = self.force - applied(self.gain, x)
        force = nearest_admissible(grasp, wanted)
        change, size = jnp.max(jnp.abs(force - wanted), axis=-1), jnp.max(jnp.abs(wanted), axis=-1)
        said = jnp.where(change <= 1e-9 * size, Status.COMMANDED.value, Status.PROJECTED.value)
        said = jnp.where(self.stabilizes, said, Status.UNREGULATED.value)
        bad = ~jnp.all(jnp.isfinite(x), axis=-1) | (self.point == Status.INVALID.value)
        said = jnp.where(bad, Status.INVALID.value, said).astype(jnp.int32)
        asked = applied(grasp_map(grasp), wanted)
        return Command(jnp.where(bad[..., None], 0.0, force), said, asked)


def _image(system: Scaled, timestep: Array) -> tuple[Array, Array]:
    """A and B of one semi-implicit Euler step, without units."""
    h = (timestep / system.time)[..., None, None]
    A_c, B_c = system.A_c, system.B_c
    unit = jnp.broadcast_to(jnp.eye(A_c.shape[-1], dtype=A_c.dtype), A_c.shape)
    upper = jnp.concatenate([unit + h * h * A_c, h * unit], axis=-1)
    A = jnp.concatenate([upper, jnp.concatenate([h * A_c, unit], axis=-1)], axis=-2)
    return A, jnp.concatenate([h * h * B_c, h * B_c], axis=-2)


def _settles(A: Array) -> Array:
    """Whether the powers of A vanish."""
    power, _ = fori_loop(0, 20, lambda _, now: (now[0] @ now[0], now[1]), (A, A))
    return jnp.all(jnp.isfinite(power), axis=(-1, -2)) & (jnp.max(jnp.abs(power), axis=(-1, -2)) < 1e-3)


@eqx.filter_jit
def _design(grasp: Grasp, system: Scaled, timestep: Array, weight: float) -> tuple[Array, Array]:
    """K in N for m, rad, m/s, rad/s; and whether it stabilises."""
    A, B = _image(system, timestep)
    states, d = A.shape[-1], grasp.dimension
    unit = jnp.broadcast_to(jnp.eye(states, dtype=A.dtype), A.shape)
    X = riccati(A, B, unit, weight)
    costate = X @ solve(unit + B @ jnp.swapaxes(B, -1, -2) @ X / weight, A)
    scaled = jnp.swapaxes(B, -1, -2) @ costate / weight
    scaling = jnp.where(grasp.active[..., None], cleared(grasp).model.scaling(d), 0.0)
    scaling = scaling.reshape(*scaling.shape[:-2], -1)
    one = jnp.ones_like(system.length)
    units = jnp.stack([1 / system.length] * d + [one] * (states // 2 - d), axis=-1)
    units = jnp.concatenate([units, units * system.time[..., None]], axis=-1)
    gain = (system.force[..., None] * scaling)[..., None] * scaled * units[..., None, :]
    return gain, _settles(A - B @ scaled)


def regulator(
    grasp: Grasp,
    body: RigidBody,
    *,
    timestep: float = 0.002,
    gravity: Float[ArrayLike, "*batch d"] | None = None,
    force: Float[ArrayLike, "*batch kn"] | None = None,
    effort: float = 1.0,
) -> Regulator:
    """``f = f_0 - K x`` that brings every state near the equilibrium back, as far as friction cones allow.

    grasp, body, gravity, force  as for ``linearize``
    timestep  s of the loop it will run in
    effort    how much control costs: with a larger one gains are smaller, forces stay in their cones further away

    Where there is no equilibrium or the linearisation cannot be stabilised, ``stabilizes`` is False.
    """
    if not isinstance(effort, int | float) or not effort > 0:
        raise ValueError(f"effort must be a positive number, got {effort!r}")
    if not timestep > 0:
        raise ValueError(f"timestep must be positive, got {timestep}")
    linear = linearize(grasp, body, force=force, gravity=gravity)
    system = scaled_system(grasp, body, gravity)
    gain, stable = _design(grasp, system, jnp.asarray(timestep, system.A_c.dtype), effort * effort)
    good = is_equilibrium(linear.status) & stable
    gain = jnp.where(good[..., None, None], gain, 0.0)
    return Regulator(linear.force, gain, good, linear.status, float(timestep))
