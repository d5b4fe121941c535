"""The kinds of answers that are damaged, and what is true of them: 70 digits, Clarabel, convex hulls; not the checker.

Every judgement asks for a clear difference (``CLEAR``), so that what is called false is false beyond all rounding.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
from exact_margin import ExactMap
from force_oracle import clarabel_forces, folded_map, log_det_terms
from damaged_answers import CLEAR, Kind
from scipy.spatial import ConvexHull, QhullError

import jaxgrasp as jg

__all__ = ["epsilon_kind", "force_kind", "resistance_kind"]

RESISTANT, NOT_RESISTANT, MARGINAL, UNDECIDED, INVALID, OPTIMAL, INFEASIBLE = 1, 2, 3, 4, 5, 6, 7


def _numpy(answer: Any) -> Any:
    out = type(answer).__new__(type(answer))
    for name in answer.__dataclass_fields__:
        value = getattr(answer, name)
        object.__setattr__(out, name, value if isinstance(value, str | float) else np.asarray(value))
    return out


def _components(grasp: jg.Grasp) -> list[str]:
    return [c.value for c in grasp.model.components(grasp.dimension)]


def _coefficients(grasp: jg.Grasp) -> tuple[np.ndarray, np.ndarray]:
    return np.asarray(grasp.model.friction_coefficient), np.asarray(grasp.model.torsion_coefficient)


def _exact_maps(grasp: jg.Grasp) -> list[ExactMap]:
    mu, gamma = _coefficients(grasp)
    p, n, live = (np.asarray(x) for x in (grasp.position, grasp.normal, grasp.active))
    return [
        ExactMap(p[i][live[i]], n[i][live[i]], mu[i][live[i]], gamma[i][live[i]], _components(grasp))
        for i in range(len(p))
    ]


def resistance_kind(name: str, grasp: jg.Grasp) -> Kind:
    """Verdicts; t* is enclosed in 70 digits, evidence is evaluated in 70 digits."""
    answer, maps, live = _numpy(jg.wrench_resistance(grasp)), _exact_maps(grasp), np.asarray(grasp.active)
    k = live.shape[-1]

    def of_lane(x: np.ndarray, i: int) -> np.ndarray:
        return x[i].reshape(k, -1)[live[i]]

    low = np.array([float(m.lower(of_lane(answer.internal_force, i))) for i, m in enumerate(maps)])
    high = np.array([float(m.upper(answer.bound_twist[i])) for i, m in enumerate(maps)])
    full = np.array([m.full_rank for m in maps])
    depth = np.array([float(m.escape_depth(answer.escape_twist[i])) for i, m in enumerate(maps)])

    def says_false(said: Any, field: str) -> np.ndarray:
        lower, upper = np.asarray(said.lower, float), np.asarray(said.upper, float)
        if field == "status":
            code = said.status
            wrong = ~np.isin(code, (1, 2, 3, 4)) | ((code == RESISTANT) & (high < -CLEAR))
            wrong |= (code == NOT_RESISTANT) & full & (low > CLEAR)
            return wrong | ((code == MARGINAL) & ((low > 1e-3 + CLEAR) | (high < -1e-3 - CLEAR)))
        if field == "rank":
            return (said.rank != answer.rank) & (full | (said.rank > np.array([m.A.shape[0] for m in maps])) | (said.rank < 1))
        if field == "lower":
            return full & (np.isnan(lower) | (lower > high + CLEAR * np.maximum(1, np.abs(high))) | (lower > upper + CLEAR))
        if field == "upper":
            return full & (np.isnan(upper) | (upper < low - CLEAR * np.maximum(1, np.abs(low))) | (upper < lower - CLEAR))
        if field == "internal_force":
            with np.errstate(all="ignore"):
                shown = np.array([float(m.lower(of_lane(said.internal_force, i))) for i, m in enumerate(maps)])
            needs = full & (np.isfinite(lower) | (said.status == RESISTANT))
            return needs & ((shown < lower - CLEAR * (1 + np.abs(lower))) | ((said.status == RESISTANT) & (shown < -CLEAR)))
        if field == "bound_twist":
            shown = np.array([float(m.upper(said.bound_twist[i])) for i, m in enumerate(maps)])
            return full & (shown > upper + CLEAR * (1 + np.abs(upper))) & (upper < 1 - CLEAR)
        shown = np.array([float(m.escape_depth(said.escape_twist[i])) for i, m in enumerate(maps)])
        return (said.status == NOT_RESISTANT) & (shown < np.minimum(depth, 0) - 1e-4)

    fields = ("status", "lower", "upper", "rank", "internal_force", "escape_twist", "bound_twist")
    return Kind(f"WrenchResistance, {name}", answer, fields, partial(jg.check, grasp), says_false)


CRITERIA = {
    "gentlest": jg.Gentlest, "robust": jg.Robust, "smallest sum": jg.SmallestSum,
    "sum of squares": jg.SumOfSquares, "least norm": jg.LeastNorm,
}  # fmt: skip


class _Forces:
    """One force problem a lane, in numpy: balance, limits and cost of any forces."""

    def __init__(self, grasp: jg.Grasp, wrench, criterion: str, parameter, cap, limits):
        self.criterion, self.parameter, self.wrench, self.cap, self.limits = criterion, parameter, wrench, cap, limits
        self.components, self.live = _components(grasp), np.asarray(grasp.active)
        mu, gamma = _coefficients(grasp)
        self.mu, self.gamma, self.dimension = mu, gamma, grasp.dimension
        p, n = np.asarray(grasp.position), np.asarray(grasp.normal)
        args = [(p[i], n[i], mu[i], gamma[i], self.live[i], self.components, wrench[i]) for i in range(len(p))]
        extra = [
            (None if cap is None else cap[i], None if limits is None else (limits[0][i], limits[1][i]))
            for i in range(len(p))
        ]
        solved = [clarabel_forces(*a, criterion, parameter, *e) for a, e in zip(args, extra, strict=True)]
        self.optimal = np.array([s[0] == "optimal" for s in solved])
        self.infeasible = np.array([s[0] == "infeasible" for s in solved])
        self.best = np.array([s[1] if s[0] == "optimal" else np.nan for s in solved])
        self.maps = [folded_map(p[i], n[i], mu[i], gamma[i], self.components) for i in range(len(p))]

    def scaled(self, force: np.ndarray, i: int) -> np.ndarray:
        """s (k, n), normal first."""
        by_name = {"f_x": self.mu[i], "f_y": self.mu[i], "f_n": np.ones_like(self.mu[i]), "tau_n": self.gamma[i]}
        f = force.reshape(len(self.mu[i]), -1)
        columns = {c: np.where(f[:, j] == 0, 0.0, f[:, j] / by_name[c]) for j, c in enumerate(self.components)}
        return np.stack([columns.pop("f_n"), *columns.values()], -1)

    def broken(self, force: np.ndarray, i: int) -> bool:
        """Whether forces miss the balance, a cone or a limit clearly."""
        s = self.scaled(force, i)
        if not np.isfinite(s).all() or s[~self.live[i]].any():
            return True
        blocks, length = self.maps[i]
        d, w = self.dimension, self.wrench[i]
        load = np.concatenate([w[:d], w[d:] / length])
        size = np.linalg.norm(s) + np.linalg.norm(load)
        applied = np.einsum("kmn,kn->m", blocks, s) + load
        tight = CLEAR * 10 * size
        off = np.linalg.norm(applied) > tight * (1 + np.linalg.norm(blocks))
        off |= bool((np.linalg.norm(s[:, 1:], axis=-1) > s[:, 0] + tight)[self.live[i]].any())
        if self.cap is not None:
            off |= bool((s[:, 0] > self.cap[i] + tight)[self.live[i]].any())
        if self.limits is not None:
            jacobian, torque = self.limits[0][i], self.limits[1][i]
            wide = np.abs(jacobian).sum(0) * tight + CLEAR * torque
            off |= bool((np.abs(jacobian.T @ force) > torque + wide).any())
        return bool(off)

    def cost(self, force: np.ndarray, i: int) -> float:
        """The criterion at any forces; NaN where it has none."""
        s, live = self.scaled(force, i), self.live[i]
        f = force.reshape(len(live), -1)
        if self.criterion == "gentlest":
            return s[live, 0].max()
        if self.criterion == "smallest sum":
            return s[live, 0].sum()
        if self.criterion == "sum of squares":
            return (s[live, 0] ** 2).sum()
        if self.criterion == "least norm":
            scale = [self.parameter if c == "tau_n" else 1.0 for c in self.components]
            return ((f[live] / scale) ** 2).sum()
        logs = 0.0
        for j in np.flatnonzero(live):
            a, b, c = log_det_terms(self.mu[i, j], self.components, self.dimension)
            head, tail = s[j, 0], np.linalg.norm(s[j, 1:])
            if head <= 0 or (b and head <= tail):
                return np.nan
            logs += a * np.log(head) + (b * np.log((head - tail) * (head + tail)) if b else 0.0) + c
        return s[live, 0].max() - self.parameter * logs


def force_kind(name: str, grasp: jg.Grasp, wrench, criterion: str, parameter=None, cap=None, limits=None) -> Kind:
    """Forces; the optimum by Clarabel, balance, cones and cost by numpy."""
    made = CRITERIA[criterion]() if parameter is None else CRITERIA[criterion](parameter)
    asked = {"criterion": made, "max_normal": cap, "torque_limits": limits}
    answer = _numpy(jg.optimize_forces(grasp, wrench, **asked))
    posed = _Forces(grasp, wrench, criterion, parameter, cap, limits)
    best = posed.best
    with np.errstate(all="ignore"):
        size = np.maximum(np.abs(best), 1e-3) + (10 * parameter if criterion == "robust" else 0.0)
    homogeneous = criterion in ("gentlest", "smallest sum")

    def gain(said: Any, twist: np.ndarray) -> np.ndarray:
        """Work of the load less what the joints can do; of an escape twist, without the joints where that shows more."""
        value = np.sum(twist * wrench, -1)
        if twist is said.escape_twist:
            return np.where(np.isfinite(said.joint_rates).all(-1), value, np.nan)
        rates = np.abs(said.joint_rates)
        paid = np.where(rates == 0, 0.0, rates * (limits[1] if limits is not None else 0.0))
        return value - paid.sum(-1)

    def says_false(said: Any, field: str) -> np.ndarray:
        status, n = np.asarray(said.status), len(best)
        lower, upper = np.asarray(said.lower, float), np.asarray(said.upper, float)
        optimal, lost = status == OPTIMAL, status == INFEASIBLE
        with np.errstate(all="ignore"):
            if field == "status":
                wrong = ~np.isin(status, (6, 7, 8)) | (optimal & posed.infeasible) | (lost & posed.optimal)
                return wrong | (lost & np.isfinite(upper)) | (optimal & ~np.isfinite(upper))
            if field == "lower":
                wrong = np.isnan(lower) | (lower > best + 10 * CLEAR * size) | (lower > upper)
                return wrong | (optimal & (upper - lower > 1e-5 * size)) | (lost & (lower != np.inf))
            if field == "upper":
                costs = np.array([posed.cost(said.force[i], i) for i in range(n)])
                wrong = np.isnan(upper) | (upper < best - 10 * CLEAR * size) | (lost & (upper != np.inf))
                return wrong | (optimal & ~(np.abs(upper - costs) <= 10 * CLEAR * size))
            if field == "force":
                costs = np.array([posed.cost(said.force[i], i) for i in range(n)])
                broken = np.array([posed.broken(said.force[i], i) for i in range(n)])
                return np.where(lost, (said.force != 0).any(-1), optimal & (broken | ~(np.abs(costs - upper) <= 10 * CLEAR * size)))
            if field == "escape_twist":
                work = gain(said, said.escape_twist)
                return lost & ~(work > 0)
            # What forces of size 0 would cost bounds every dual function, but for that of logarithms.
            shown = gain(said, said.load_twist)
            if field == "joint_rates":
                shown = np.where(lost, gain(said, said.escape_twist), shown)
                return (lost & ~(shown > 0)) | (optimal & (criterion != "robust") & (lower > CLEAR * size) & ~(shown > 0))
            if criterion == "robust":
                return optimal & ~np.isfinite(said.load_twist).all(-1)
            least = np.zeros(n) if homogeneous else lower - 10 * CLEAR * size
            return optimal & (lower > 10 * CLEAR * size) & ~(shown > least)

    fields = ("status", "force", "lower", "upper", "load_twist", "escape_twist", *(("joint_rates",) if limits else ()))
    return Kind(f"OptimalForces, {name}", answer, fields, partial(jg.check, grasp, wrench=wrench, **asked), says_false)


def epsilon_kind(name: str, grasp: jg.Grasp, norm: str) -> Kind:
    """Epsilon; its lower bound by Qhull, its upper by the support function, its verdict by 70 digits."""
    answer = _numpy(jg.epsilon_quality(grasp, norm=norm, certificate=True))
    verdict = resistance_kind(name, grasp)
    parts = _components(grasp)
    mu, gamma = _coefficients(grasp)
    p, n, live, d = np.asarray(grasp.position), np.asarray(grasp.normal), np.asarray(grasp.active), grasp.dimension
    lanes = range(len(p))
    maps = [folded_map(p[i], n[i], mu[i], gamma[i], parts) for i in lanes]

    def blocks(i: int, scale: float) -> np.ndarray:
        A = maps[i][0].copy()
        A[:, d:] *= maps[i][1] / scale
        return A

    def support(i: int, said: Any) -> float:
        v = np.einsum("kmn,m->kn", blocks(i, said.torque_scale[i]), said.direction[i])
        h = np.maximum(v[:, 0] + np.linalg.norm(v[:, 1:], axis=-1), 0.0)[live[i]]
        return h.max() if said.norm == "L1" else h.sum()

    def scaled(i: int, forces: np.ndarray) -> np.ndarray:
        by_name = {"f_x": mu[i], "f_y": mu[i], "f_n": np.ones_like(mu[i]), "tau_n": gamma[i]}
        f = forces.reshape(len(forces), len(mu[i]), -1)
        columns = {c: np.where(f[..., j] == 0, 0.0, f[..., j] / by_name[c]) for j, c in enumerate(parts)}
        return np.stack([columns.pop("f_n"), *columns.values()], -1)

    def too_much(i: int, forces: np.ndarray, kind: str) -> bool:
        s = scaled(i, forces)
        effort = s[..., 0].sum(-1) if kind == "L1" else s[..., 0].max(-1)
        fits = np.isfinite(s).all() and (effort <= 1 + CLEAR).all()
        return not (fits and (np.linalg.norm(s[..., 1:], axis=-1) <= s[..., 0] + CLEAR).all())

    def radius(i: int, said: Any) -> float:
        points = np.einsum("kmn,vkn->vm", blocks(i, said.torque_scale[i]), scaled(i, said.forces[i]))
        try:
            return float(-ConvexHull(points).equations[:, -1].max())
        except (QhullError, ValueError):
            return 0.0

    def closed(i: int, facets: np.ndarray) -> bool:
        facets = facets[facets[:, 0] >= 0]
        if not len(facets) or facets.min() < 0 or facets.max() >= answer.forces.shape[1]:
            return False
        ridges = np.concatenate([np.delete(np.sort(facets, 1), j, 1) for j in range(facets.shape[1])])
        return bool((np.unique(ridges, axis=0, return_counts=True)[1] == 2).all())

    with np.errstate(all="ignore"):
        low = np.array([radius(i, answer) if answer.status[i] == RESISTANT else 0.0 for i in lanes])
        high = np.array([support(i, answer) for i in lanes])

    def says_false(said: Any, field: str) -> np.ndarray:
        status, lower, upper = said.status, np.asarray(said.lower, float), np.asarray(said.upper, float)
        yes = answer.status == RESISTANT
        with np.errstate(all="ignore"):
            if field == "status":
                wrong = verdict.false(said, "status") | ((status == NOT_RESISTANT) & (upper > 0))
                return wrong | ((status == RESISTANT) & (lower <= 0))
            if field in ("lower", "upper"):
                wrong = np.isnan(lower + upper) | (lower > upper * (1 + CLEAR)) | (lower > high * (1 + CLEAR)) | (lower < 0)
                wrong |= upper < low * (1 - CLEAR)
                return wrong | ((status == NOT_RESISTANT) & ((lower != 0) | (upper != 0)))
            out = np.zeros(len(status), bool)
            for i in lanes:
                scale = said.torque_scale[i]
                if field == "torque_scale" and not 0 < scale < np.inf:
                    out[i] = True
                elif field == "direction":
                    v = said.direction[i]
                    off = not abs(np.linalg.norm(v) - 1) <= CLEAR
                    out[i] = off or (yes[i] and support(i, said) > upper[i] * (1 + CLEAR) + 1e-9)
                elif field == "touching":
                    out[i] = too_much(i, said.touching[i][None], said.norm)
                elif field == "forces":
                    out[i] = yes[i] and (too_much(i, said.forces[i], said.norm) or radius(i, said) < lower[i] * (1 - CLEAR))
                elif field == "facets":
                    out[i] = yes[i] and not closed(i, said.facets[i])
                elif yes[i]:
                    out[i] = support(i, said) > upper[i] * (1 + CLEAR) or radius(i, said) < lower[i] * (1 - CLEAR)
                    out[i] |= too_much(i, said.forces[i], said.norm)
        return out

    fields = ("status", "lower", "upper", "direction", "touching", "forces", "facets", "torque_scale", "norm")
    return Kind(f"EpsilonQuality, {norm}, {name}", answer, fields, partial(jg.check, grasp), says_false)
