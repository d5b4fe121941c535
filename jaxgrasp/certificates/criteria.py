"""The criteria of force optimisation and their dual functions, in closed form; numpy only.

Lower bounds, for any y, with x_i = A_i^T y + J_i beta, gain = y.w - sum_j |beta_j| tau_j and rho_i = |x_t,i| - x_0,i:

    sum          gain / max rho,  or  gain - sum_i cap_i (rho_i - 1)+
    gentlest     gain / sum rho+, or  gain - sum_i cap_i (rho_i - lambda_i)+ for the best lambda >= 0 of sum 1
    quadratic    gain + sum_i min_{0 <= s <= cap_i} (s^2 - rho'_i s) - s_t D s_t / 2: the tails' cost replaced by its
                 tangent at the given forces, which a convex cost never falls below
    robust       gain - sum_i cap_i alpha_i + sum_i of the conjugates of the barrier's pieces
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from .rebuilt import Rebuilt

__all__ = ["Asked", "Multipliers", "cost", "cost_change", "lower_bound", "robust_sensitivity"]


class Asked(NamedTuple):
    """A force problem of N lanes: what was asked, lengths over L.

    known   the grasps          name, weight, length   the criterion (weight, length (N,) or None)
    cap     (N, k)              jacobian (N, k, n, q)  J of forces, torque (N, q): limits; q may be 0
    turned  (N, k, n, q)        sizes that the rounding of J is relative to: before it was turned, where it was
    load    (N, m) w            valid (N,)             the numbers are a problem
    dimension  2 or 3
    """

    known: Rebuilt
    name: str
    weight: np.ndarray | None
    length: np.ndarray | None
    cap: np.ndarray
    jacobian: np.ndarray
    turned: np.ndarray
    torque: np.ndarray
    load: np.ndarray
    valid: np.ndarray
    dimension: int

    def _scaled(self, rows: np.ndarray) -> np.ndarray:
        n, index = len(self.known.components), self.known.normal_index
        order = [index, *(j for j in range(n) if j != index)]
        return (rows * self.known.scale[..., None])[:, :, order]

    def scaled_jacobian(self) -> np.ndarray:
        """J of scaled forces, normal first."""
        return self._scaled(self.jacobian)

    def reach(self) -> np.ndarray:
        """(N, k, q) the size of J of scaled forces, which its rounding is relative to."""
        return np.linalg.norm(self._scaled(self.turned), axis=2)

    def joint_work(self, rates: np.ndarray) -> np.ndarray:
        """``sum_j |beta_j| tau_j`` (N,): infinite where a joint without a limit moves, nothing where it does not."""
        return np.sum(np.where(rates == 0, 0.0, np.abs(rates) * self.torque), -1)


class Multipliers(NamedTuple):
    """A twist y (N, m), joint rates beta (N, q), and x_i = A_i^T y + J_i beta (N, k, n), normal first."""

    y: np.ndarray
    rates: np.ndarray
    x: np.ndarray


def _level_multipliers(violation: np.ndarray, cap: np.ndarray, total: float = 1.0) -> np.ndarray:
    """The part of ``violation`` (N, k) that lambda of sum 1 should cover: the dearest caps first."""
    order = np.argsort(-cap, axis=-1, kind="stable")
    ordered = np.take_along_axis(violation, order, -1)
    before = np.cumsum(ordered, -1) - ordered
    covered = np.clip(total - before, 0.0, ordered)
    out = np.zeros_like(violation)
    np.put_along_axis(out, order, covered, -1)
    return out


def _paid(uncovered: np.ndarray, cap: np.ndarray, room: float) -> np.ndarray:
    """``sum cap uncovered``, where what is rounding beside 1 costs nothing without a cap."""
    free = ~np.isfinite(cap) & (uncovered <= room)
    return np.sum(np.where(free | (uncovered <= 0), 0.0, uncovered * cap), -1)


def _log_det_terms(asked: Asked) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """log det P = a log f_n + b log(f_n^2 - psi^2) + c per contact, (11.4), (11.35)."""
    known, dimension = asked.known, asked.dimension
    mu, rough = known.friction, known.friction > 0
    if known.components == ["f_n"]:
        return np.ones_like(mu), np.zeros_like(mu), np.zeros_like(mu)
    if "tau_n" in known.components:
        return np.where(rough, 2.0, 1.0), rough * 1.0, np.zeros_like(mu)
    constant = dimension * np.log(np.where(rough, mu, 1.0))
    return np.where(rough, dimension - 2.0, 1.0), rough * 1.0, constant


def _curvatures(asked: Asked) -> np.ndarray:
    """D / 2 per component, normal first (N, k, n)."""
    known, name, length = asked.known, asked.name, asked.length
    parts = [np.ones_like(known.friction)]
    for component in known.components:
        if component == "f_n":
            continue
        if name == "SumOfSquares":
            parts.append(np.zeros_like(known.friction))
        elif component == "tau_n":
            parts.append(
                np.ones_like(known.torsion) if length is None else (known.torsion / length[:, None]) ** 2
            )
        else:
            parts.append(known.friction**2)
    return np.stack(parts, -1)


def cost(asked: Asked, s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The criterion at scaled forces s (N, k, n), and the size that rounding is relative to."""
    known, name, weight = asked.known, asked.name, asked.weight
    head, live = s[..., 0], known.live
    top = np.max(np.where(live, head, -np.inf), -1)
    if name == "Gentlest":
        return top, np.abs(top)
    if name == "SmallestSum":
        value = np.sum(np.where(live, head, 0.0), -1)
        return value, np.abs(value)
    if name == "Robust":
        a, b, c = _log_det_terms(asked)
        tail = np.linalg.norm(s[..., 1:], axis=-1)
        log_det = a * np.log(np.where(live, head, 1.0)) + c
        log_det += np.where(b > 0, b * np.log(np.where(live, (head - tail) * (head + tail), 1.0)), 0.0)
        logs = np.where(live, log_det, 0.0)
        return top - weight * logs.sum(-1), np.abs(top) + weight * (1 + np.abs(logs).sum(-1))
    value = np.sum(np.where(live[..., None], _curvatures(asked) * s * s, 0.0), (-1, -2))
    return value, value


