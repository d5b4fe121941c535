"""What is true of a force problem: its optimum by Clarabel, balance, limits and cost of any forces by numpy."""

from __future__ import annotations

import numpy as np
from damaged_answers import CLEAR
from force_oracle import clarabel_forces, folded_map, log_det_terms

import jaxgrasp as jg

__all__ = ["ForceTruth", "coefficients_of", "components_of"]


def components_of(grasp: jg.Grasp) -> list[str]:
    return [c.value for c in grasp.model.components(grasp.dimension)]


def coefficients_of(grasp: jg.Grasp) -> tuple[np.ndarray, np.ndarray]:
    return np.asarray(grasp.model.friction_coefficient), np.asarray(grasp.model.torsion_coefficient)


class ForceTruth:
    """One force problem a lane, in numpy: balance, limits and cost of any forces."""

    def __init__(self, grasp: jg.Grasp, wrench, criterion: str, parameter, cap, limits):
        self.criterion, self.parameter, self.wrench, self.cap, self.limits = (
            criterion,
            parameter,
            wrench,
            cap,
            limits,
        )
        self.components, self.live = components_of(grasp), np.asarray(grasp.active)
        mu, gamma = coefficients_of(grasp)
        self.mu, self.gamma, self.dimension = mu, gamma, grasp.dimension
        p, n = np.asarray(grasp.position), np.asarray(grasp.normal)
        args = [
            (p[i], n[i], mu[i], gamma[i], self.live[i], self.components, wrench[i]) for i in range(len(p))
        ]
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
        by_name = {
            "f_x": self.mu[i],
            "f_y": self.mu[i],
            "f_n": np.ones_like(self.mu[i]),
            "tau_n": self.gamma[i],
        }
        f = force.reshape(len(self.mu[i]), -1)
        with np.errstate(all="ignore"):
            columns = {
                c: np.where(f[:, j] == 0, 0.0, f[:, j] / by_name[c]) for j, c in enumerate(self.components)
            }
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
