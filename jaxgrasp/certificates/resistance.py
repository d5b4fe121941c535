"""Wrench resistance proved again, without trusting the solver (theory section 2; prior art: Boyd, Wegbreit 2007).

It rebuilds the folded grasp map A from positions, normals, mu and gamma, lengths divided by L = max_i |p_i|, and asks:

    RESISTANT      A has full rank, and some s with A s = 0 lies strictly inside every cone
    NOT_RESISTANT  the escape twist xi has A_i^T xi in the (self-dual) cone at every contact
    MARGINAL       full rank, and the bracket shows |t*| <= tolerance
    UNDECIDED      nothing but the bracket
    INVALID        the numbers are indeed no grasp
    lower          the internal force shows t* >= lower         upper   the bound twist shows t* <= upper
    rank           singular values of A above 64 eps |A|

In floating point first, with bounds of all rounding: an exact internal force lies within (|A s| + c |A| |s|) / sigma of
s, sigma a proven bound of the smallest singular value. What that leaves open is decided in integers, lane by lane. A
verdict by the rank of A alone may hold only by rounding: then the twist escapes from numbers within 64 eps.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from .dyadic import exact_grasp
from .elimination import independent
from .enclosures import DIGITS
from .exact_force import internal_force, margin_at_least, scaled_lane
from .exact_twist import escape_twist, margin_at_most, moves_all_alike, rounding_distance
from .proof import LEVELS, Proof
from .rank import numeric_rank_fits, rounding_of, smallest_singular_value
from .reading import Fields
from .rebuilt import EPS, Rebuilt, rebuild, scaled_force, scaled_twist

__all__ = ["prove_resistance"]

RESISTANT, NOT_RESISTANT, MARGINAL, UNDECIDED, INVALID = 1, 2, 3, 4, 5
NEARBY = 64.0  # eps: how far numbers may lie of which a proof to rounding speaks
LARGEST_CLAIM = 1e-3  # a bracket this wide is not marginal
LANES = 2048  # at once: what fits a cache


class Claim(NamedTuple):
    """What the lanes say: status, rank, lower, upper (N,); s (N, k, n) normal first; twists (N, m), lengths over L."""

    status: np.ndarray
    rank: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    s: np.ndarray
    escape: np.ndarray
    bound: np.ndarray


class Facts(NamedTuple):
    """What floating point proves of each lane (N,): bool, and the margins behind it.

    sigma      a lower bound of the smallest singular value of A     near   an exact internal force lies within
    resistant, escapes, at_least, at_most      the verdicts, and both ends of the bracket
    """

    sigma: np.ndarray
    resistant: np.ndarray
    escapes: np.ndarray
    at_least: np.ndarray
    at_most: np.ndarray


def prove_resistance(grasp, answer, tolerance: float | None = None) -> Proof:
    """What the evidence of ``answer`` proves of ``grasp``; shapes (*batch,)."""
    batch, k, dimension = grasp.position.shape[:-2], grasp.position.shape[-2], grasp.position.shape[-1]
    m, known = 3 if dimension == 2 else 6, rebuild(grasp)
    n = len(known.components)
    said = Fields(answer, batch)
    claim = Claim(
        status=said.numbers("status"),
        rank=said.numbers("rank"),
        lower=said.numbers("lower"),
        upper=said.numbers("upper"),
        s=said.numbers("internal_force", k * n).reshape(-1, k, n),
        escape=said.numbers("escape_twist", m),
        bound=said.numbers("bound_twist", m),
    )
    eps = float(np.finfo(np.dtype(grasp.position.dtype)).eps)
    parts = [
        _proved(_part(known, lanes), _part(claim, lanes), dimension, eps, tolerance)
        for lanes in _slices(len(known.valid))
    ]
    level, distance = (np.concatenate(x).reshape(batch) for x in zip(*parts, strict=True)) if parts else (
        np.zeros(batch, int), np.zeros(batch),
    )  # fmt: skip
    lower, upper = (np.where(level > 0, x.reshape(batch), np.nan) for x in (claim.lower, claim.upper))
    distance = np.where(level == 2, 0.0, np.where(level == 1, distance, np.inf))
    return Proof(LEVELS[level], distance, lower, upper, np.zeros(batch))


def _slices(count: int) -> list[slice]:
    return [slice(start, start + LANES) for start in range(0, count, LANES)]


def _part(arrays, lanes: slice):
    return arrays._replace(
        **{name: x[lanes] for name, x in arrays._asdict().items() if isinstance(x, np.ndarray)}
    )


def _unit(x: np.ndarray) -> np.ndarray:
    """Rows of size 1, however small or large they were; NaN where there is none."""
    flat = x.reshape(len(x), -1)
    flat = flat / np.max(np.abs(flat), -1, keepdims=True, initial=0.0)
    return (flat / np.linalg.norm(flat, axis=-1, keepdims=True)).reshape(x.shape)


def _proved(
    known: Rebuilt, claim: Claim, dimension: int, eps: float, tolerance: float | None
) -> tuple[np.ndarray, np.ndarray]:
    """Levels 0, 1, 2 and distances (N,)."""
    with np.errstate(all="ignore"):
        live = known.live[..., None]
        s = scaled_force(_unit(np.where(live, claim.s, 0.0)), known.scale, known.normal_index)
        s = np.where(live, s, 0.0)
        claim = claim._replace(
            s=_unit(s),
            escape=_unit(scaled_twist(_unit(claim.escape), known.length, dimension)),
            bound=_unit(scaled_twist(_unit(claim.bound), known.length, dimension)),
        )
        facts = _facts(known, claim)
        fits = numeric_rank_fits(known.A, claim.rank, facts.sigma, eps)
        marginal = _marginal(claim, tolerance, eps)
    sound = known.valid & fits & (claim.lower <= claim.upper) & np.isin(claim.status, (1, 2, 3, 4))
    full = claim.rank == known.A.shape[1]
    sound &= np.select([claim.status == RESISTANT, claim.status == MARGINAL], [full, full & marginal], True)
    verdict = np.select(
        [claim.status == word for word in (RESISTANT, NOT_RESISTANT, MARGINAL)],
        [facts.resistant, facts.escapes, facts.sigma > 0],
        True,
    )
    done = verdict & facts.at_least & facts.at_most
    level, distance = np.where(sound & done, 2, 0), np.zeros(len(sound))
    for lane in np.flatnonzero(sound & ~done):
        open_lane = _Lane(known, claim, lane, dimension, NEARBY * eps)
        level[lane], distance[lane] = open_lane.proved(
            bool(verdict[lane]), bool(facts.at_least[lane]), bool(facts.at_most[lane])
        )
    nothing = np.isnan(claim.lower) & np.isnan(claim.upper) & (claim.rank == -1)
    level[~known.valid & (claim.status == INVALID) & nothing] = 2
    return level, distance


def _facts(known: Rebuilt, claim: Claim) -> Facts:
    """What needs no integers."""
    A, live, count = known.A, known.live, known.live.sum(-1)
    rounding = rounding_of(A)
    sigma = smallest_singular_value(A, rounding)
    slack, total, shift = _near_exact(known, claim.s, sigma, rounding)
    # Scaled to a mean normal force of 1, exact forces have at least this margin.
    room = slack - np.sqrt(2.0) * shift
    most = np.where(claim.lower >= 0, total + np.sqrt(count) * shift, total - np.sqrt(count) * shift)
    blur = (8 + count) * EPS * (np.abs(claim.lower) * total + count)
    at_least = (total > np.sqrt(count) * shift) & (room * count - blur >= claim.lower * most)
    resistant = (sigma > 0) & (room > 8 * EPS)

    depth, blur = _depth(known, claim.escape)
    escapes = np.min(np.where(live, depth - blur, np.inf), -1) > 0
    at_most = _shows_upper(known, claim) | (claim.upper >= 1)
    return Facts(sigma, resistant, escapes, at_least | (claim.lower == -np.inf), at_most)


def _near_exact(
    known: Rebuilt, s: np.ndarray, sigma: np.ndarray, rounding: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Least ``s_0 - |s_t|``, sum of s_0, and how far off the nearest exact internal force may be, for |s| = 1."""
    slack = np.min(np.where(known.live, s[..., 0] - np.linalg.norm(s[..., 1:], axis=-1), np.inf), -1)
    applied = np.linalg.norm(np.einsum("lij,lj->li", known.A, s.reshape(len(s), -1)), axis=-1)
    shift = (applied + rounding) / np.where(sigma > 0, sigma, 1.0) * (1 + 8 * EPS)
    return slack, s[..., 0].sum(-1), np.where(sigma > 0, shift, np.inf)