def robust_sensitivity(asked: Asked, s: np.ndarray) -> np.ndarray | float:
    """What a relative error of the forces is worth in the robust cost: ``weight sum b f_n / (f_n - psi)``."""
    if asked.name != "Robust":
        return 0.0
    known = asked.known
    _, b, _ = _log_det_terms(asked)
    head, tail = s[..., 0], np.linalg.norm(s[..., 1:], axis=-1)
    counted = known.live & (b > 0) & (head > tail)
    return asked.weight * np.sum(np.where(counted, b * head / np.where(counted, head - tail, 1.0), 0.0), -1)


def cost_change(asked: Asked, s: np.ndarray, shift: np.ndarray) -> np.ndarray:
    """(N,) what the criterion may grow by where the scaled forces change by ``shift`` (N,) at most."""
    known, name, weight = asked.known, asked.name, asked.weight
    if name == "Gentlest":
        return shift
    if name == "SmallestSum":
        return np.sqrt(known.live.sum(-1)) * shift
    if name == "Robust":
        assert weight is not None
        a, b, _ = _log_det_terms(asked)
        head = np.where(known.live, s[..., 0], 1.0)
        gap = head - np.linalg.norm(s[..., 1:], axis=-1)
        # Twice the derivative of a log f_n + b log((f_n - psi) (f_n + psi)), if the change is small beside both.
        slope = a / head + np.where(b > 0, 2 * b / np.where(b > 0, gap, 1.0), 0.0)
        slope = np.where(known.live, slope, 0.0)
        small = (shift[:, None] <= np.where(known.live, np.where(b > 0, gap, head), np.inf) / 4).all(-1)
        return np.where(small, shift + 2 * weight * slope.sum(-1) * shift, np.inf)
    curve = np.where(known.live[..., None], _curvatures(asked), 0.0)
    size = np.linalg.norm((curve * s).reshape(len(s), -1), axis=-1)
    return 2 * size * shift + np.max(curve, (-1, -2)) * shift * shift


