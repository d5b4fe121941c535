"""Admissible forces that balance a load exactly, next to given ones: shown to exist, without being written down.

    s + change,   A (s + change) = -w exactly,   |change| <= shift = (|A s + w| + c |A| |s|) / sigma

lies inside every cone, cap and torque limit that s keeps from by more than ``shift`` is worth. Optimal forces lie on
edges; so they first move a little along a direction d with A d = 0 that leads inwards at every edge they touch.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from .criteria import Asked
from .rank import rounding_of, smallest_singular_value
from .rebuilt import EPS, part_of

__all__ = ["Edges", "Exact", "edges_of", "exact_forces"]

ROUNDS = 2
LARGEST_STEP = 1e-3  # of the forces
WIDER = (64.0, 4096.0)  # a step away from one edge may reach another; then that one is kept from, too


class Edges(NamedTuple):
    """How far forces keep from each limit: cones and caps (N, k), torques (N, q); negative outside."""

    cone: np.ndarray
    cap: np.ndarray
    torque: np.ndarray


class Matrix(NamedTuple):
    """What is known of A: its pseudo-inverse (N, k n, m), a proven sigma_min, what rounding hides of A s (N,)."""

    inverse: np.ndarray
    sigma: np.ndarray
    rounding: np.ndarray


class Exact(NamedTuple):
    """s (N, k, n), within ``shift`` (N,) of exact admissible forces where ``shown`` (N,) bool."""

    s: np.ndarray
    shift: np.ndarray
    shown: np.ndarray


def edges_of(asked: Asked, s: np.ndarray) -> Edges:
    """The distances from all limits at the scaled forces s."""
    live = asked.known.live
    tail = np.linalg.norm(s[..., 1:], axis=-1)
    return Edges(
        np.where(live, s[..., 0] - tail, np.inf),
        np.where(live, asked.cap - s[..., 0], np.inf),
        asked.torque - np.abs(np.einsum("lknj,lkn->lj", asked.scaled_jacobian(), s)),
    )


def exact_forces(asked: Asked, s: np.ndarray, fine: float) -> Exact:
    """Forces next to s (N, k, n) that are exactly admissible, as far as floating point can show.

    fine  what the rounding of the given forces may be, over their size
    """
    A = asked.known.A
    rounding = rounding_of(A)
    sigma = smallest_singular_value(A, rounding)
    matrix = Matrix(_pseudo_inverse(A, sigma > 0), sigma, rounding)
    s = _balanced(asked, matrix.inverse, s)
    exact = _moved_inwards(asked, matrix, s, fine)
    for wider in WIDER:
        again = np.flatnonzero((sigma > 0) & ~exact.shown)
        if again.size:
            part = _moved_inwards(part_of(asked, again), part_of(matrix, again), s[again], wider * fine)
            for whole, new in zip(exact, part, strict=True):
                whole[again] = new
    return exact


def _moved_inwards(asked: Asked, matrix: Matrix, s: np.ndarray, fine: float) -> Exact:
    """One attempt: away from the edges nearer than 64 ``fine``, or too near to show anything."""
    size = np.linalg.norm(s.reshape(len(s), -1), axis=-1)
    shift = _shift(asked, matrix, s)
    rooms, needs = edges_of(asked, s), _needs(asked, s, shift)
    near = (64 * fine * size)[:, None]
    touched = Edges(*(room <= np.maximum(near, 4 * need) for room, need in zip(rooms, needs, strict=True)))
    idle = asked.known.live & (np.linalg.norm(s, axis=-1) <= near)
    direction, gains = _inwards(asked, matrix.inverse, s, touched, idle)
    step = np.zeros(len(s))
    for gain, room, need in zip(gains, rooms, needs, strict=True):
        missing = np.where(gain > 0, 3 * need - room, 0.0) / np.where(gain > 0, gain, 1.0)
        step = np.maximum(step, np.max(np.where(np.isfinite(missing), missing, 0.0), -1, initial=0.0))
    length = np.linalg.norm(direction.reshape(len(s), -1), axis=-1)
    step = np.where(step * length <= LARGEST_STEP * size, step, 0.0)
    s = _balanced(asked, matrix.inverse, s + step[:, None, None] * direction)
    shift = _shift(asked, matrix, s)
    shown = (matrix.sigma > 0) & np.isfinite(shift)
    for room, need in zip(edges_of(asked, s), _needs(asked, s, shift), strict=True):
        shown &= (room > need).all(-1)
    return Exact(s, shift, shown)


def _pseudo_inverse(A: np.ndarray, full: np.ndarray) -> np.ndarray:
    """``A^T (A A^T)^-1`` where the rank is full, else over the singular values that are no rounding (N, k n, m)."""
    m = A.shape[1]
    gram = A @ np.swapaxes(A, -1, -2)
    safe = np.where(full[:, None, None], gram, np.eye(m))
    out = np.swapaxes(A, -1, -2) @ np.linalg.inv(safe)
    rest = np.flatnonzero(~full & np.isfinite(A).all((-1, -2)))
    if rest.size:
        out[rest] = np.linalg.pinv(A[rest], rcond=128 * EPS)
    return out


def _residual(asked: Asked, s: np.ndarray) -> np.ndarray:
    return np.einsum("lij,lj->li", asked.known.A, s.reshape(len(s), -1)) + asked.load


def _balanced(asked: Asked, inverse: np.ndarray, s: np.ndarray) -> np.ndarray:
    """The nearest forces that balance the load, twice, so that what is left is rounding."""
    for _ in range(ROUNDS):
        change = np.einsum("lji,li->lj", inverse, _residual(asked, s)).reshape(s.shape)
        s = np.where(np.isfinite(change), s - change, s)
    return s


def _shift(asked: Asked, matrix: Matrix, s: np.ndarray) -> np.ndarray:
    """(N,) exact forces are no farther; infinite where the rank is not proved."""
    _, sigma, rounding = matrix
    left = np.linalg.norm(_residual(asked, s), axis=-1)
    left = left + rounding * np.linalg.norm(s.reshape(len(s), -1), axis=-1)
    left = left + 8 * EPS * np.linalg.norm(asked.load, axis=-1)
    return np.where(sigma > 0, left / np.where(sigma > 0, sigma, 1.0) * (1 + 8 * EPS), np.inf)


def _needs(asked: Asked, s: np.ndarray, shift: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """What each limit must keep for ``shift`` and for its own rounding."""
    size = np.linalg.norm(s, axis=-1)
    cone = np.sqrt(2.0) * shift[:, None] + 8 * EPS * size
    cap = shift[:, None] + 2 * EPS * (size + np.where(np.isfinite(asked.cap), asked.cap, 0.0))
    reach = np.linalg.norm(asked.reach(), axis=1)
    total = np.linalg.norm(size, axis=-1)[:, None]
    terms = s.shape[1] * s.shape[2] + 20
    torque = reach * (shift[:, None] + terms * EPS * total)
    torque = torque + 2 * EPS * np.where(np.isfinite(asked.torque), asked.torque, 0.0)
    return cone, cap, torque


def _inwards(
    asked: Asked, inverse: np.ndarray, s: np.ndarray, touched: Edges, idle: np.ndarray
) -> tuple[np.ndarray, Edges]:
    """d (N, k, n) with A d = 0 that leads inwards at all ``touched`` edges, at rate 1; and its rates there.

    The smallest such d. Rates are 0 at the others; contacts that are ``idle`` (N, k) move along their normals.
    """
    lanes, k, n = s.shape
    tail = np.linalg.norm(s[..., 1:], axis=-1)
    unit = s[..., 1:] / np.where(tail > 0, tail, 1.0)[..., None]
    unit = np.where(idle[..., None], 0.0, unit)
    rows = np.zeros((lanes, 2 * k, k, n))
    each = np.arange(k)
    rows[:, each, each, 0], rows[:, each, each, 1:] = 1.0, -unit
    rows[:, k + each, each, 0] = -1.0
    jacobian = asked.scaled_jacobian()
    torques = np.einsum("lknj,lkn->lj", jacobian, s)
    reach = np.linalg.norm(jacobian, axis=(1, 2))
    outwards = np.sign(torques)[:, None, None] * jacobian / np.where(reach > 0, reach, 1.0)[:, None, None]
    rows = np.concatenate([rows, -np.moveaxis(outwards, -1, 1)], 1)
    active = np.concatenate([*touched], -1)
    # Contacts without force may only press.
    free = np.where(idle[..., None], np.arange(n) == 0, True)
    rows = (rows * active[..., None, None] * free[:, None]).reshape(lanes, -1, k * n)
    A = asked.known.A * free.reshape(lanes, 1, k * n)
    system = np.concatenate([A, rows], 1)
    right = np.concatenate([np.zeros((lanes, A.shape[1])), active.astype(float)], -1)
    gram = system @ np.swapaxes(system, -1, -2)
    size = np.trace(gram, axis1=-2, axis2=-1)
    good = np.isfinite(size)
    ridge = np.where(good, 1e-13 * size + 1e-300, 1.0)[:, None, None] * np.eye(gram.shape[-1])
    idle_rows = np.concatenate([np.zeros((lanes, A.shape[1])), ~active], -1)
    gram = np.where(good[:, None, None], gram, 0.0) + ridge + idle_rows[:, None] * np.eye(gram.shape[-1])
    weights = np.linalg.solve(gram, right[..., None])[..., 0]
    d = np.einsum("lrj,lr->lj", system, np.where(np.isfinite(weights), weights, 0.0)).reshape(s.shape)
    d = d - np.einsum(
        "lji,li->lj", inverse, np.einsum("lij,lj->li", asked.known.A, d.reshape(lanes, -1))
    ).reshape(s.shape)
    rates = np.einsum("lrj,lj->lr", rows, d.reshape(lanes, -1)) * active
    cone, cap = rates[:, :k], rates[:, k : 2 * k]
    return d, Edges(cone, cap, rates[:, 2 * k :] * reach)