def _depth(known: Rebuilt, xi: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """``x_0,i - |x_t,i|`` of ``x_i = A_i^T xi`` (N, k), |xi| = 1, and what rounding can do to it."""
    x = np.einsum("lkij,li->lkj", known.blocks, xi)
    blur = 24 * EPS * np.linalg.norm(known.blocks, axis=(-2, -1))
    return x[..., 0] - np.linalg.norm(x[..., 1:], axis=-1), blur


def _shows_upper(known: Rebuilt, claim: Claim) -> np.ndarray:
    """``u T + (1 - u) k (x_0,i - |x_t,i|) >= 0`` for all i and ``T = sum x_0,i > 0``: t* <= u (see ``exact_twist``)."""
    depth, blur = _depth(known, claim.bound)
    count = known.live.sum(-1)
    x0 = np.einsum("lki,li->lk", known.blocks[..., 0], claim.bound)
    total = np.where(known.live, x0, 0.0).sum(-1)
    error = np.where(known.live, blur, 0.0).sum(-1) + count * EPS * np.abs(x0).sum(-1)
    u = claim.upper
    short = np.min(np.where(known.live, depth - blur, np.inf), -1)
    value = u * total + (1 - u) * count * short
    size = np.abs(u) * (error + 2 * EPS * total) + (1 - u) * count * 4 * EPS * (np.abs(short) + 1)
    return (total > error) & (value > size) & np.isfinite(u)


def _marginal(claim: Claim, tolerance: float | None, eps: float) -> np.ndarray:
    """The bracket lies within what MARGINAL may claim."""
    largest = np.maximum(np.abs(claim.lower), np.abs(claim.upper))
    if tolerance is None:
        return largest < LARGEST_CLAIM
    resolution = 2e4 * eps if eps < 1e-10 else 160 * eps
    return largest <= 2 * max(float(tolerance), resolution)


class _Lane:
    """One lane in integers."""

    def __init__(self, known: Rebuilt, claim: Claim, lane: int, dimension: int, nearby: float):
        live = known.live[lane]
        self.claim, self.lane, self.nearby = claim, lane, nearby
        self.friction = known.friction[lane][live]
        self.grasp = exact_grasp(
            known.position[lane][live], known.normal[lane][live], self.friction, known.torsion[lane][live]
        )
        self.scaled = scaled_lane(known, lane, dimension)
        self.s = claim.s[lane][live]

    def proved(self, verdict: bool, at_least: bool, at_most: bool) -> tuple[int, float]:
        """Level and distance, with what floating point proved already."""
        claim, lane, status = self.claim, self.lane, int(self.claim.status[self.lane])
        lower, upper = float(claim.lower[lane]), float(claim.upper[lane])
        rows, distance = len(self.grasp.rows), 0.0
        forces = None
        if not at_least or (status == RESISTANT and not verdict) or (status == MARGINAL and not verdict):
            forces = internal_force(self.grasp, self.scaled, self.s)
            full = forces is not None and forces[1] == rows
            if status == RESISTANT:
                verdict = full and self.grasp.strictly_inside(forces[0])
            elif status == MARGINAL:
                verdict = full
        if status == NOT_RESISTANT and not verdict and np.isfinite(claim.escape[lane]).all():
            verdict = escape_twist(self.grasp, self.scaled, claim.escape[lane]) is not None
            if not verdict:
                distance = rounding_distance(self.grasp, self.scaled, claim.escape[lane], self.friction)
                verdict = distance <= self.nearby
        if not verdict:
            return 0, np.inf
        low = at_least or (
            forces is not None and any(margin_at_least(self.grasp, forces[0], lower, d) for d in DIGITS)
        )
        deficient = claim.rank[lane] < rows
        if not low and deficient:
            low, distance = self._lower_by_rounding(lower, distance)
        high = at_most or (
            self._nothing_normal()
            if upper == -np.inf
            else np.isfinite(claim.bound[lane]).all()
            and any(margin_at_most(self.grasp, self.scaled, claim.bound[lane], upper, d) for d in DIGITS)
        )
        if not high:
            high, distance = self._upper_by_rounding(upper, distance)
        if not (low and high):
            return 0, np.inf
        return (2, 0.0) if distance == 0.0 else (1, distance)

    def _nothing_normal(self) -> bool:
        """No internal force has a normal component, exactly: t* = -inf."""
        return independent(self.grasp.unit_wrenches()[0]) or moves_all_alike(self.grasp)

    def _lower_by_rounding(self, lower: float, distance: float) -> tuple[bool, float]:
        """Some map within ``residual / (|A| |s|)`` of A, relatively, has the internal force s itself."""
        s, A = self.s, self.scaled.A
        if not np.isfinite(s).all():
            return False, distance
        residual = float(np.linalg.norm(A @ s.ravel()) / np.linalg.norm(A)) + A.shape[1] * EPS
        tails, total = np.linalg.norm(s[:, 1:], axis=-1), float(s[:, 0].sum())
        shown = len(s) * float(np.min(s[:, 0] - tails)) / total if total > 0 else -np.inf
        holds = residual <= self.nearby and shown >= lower - self.nearby
        return holds, max(distance, residual)

    def _upper_by_rounding(self, upper: float, distance: float) -> tuple[bool, float]:
        """t* = -inf of an A within rounding: the twist moves all contacts alike, along their normals."""
        if upper != -np.inf or not np.isfinite(self.claim.bound[self.lane]).all():
            return False, distance
        x = (self.scaled.A.T @ self.claim.bound[self.lane]).reshape(self.s.shape)
        mean = float(x[:, 0].mean())
        off = max(float(np.abs(x[:, 0] - mean).max()), float(np.abs(x[:, 1:]).max(initial=0.0)))
        return mean > 0 and off <= self.nearby * mean, max(distance, off)