def lower_bound(asked: Asked, multipliers: Multipliers, s: np.ndarray) -> np.ndarray:
    """What no admissible forces can undercut; s (N, k, n) near the optimum makes it close."""
    known, name, cap = asked.known, asked.name, asked.cap
    live, (y, rates, x) = known.live, multipliers
    gain = np.sum(y * asked.load, -1) - asked.joint_work(rates)
    tail = np.linalg.norm(x[..., 1:], axis=-1)
    rho = np.where(live, tail - x[..., 0], 0.0)
    if name in ("SmallestSum", "Gentlest"):
        violation = np.maximum(rho, 0.0)
        largest = violation.max(-1) if name == "SmallestSum" else violation.sum(-1)
        scaled = np.where(largest > 0, gain / np.where(largest > 0, largest, 1.0), 0.0)
        if name == "SmallestSum":
            uncovered = np.maximum(violation - 1.0, 0.0)
        else:
            uncovered = violation - _level_multipliers(violation, cap)
        paid = gain - _paid(uncovered, cap, 0.0)
        return np.maximum(np.maximum(scaled, paid), 0.0)
    if name == "Robust":
        return _robust_bound(asked, s, x, gain)
    half = _curvatures(asked)
    tangent = 2 * half[..., 1:] * s[..., 1:]
    rho = np.maximum(np.linalg.norm(x[..., 1:] + tangent, axis=-1) - x[..., 0], 0.0)
    spent = np.sum(tangent * s[..., 1:], -1)
    best = np.minimum(rho / 2, cap)
    return gain + np.sum(np.where(live, best * best - rho * best - spent / 2, 0.0), -1)


def _robust_bound(asked: Asked, s: np.ndarray, x: np.ndarray, gain: np.ndarray) -> np.ndarray:
    live, cap, weight = asked.known.live, asked.cap, asked.weight
    assert weight is not None
    a, b, c = _log_det_terms(asked)
    phi, psi = 2 * weight[:, None] * b, weight[:, None] * a
    head = np.where(live, s[..., 0], 0.0)
    level = np.minimum(head.max(-1, keepdims=True), cap)
    x_tail = np.linalg.norm(x[..., 1:], axis=-1)
    z_head = np.where(phi > 0, (phi + np.hypot(phi, 2 * level * x_tail)) / (2 * level), x_tail)
    needed = np.where(live, np.maximum(z_head + psi / level - x[..., 0], 0.0), 0.0)
    p = psi / np.where(live & (needed <= 0), s[..., 0], level)
    share = _level_multipliers(needed, cap)
    # What is lacking costs the cap beyond the level, or, unpaid, a second-order loss of the barrier: the less.
    lacking = needed - share
    floor, gap = np.where(phi > 0, (phi, z_head - x_tail), (psi, psi / level))
    cheaper = (cap - head.max(-1, keepdims=True)) * gap * gap <= floor / 2 * lacking
    paying = np.isfinite(cap) & (cheaper | (lacking > gap / 2))
    alpha = np.where(paying, lacking, 0.0)
    leads = live & (head >= head.max(-1, keepdims=True))
    spare = np.maximum(1.0 - share.sum(-1, keepdims=True), 0.0) * leads / leads.sum(-1, keepdims=True)
    z_head = share + spare + alpha + x[..., 0]
    # A contact without barrier only needs z in its cone.
    p = np.where(phi > 0, p, z_head - x_tail)
    z_head = z_head - p
    z_det = (z_head - x_tail) * (z_head + x_tail)
    pieces = _conjugate(phi, np.where(z_head > x_tail, z_det, 0.0), 0.5) + _conjugate(psi, p, 1.0)
    pieces = pieces - weight[:, None] * c
    paid = np.sum(np.where(alpha > 0, alpha * np.where(np.isfinite(cap), cap, 0.0), 0.0), -1)
    return gain - paid + np.sum(np.where(live, pieces, 0.0), -1)


def _conjugate(floor: np.ndarray, value: np.ndarray, power: float) -> np.ndarray:
    """``floor - floor log floor + power floor log value``, the conjugate of a barrier of weight ``floor``."""
    safe = np.where(floor > 0, floor, 1.0)
    logs = np.where(value > 0, np.log(np.where(value > 0, value, 1.0)), -np.inf)
    return np.where(floor > 0, safe - safe * np.log(safe) + power * safe * logs, 0.0)
