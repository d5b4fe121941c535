"""The kinds of answers that are damaged, and what is true of them: 70 digits, Clarabel, convex hulls; not the checker.

Every judgement asks for a clear difference (``CLEAR``), so that what is called false is false beyond all rounding.
"""

from __future__ import annotations

from functools import cache, partial
from typing import Any

import numpy as np
from damaged_answers import CLEAR, Kind
from exact_margin import ExactMap
from force_oracle import folded_map
from force_problems import CRITERIA as PARAMETERS
from force_problems import problems
from force_truth import ForceTruth, coefficients_of, components_of
from grasps import random_active, random_coefficients, random_contacts
from scipy.spatial import ConvexHull, QhullError

import jaxgrasp as jg

__all__ = ["epsilon_kind", "exact_map", "force_kind", "kind_of", "random_grasps", "resistance_kind"]

RESISTANT, NOT_RESISTANT, MARGINAL, UNDECIDED, INVALID, OPTIMAL, INFEASIBLE = 1, 2, 3, 4, 5, 6, 7


def _numpy(answer: Any) -> Any:
    out = type(answer).__new__(type(answer))
    for name in answer.__dataclass_fields__:
        value = getattr(answer, name)
        object.__setattr__(out, name, value if isinstance(value, str | float) else np.asarray(value))
    return out


def exact_map(grasp: jg.Grasp, i: int) -> ExactMap:
    """Grasp ``i`` in 70 digits."""
    live = np.asarray(grasp.active[i])
    arrays = (grasp.position, grasp.normal, *coefficients_of(grasp))
    return ExactMap(*(np.asarray(x[i])[live] for x in arrays), components_of(grasp))


def resistance_kind(name: str, grasp: jg.Grasp) -> Kind:
    """Verdicts; t* is enclosed in 70 digits, evidence is evaluated in 70 digits."""
    answer, maps, live = (
        _numpy(jg.wrench_resistance(grasp)),
        [exact_map(grasp, i) for i in range(len(grasp.position))],
        np.asarray(grasp.active),
    )
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
            return (said.rank != answer.rank) & (
                full | (said.rank > np.array([m.A.shape[0] for m in maps])) | (said.rank < 1)
            )
        if field == "lower":
            return full & (
                np.isnan(lower)
                | (lower > high + CLEAR * np.maximum(1, np.abs(high)))
                | (lower > upper + CLEAR)
            )
        if field == "upper":
            return full & (
                np.isnan(upper) | (upper < low - CLEAR * np.maximum(1, np.abs(low))) | (upper < lower - CLEAR)
            )
        if field == "internal_force":
            with np.errstate(all="ignore"):
                shown = np.array(
                    [float(m.lower(of_lane(said.internal_force, i))) for i, m in enumerate(maps)]
                )
            needs = full & (np.isfinite(lower) | (said.status == RESISTANT))
            return needs & (
                (shown < lower - CLEAR * (1 + np.abs(lower)))
                | ((said.status == RESISTANT) & (shown < -CLEAR))
            )
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


