"""Newton's method for the weakest direction of a grasp: a stationary point of the support function on the sphere.

    sum_i A_i s_i = e d,     |d| = 1,     and for every contact, with v = A_i^T d and h = v_0 + |v_t|, one of
        idle      s = 0                            h <= e (L1), h <= 0 (Linf)
        rim       s = s_0 (1, v_t / |v_t|)         h  = e (L1), and s_0 = 1 or h = 0 (Linf)
        core      v_t = 0, |s_t| < s_0             h  = e (L1), and s_0 = 1 or h = 0 (Linf)

d is unit, e = h(d) the quality, s_i the scaled forces that touch the ball: convex analysis' 0 in the subdifferential.
Which case a contact is in is guessed from forces near the answer; a wrong guess ends where a check outside fails.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp

from ..backend import fori_loop, while_loop
from ..conic import solve
from ..core import Array, stationary_tolerance

__all__ = ["Touch", "weakest_direction"]

STEPS = 8
# Guesses in turn. A contact is in its core below this share of friction used; at the edge of its effort within that.
GUESSES = (
    (0.97, 1e-3),
    (0.9, 1e-3),
    (0.97, 0.03),
    (0.995, 1e-3),
    (0.8, 1e-2),
    (0.97, 0.1),
    (0.6, 1e-2),
    (0.8, 0.1),
)


class Touch(NamedTuple):
    """A unit direction d (m,), the scaled forces (k, n) whose wrench is along d, and whether they solve the system."""

    direction: Array
    forces: Array
    sound: Array


def _cases(norm: str, forces: Array, core_below: Array, edge: Array) -> tuple[Array, Array, Array]:
    """(k,) idle, full, core, from the forces at the foot of the nearest facet."""
    share = forces[:, 0]
    tail = jnp.sqrt(jnp.sum(forces[:, 1:] ** 2, axis=-1))
    idle = share < edge
    full = (share > 1 - edge) if norm == "Linf" else jnp.zeros_like(idle)
    return idle, full, ~idle & (tail < core_below * share)


def weakest_direction(A: Array, norm: str, near: Touch, upper: Array) -> Touch:
    """The solution of the system of the module's head that Newton's method finds from ``near``, for A (k, m, n).

    The first guess of cases that ends in a sound solution with e at most ``upper`` counts; ``near`` itself, not sound,
    where none does.
    """
    guesses = jnp.asarray(GUESSES, A.dtype)

    def open_guess(carry: tuple[Array, Touch]) -> Array:
        return (carry[0] < len(GUESSES)) & ~carry[1].sound

    def try_one(carry: tuple[Array, Touch]) -> tuple[Array, Touch]:
        i, _ = carry
        return i + 1, _newton(A, norm, near, upper, guesses[i, 0], guesses[i, 1])

    start = (jnp.int32(0), near._replace(sound=jnp.asarray(False)))
    return while_loop(open_guess, try_one, start, A)[1]


class _System(NamedTuple):
    """The equations of one guess of cases in the unknowns x = (d, e, s): their residual and its matrix."""

    A: Array  # (k, m, n)
    level: Array  # 1 (L1), 0 (Linf): h = level e
    idle: Array  # (k,)
    full: Array
    core: Array

    @property
    def wide(self) -> Array:
        """[A_1 .. A_k], (m, k n)."""
        k, m, n = self.A.shape
        return jnp.moveaxis(self.A, 0, 1).reshape(m, k * n)

    def tails(self, d: Array) -> tuple[Array, Array, Array]:
        """v = A^T d (k, n), |v_t| (k,) and v_t / |v_t| (k, n - 1)."""
        v = jnp.einsum("kmn,m->kn", self.A, d)
        tail = jnp.sqrt(jnp.sum(v[:, 1:] ** 2, axis=-1))
        safe = jnp.where(tail > 0, tail, 1.0)
        return v, tail, v[:, 1:] / safe[:, None]

    def __call__(self, x: Array) -> tuple[Array, Array]:
        """Residual and matrix at x."""
        A, level, idle, core = self.A, self.level, self.idle, self.core
        k, m, n = A.shape
        d, e, s = x[:m], x[m], x[m + 1 :].reshape(k, n)
        v, tail, u = self.tails(d)
        safe = jnp.where(tail > 0, tail, 1.0)
        # First row of a contact: its effort is given, or its h is.
        on_rim = ~core
        value = v[:, 0] + jnp.where(on_rim, tail, 0.0) - level * e
        given = jnp.where(idle, s[:, 0], s[:, 0] - 1)
        fixed = idle | self.full
        first = jnp.where(fixed, given, value)
        slope = A[:, :, 0] + jnp.where(on_rim[:, None], jnp.einsum("kmn,kn->km", A[:, :, 1:], u), 0.0)
        # Other rows: no tail, no tangential velocity, or a tail along it.
        tied = s[:, 1:] - s[:, :1] * u
        rest = jnp.where(idle[:, None], s[:, 1:], jnp.where(core[:, None], v[:, 1:], tied))
        turn = (jnp.eye(n - 1, dtype=A.dtype) - u[:, :, None] * u[:, None, :]) / safe[:, None, None]
        du = jnp.einsum("kab,kmb->kam", turn, A[:, :, 1:])
        by_d = jnp.where(
            idle[:, None, None], 0.0,
            jnp.where(core[:, None, None], jnp.moveaxis(A[:, :, 1:], 1, 2), -s[:, :1, None] * du),
        )  # fmt: skip
        by_d = jnp.concatenate([jnp.where(fixed[:, None], 0.0, slope)[:, None], by_d], axis=1)
        contacts = jnp.concatenate([first[:, None], rest], axis=1).reshape(-1)
        top = self.wide @ s.reshape(-1) - e * d
        return jnp.concatenate([top, ((d @ d - 1) / 2)[None], contacts]), self._matrix(x, by_d, u)

    def _matrix(self, x: Array, by_d: Array, u: Array) -> Array:
        """Rows: the wrench, |d| = 1, the contacts, whose derivatives by d are ``by_d`` (k, n, m)."""
        (k, m, n), dtype = self.A.shape, self.A.dtype
        idle, core, fixed = self.idle, self.core, self.idle | self.full
        d, e = x[:m], x[m]
        by_e = jnp.zeros((k, n), dtype).at[:, 0].set(jnp.where(fixed, 0.0, -self.level))
        own = jnp.where((idle | ~core)[:, None, None], jnp.eye(n, dtype=dtype), 0.0)
        own = own.at[:, 1:, 0].add(jnp.where((idle | core)[:, None], 0.0, -u))
        own = own.at[:, 0, 0].set(jnp.where(fixed, 1.0, 0.0))
        by_s = jnp.einsum("kab,kl->kalb", own, jnp.eye(k, dtype=dtype)).reshape(k * n, k * n)
        matrix = jnp.zeros((x.shape[0], x.shape[0]), dtype)
        matrix = matrix.at[:m, :m].set(-e * jnp.eye(m, dtype=dtype)).at[:m, m].set(-d)
        matrix = matrix.at[:m, m + 1 :].set(self.wide).at[m, :m].set(d)
        matrix = matrix.at[m + 1 :, :m].set(by_d.reshape(k * n, m)).at[m + 1 :, m].set(by_e.reshape(-1))
        return matrix.at[m + 1 :, m + 1 :].set(by_s)


def _newton(A: Array, norm: str, near: Touch, upper: Array, core_below: Array, edge: Array) -> Touch:
    k, m, n = A.shape
    dtype = A.dtype
    level = jnp.asarray(1.0 if norm == "L1" else 0.0, dtype)
    system = _System(A, level, *_cases(norm, near.forces, core_below, edge))

    def step(_: int, x: Array) -> Array:
        residual, matrix = system(x)
        return x - solve(matrix, residual[:, None])[:, 0]

    start = jnp.concatenate([
        near.direction, (near.direction @ (system.wide @ near.forces.reshape(-1)))[None], near.forces.reshape(-1)
    ])  # fmt: skip
    x = fori_loop(0, STEPS, step, start, A)
    residual, _ = system(x)
    d, s = x[:m], x[m + 1 :].reshape(k, n)
    tail = jnp.sqrt(jnp.sum(s[:, 1:] ** 2, axis=-1))
    fine = stationary_tolerance(dtype)
    sound = jnp.all(jnp.isfinite(x)) & jnp.all(jnp.abs(residual) < fine)
    sound = sound & (x[m] <= upper * (1 + fine)) & jnp.all(s[:, 0] >= -fine) & jnp.all(tail <= s[:, 0] + fine)
    # The forces attain h(d) with unit effort: no idle contact would push harder, none pushes beyond its effort.
    v, tail, _ = system.tails(d)
    h = v[:, 0] + tail
    value = jnp.max(h) if norm == "L1" else jnp.sum(jnp.maximum(h, 0.0))
    sound = sound & (value <= x[m] * (1 + fine)) & jnp.all(s[:, 0] <= 1 + fine)
    return Touch(jnp.where(sound, d, near.direction), jnp.where(sound, s, near.forces), sound)
