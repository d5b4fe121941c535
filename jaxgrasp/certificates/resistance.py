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

from .exact_lane import ExactLane
from .proof import LEVELS, Proof
from .rank import numeric_rank_fits, rounding_of, smallest_singular_value
from .reading import Fields
from .rebuilt import EPS, Rebuilt, part_of, rebuild, scaled_force, scaled_twist

__all__ = ["claim_of", "of_size_one", "prove_resistance"]

RESISTANT, NOT_RESISTANT, MARGINAL, UNDECIDED, INVALID = 1, 2, 3, 4, 5
NEARBY = 64.0  # eps: how far numbers may lie of which a proof to rounding speaks
FINE = 256.0  # eps: rounding that the balance of an internal force may show
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


def claim_of(grasp, answer, known: Rebuilt) -> Claim:
    """What the answer says, as it stands; Malformed where it is none."""
    batch, k, n = grasp.position.shape[:-2], *known.scale.shape[1:]
    m, said = 3 if grasp.position.shape[-1] == 2 else 6, Fields(answer, batch)
    return Claim(
        status=said.integers("status"),
        rank=said.integers("rank"),
        lower=said.numbers("lower"),
        upper=said.numbers("upper"),
        s=said.numbers("internal_force", k * n).reshape(-1, k, n),
        escape=said.numbers("escape_twist", m),
        bound=said.numbers("bound_twist", m),
    )


def prove_resistance(grasp, answer, tolerance: float | None = None) -> Proof:
    """What the evidence of ``answer`` proves of ``grasp``; shapes (*batch,)."""
    batch, dimension, known = grasp.position.shape[:-2], grasp.position.shape[-1], rebuild(grasp)
    claim = claim_of(grasp, answer, known)
    eps = float(np.finfo(np.dtype(grasp.position.dtype)).eps)
    with np.errstate(all="ignore"):
        parts = [
            _proved(part_of(known, lanes), part_of(claim, lanes), dimension, eps, tolerance)
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


def _unit(x: np.ndarray) -> np.ndarray:
    """Rows of size 1, however small or large they were; NaN where there is none."""
    flat = x.reshape(len(x), -1)
    flat = flat / np.max(np.abs(flat), -1, keepdims=True, initial=0.0)
    return (flat / np.linalg.norm(flat, axis=-1, keepdims=True)).reshape(x.shape)


def of_size_one(known: Rebuilt, claim: Claim, dimension: int) -> Claim:
    """Evidence scaled as A wants it, and brought to size 1."""
    with np.errstate(all="ignore"):
        live = known.live[..., None]
        s = scaled_force(_unit(np.where(live, claim.s, 0.0)), known.scale, known.normal_index)
        return claim._replace(
            s=_unit(np.where(live, s, 0.0)),
            escape=_unit(scaled_twist(_unit(claim.escape), known.length, dimension)),
            bound=_unit(scaled_twist(_unit(claim.bound), known.length, dimension)),
        )


def _proved(
    known: Rebuilt, claim: Claim, dimension: int, eps: float, tolerance: float | None
) -> tuple[np.ndarray, np.ndarray]:
    """Levels 0, 1, 2 and distances (N,)."""
    raw, claim = claim, of_size_one(known, claim, dimension)
    facts = _facts(known, claim)
    fits = numeric_rank_fits(known.A, claim.rank, facts.sigma, eps)
    marginal = _marginal(claim, tolerance, eps)
    sound = known.valid & fits & (claim.lower <= claim.upper) & np.isin(claim.status, (1, 2, 3, 4))
    sound &= _silent(known, raw) & _balances(known.A, claim, eps)
    full = claim.rank == known.A.shape[1]
    sound &= np.select([claim.status == RESISTANT, claim.status == MARGINAL], [full, full & marginal], True)
    verdict = np.select(
        [claim.status == word for word in (RESISTANT, NOT_RESISTANT, MARGINAL)],
        [facts.resistant, facts.escapes, facts.sigma > 0],
        True,
    )
    done = verdict & facts.at_least & facts.at_most
    level, distance = np.where(sound & done, 2, 0), np.zeros(len(sound))
    for i in np.flatnonzero(sound & ~done):
        lane = ExactLane(
            known,
            int(i),
            dimension,
            claim.s[i],
            claim.escape[i],
            claim.bound[i],
            (raw.escape[i], raw.bound[i]),
            NEARBY * eps,
        )
        proved = bool(verdict[i]), bool(facts.at_least[i]), bool(facts.at_most[i])
        ends = float(claim.lower[i]), float(claim.upper[i])
        level[i], distance[i] = _exactly(lane, int(claim.status[i]), ends, not full[i], proved)
    nothing = np.isnan(claim.lower) & np.isnan(claim.upper) & (claim.rank == -1)
    nothing &= np.isnan(raw.s).all((-1, -2)) & np.isnan(np.concatenate([raw.escape, raw.bound], -1)).all(-1)
    level[~known.valid & (claim.status == INVALID) & nothing] = 2
    return level, distance


def _silent(known: Rebuilt, raw: Claim) -> np.ndarray:
    """Contacts that do not count press nothing, and a grasp that holds names no twist."""
    absent = np.where(known.live[..., None], 0.0, raw.s)
    return (absent == 0).all((-1, -2)) & ((raw.escape == 0).all(-1) | (raw.status != RESISTANT))


def _balances(A: np.ndarray, claim: Claim, eps: float) -> np.ndarray:
    """The internal force given balances to rounding, where it has to prove anything; |s| = 1."""
    applied = np.linalg.norm(np.einsum("lij,lj->li", A, claim.s.reshape(len(A), -1)), axis=-1)
    idle = (claim.status != RESISTANT) & (claim.lower == -np.inf)
    return idle | (applied <= FINE * eps * np.linalg.norm(A, axis=(-2, -1)))


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


def _exactly(
    lane: ExactLane, status: int, ends: tuple[float, float], deficient: bool, proved: tuple[bool, bool, bool]
) -> tuple[int, float]:
    """Level and distance of one lane; ``proved``: verdict, lower and upper, as far as floating point has them.

    ends       lower and upper      deficient  the rank is not full
    """
    (lower, upper), (verdict, at_least, at_most), distance = ends, proved, 0.0
    if not verdict and status == RESISTANT:
        verdict = lane.resistant
    elif not verdict and status == MARGINAL:
        verdict = lane.full_rank
    elif not verdict:
        verdict = lane.escape is not None
        if not verdict:
            distance = lane.distance
            verdict = distance <= lane.nearby
    if not verdict:
        return 0, np.inf
    if not (at_least or lane.at_least(lower)):
        distance = max(distance, lane.at_least_nearby(lower) if deficient else np.inf)
    if not (at_most or lane.at_most(upper)):
        distance = max(distance, lane.at_most_nearby(upper))
    if distance > lane.nearby:
        return 0, np.inf
    return (2, 0.0) if distance == 0.0 else (1, distance)