def force_kind(
    name: str, grasp: jg.Grasp, wrench, criterion: str, parameter=None, cap=None, limits=None
) -> Kind:
    """Forces; the optimum by Clarabel, balance, cones and cost by numpy."""
    made = CRITERIA[criterion]() if parameter is None else CRITERIA[criterion](parameter)
    asked = {"criterion": made, "max_normal": cap, "torque_limits": limits}
    answer = _numpy(jg.optimize_forces(grasp, wrench, **asked))
    posed = ForceTruth(grasp, wrench, criterion, parameter, cap, limits)
    best = posed.best
    with np.errstate(all="ignore"):
        known = np.where(np.isfinite(best), best, np.where(np.isfinite(answer.upper), answer.upper, 1.0))
        size = np.maximum(np.abs(known), 1e-3) + (10 * parameter if criterion == "robust" else 0.0)
    homogeneous = criterion in ("gentlest", "smallest sum")

    def gain(said: Any, twist: np.ndarray) -> np.ndarray:
        """Work of the load less what the joints can do; along an escape twist, without the joints."""
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
                return np.where(
                    lost,
                    (said.force != 0).any(-1),
                    optimal & (broken | ~(np.abs(costs - upper) <= 10 * CLEAR * size)),
                )
            if field == "escape_twist":
                work = gain(said, said.escape_twist)
                return lost & ~(work > 0)
            # What forces of size 0 would cost bounds every dual function, but for that of logarithms.
            shown = gain(said, said.load_twist)
            if field == "joint_rates":
                shown = np.where(lost, gain(said, said.escape_twist), shown)
                return (lost & ~(shown > 0)) | (
                    optimal & (criterion != "robust") & (lower > CLEAR * size) & ~(shown > 0)
                )
            if criterion == "robust":
                return optimal & ~np.isfinite(said.load_twist).all(-1)
            least = np.zeros(n) if homogeneous else lower - 10 * CLEAR * size
            return optimal & (lower > 10 * CLEAR * size) & ~(shown > least)

    fields = (
        "status",
        "force",
        "lower",
        "upper",
        "load_twist",
        "escape_twist",
        *(("joint_rates",) if limits else ()),
    )
    check, others = partial(jg.check, grasp), []
    optimal, tight = answer.status == OPTIMAL, 10 * CLEAR * size
    for what, load in (
        ("load times 1.01", 1.01 * wrench), ("load turned round", -wrench),
        ("load of another lane", np.roll(wrench, 1, 0)),
        ("load plus 0.1", wrench + 0.1), ("no load", 0 * wrench), ("load times 1e100", 1e100 * wrench),
    ):  # fmt: skip
        posed.wrench = load
        broken = np.array([posed.broken(answer.force[i], i) for i in range(len(best))])
        others.append((what, partial(check, wrench=load, **asked), optimal & broken))
    posed.wrench = wrench
    for other in CRITERIA:
        posed.criterion, posed.parameter = other, 0.2
        costs = np.array([posed.cost(answer.force[i], i) for i in range(len(best))])
        problem = asked | {
            "criterion": CRITERIA[other](0.2) if other in ("robust", "least norm") else CRITERIA[other]()
        }
        wrong = optimal & ~(np.abs(costs - answer.upper) <= tight)
        others.append((f"criterion {other}", partial(check, wrench=wrench, **problem), wrong))
    posed.criterion, posed.parameter = criterion, parameter
    return Kind(
        f"OptimalForces, {name}",
        answer,
        fields,
        partial(check, wrench=wrench, **asked),
        says_false,
        tuple(others),
    )


def epsilon_kind(name: str, grasp: jg.Grasp, norm: str) -> Kind:
    """Epsilon; its lower bound by Qhull, its upper by the support function, its verdict by 70 digits."""
    answer = _numpy(jg.epsilon_quality(grasp, norm=norm, certificate=True))
    verdict = resistance_kind(name, grasp)
    parts = components_of(grasp)
    mu, gamma = coefficients_of(grasp)
    p, n, live, d = (
        np.asarray(grasp.position),
        np.asarray(grasp.normal),
        np.asarray(grasp.active),
        grasp.dimension,
    )
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
                wrong = (
                    np.isnan(lower + upper)
                    | (lower > upper * (1 + CLEAR))
                    | (lower > high * (1 + CLEAR))
                    | (lower < 0)
                )
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
                    out[i] = yes[i] and (
                        too_much(i, said.forces[i], said.norm) or radius(i, said) < lower[i] * (1 - CLEAR)
                    )
                elif field == "facets":
                    out[i] = yes[i] and not closed(i, said.facets[i])
                elif yes[i]:
                    out[i] = support(i, said) > upper[i] * (1 + CLEAR) or radius(i, said) < lower[i] * (
                        1 - CLEAR
                    )
                    out[i] |= too_much(i, said.forces[i], said.norm)
        return out

    fields = ("status", "lower", "upper", "direction", "touching", "forces", "facets", "torque_scale", "norm")
    return Kind(f"EpsilonQuality, {norm}, {name}", answer, fields, partial(jg.check, grasp), says_false)


def random_grasps(rng: np.random.Generator, lanes: int, model: str, k: int) -> jg.Grasp:
    """Random grasps of a contact model: "soft", "hard", "frictionless", "planar"."""
    dimension = 2 if model == "planar" else 3
    position, normal, _ = random_contacts(rng, lanes, k, dimension)
    mu, gamma = random_coefficients(rng, lanes, k)
    made = {"soft": jg.SoftFinger(mu, gamma), "frictionless": jg.Frictionless(0 * mu)}.get(
        model, jg.HardFinger(mu)
    )
    return jg.Grasp(position, normal, made, random_active(rng, lanes, k) if model == "soft" else None)


@cache
def kind_of(name: str, lanes: int, seed: int = 0) -> Kind:
    """Few answers of one kind: "verdicts", "epsilon", or a criterion, with ", limits" where there are any."""
    rng = np.random.default_rng(seed)
    if name == "verdicts":
        return resistance_kind("hard", random_grasps(rng, lanes, "hard", 4))
    if name == "epsilon":
        return epsilon_kind("planar", random_grasps(rng, lanes, "planar", 4), "L1")
    criterion = name.removesuffix(", limits")
    grasp, _, wrench, cap, limit = problems("planar hard", name != criterion, lanes, seed)
    return force_kind(name, grasp, wrench, criterion, PARAMETERS[criterion][1], cap, limit)
