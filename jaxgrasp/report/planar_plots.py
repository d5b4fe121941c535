"""Figures of planar grasps and their forces for the notebooks, each named after what it draws.

A planar friction cone can be drawn on paper. Every function but ``planar_grasp`` returns its figure. Lengths are in m,
forces in N; ``half_axes`` (2,) are those of the ellipse that is grasped.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import jax.numpy as jnp
import numpy as np

from ..contacts import Grasp, force_vectors
from ..core import Status
from .plots import BLUE, GREY, RED, YELLOW, panels_in_a_row

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = [
    "descent",
    "forces_in_cones",
    "joint_torques",
    "loads_around",
    "pinch",
    "planar_grasp",
    "planar_grasps",
    "price_of_robustness",
]


def planar_grasp(
    axes: Axes, half_axes: np.ndarray, grasp: Grasp, force: Any = None, load: Any = None, twist: Any = None,
    colour: str = BLUE, newton: float = 0.005,
) -> None:  # fmt: skip
    """An ellipse with its contacts and friction cones (outside, where the fingers are), forces, load, escape.

    half_axes  (2,) m of the ellipse     newton  length of 1 N in m     twist  (3,) the ellipse moved along it
    """
    around = np.linspace(0, 2 * np.pi, 100)
    ring = half_axes * np.stack([np.cos(around), np.sin(around)], axis=-1)
    axes.fill(*ring.T, color="0.85", edgecolor=GREY, linewidth=1)
    if twist is not None:
        step = 0.25 * half_axes[0] / np.hypot(np.linalg.norm(twist[:2]), half_axes[0] * twist[2])
        c, s = np.cos(step * twist[2]), np.sin(step * twist[2])
        axes.fill(*(ring @ [[c, s], [-s, c]] + step * twist[:2]).T, fc="none", ec=YELLOW, linewidth=2)
    vectors = None if force is None else newton * np.asarray(force_vectors(grasp, jnp.asarray(force)))
    mu = np.asarray(grasp.model.friction_coefficient)
    for i in np.flatnonzero(grasp.active):
        p, n = np.asarray(grasp.position)[i], np.asarray(grasp.normal)[i]
        n = n / np.linalg.norm(n)
        t = np.array([n[1], -n[0]])
        corners = [p, p - 0.035 * (n + mu[i] * t), p - 0.035 * (n - mu[i] * t)]
        axes.fill(*np.stack(corners).T, color=RED, alpha=0.2, linewidth=0)
        axes.plot(*p, "o", color=RED, markersize=4)
        if vectors is not None:
            arrow = {"arrowstyle": "-|>", "color": colour, "linewidth": 2}
            axes.annotate("", tuple(p), tuple(p - vectors[i]), arrowprops=arrow)
    if load is not None:
        end = newton * np.asarray(load)[:2]
        arrow = {"arrowstyle": "-|>", "color": "k", "linewidth": 1.5}
        axes.annotate("", tuple(end), (0, 0), arrowprops=arrow)
    axes.set(aspect="equal", xlim=(-0.09, 0.09), ylim=(-0.085, 0.06), xticks=[], yticks=[])
    axes.grid(False)


def planar_grasps(half_axes: np.ndarray, panels: Mapping[str, Mapping[str, Any]]) -> Figure:
    """One panel for each title, with the arguments of ``planar_grasp``."""
    figure, axes = panels_in_a_row(len(panels), (2.7 * len(panels), 2.9))
    for one, (title, what) in zip(np.atleast_1d(axes), panels.items(), strict=True):
        planar_grasp(one, half_axes, **what)
        one.set_title(title)
    return figure


def forces_in_cones(answers: Mapping[str, Any], mu: float) -> Figure:
    """The forces of several answers (of one planar grasp) inside the friction cone of each contact."""
    forces = {name: np.asarray(answer.force).reshape(-1, 2) for name, answer in answers.items()}
    count = len(next(iter(forces.values())))
    figure, panels = panels_in_a_row(count, (3 * count, 3.4), sharey=True)
    reach = 1.15 * max(float(np.abs(force).max()) for force in forces.values())
    looks = (("o", BLUE), ("D", RED), ("s", GREY), ("^", YELLOW), ("v", "k"))
    for i, axes in enumerate(panels):
        axes.fill([0, -mu * reach, mu * reach], [0, reach, reach], color=RED, alpha=0.12, linewidth=0)
        for (name, force), (mark, colour) in zip(forces.items(), looks, strict=False):
            f_t, f_n = force[i]
            axes.plot([0, f_t], [0, f_n], color=colour, linewidth=0.8)
            axes.plot(f_t, f_n, mark, color=colour, label=name, markersize=6)
        axes.set(xlabel="$f_t$ (N)", title=f"contact {i}", ylim=(0, reach), aspect="equal")
    panels[0].set_ylabel("$f_n$ (N)")
    panels[-1].legend(loc="center left", bbox_to_anchor=(1, 0.5))
    return figure


def pinch(
    half_axes: np.ndarray, grasp: Grasp, squeezed: Any, load: np.ndarray, mu: np.ndarray, cost: Any
) -> Figure:
    """A particular solution, the same after the least squeeze, and the least normal force for each friction."""
    figure, panels = panels_in_a_row(3, (11, 3.1))
    for axes, part, colour in zip(panels, (0.0, 1.0), (RED, BLUE), strict=False):
        force = squeezed.particular + part * squeezed.effort * squeezed.internal
        planar_grasp(axes, half_axes, grasp, force, load, colour=colour)
        axes.set_title("$f_p + s_{min} f_{int}$" if part else "$f_p$ alone: nobody can do that")
    panels[2].plot(mu, cost, color=BLUE, label="optimize_forces")
    closed_form = np.linalg.norm(load[:2]) / (2 * mu)
    panels[2].plot(mu[::4], closed_form[::4], "o", color=RED, markersize=4, label="$W / (2 \\mu)$")
    panels[2].set(
        xlabel="friction coefficient $\\mu$", ylabel="normal force of each finger (N)", ylim=(0, None)
    )
    panels[2].legend()
    return figure


def loads_around(direction: np.ndarray, answer: Any) -> Figure:
    """The least largest normal force for loads from all directions (degrees), and where none is enough."""
    figure, axes = panels_in_a_row(1, (5, 3))
    held = np.asarray(answer.status) == Status.OPTIMAL
    axes.plot(direction[held], np.asarray(answer.cost)[held], color=BLUE)
    for first, last in ((180, direction[held].min()), (direction[held].max(), 360)):
        axes.axvspan(first, last, color=RED, alpha=0.2, linewidth=0)
    axes.text(186, 1, "infeasible", color=RED)
    axes.set(xlabel="direction of the load (degrees; 270: down)", ylabel="largest normal force (N)")
    axes.set(xlim=(180, 360), ylim=(0, None), xticks=[180, 225, 270, 315, 360])
    return figure


def price_of_robustness(weight: np.ndarray, held: np.ndarray, price: np.ndarray, gentlest: float) -> Figure:
    """In what share of draws of friction the forces hold, against the robust weight and against their price."""
    figure, (left, right) = panels_in_a_row(2, (9, 3.3))
    left.semilogx(weight, 100 * held, "o-", color=BLUE, markersize=3)
    left.axhline(100 * gentlest, color=RED, linestyle="--", label="Gentlest")
    left.set(xlabel="weight of Robust (N)", ylabel="draws in which the grasp holds (%)", ylim=(0, 102))
    left.legend(loc="lower right")
    right.plot(price, 100 * held, "o-", color=BLUE, markersize=3)
    right.plot(1, 100 * gentlest, "o", color=RED, label="Gentlest")
    for j in (0, *range(12, len(weight), 4)):
        at = (float(price[j]), 100 * float(held[j]))
        right.annotate(f"{weight[j]:.2g}", at, (5, -10), textcoords="offset points")
    right.set(xlabel="largest normal force / gentlest", ylim=(0, 102), title="what it costs; labels: weight")
    return figure


def joint_torques(limit: np.ndarray, torque: np.ndarray, cost: Any, names: Mapping[int, str]) -> Figure:
    """Joint torques and the cost of the forces as the torque limit grows; ``names`` of the joints to show."""
    figure, (left, right) = panels_in_a_row(2, (8, 3.1))
    left.plot([0, limit.max()], [0, limit.max()], "--", color=GREY, label="limit")
    for (joint, name), colour in zip(names.items(), (BLUE, RED, YELLOW), strict=False):
        left.plot(limit, torque[:, joint], color=colour, label=name)
    left.set(xlabel="$\\tau_{max}$ (N m)", ylabel="$|J^T f|$ (N m)")
    left.legend()
    right.plot(limit, cost, color=BLUE)
    right.set(xlabel="$\\tau_{max}$ (N m)", ylabel="largest normal force (N)")
    return figure


def descent(
    half_axes: np.ndarray, grasps: Mapping[str, tuple[Grasp, Any]], loads: np.ndarray, costs: np.ndarray
) -> Figure:
    """Grasps with their forces for several loads, and the cost of every start at every step."""
    figure, panels = panels_in_a_row(len(grasps) + 1, (11, 3.1))
    for axes, (title, (grasp, forces)) in zip(panels, grasps.items(), strict=False):
        planar_grasp(axes, half_axes, grasp)
        for force, load in zip(np.asarray(forces), loads, strict=True):
            for p, f in zip(np.asarray(grasp.position), np.asarray(force_vectors(grasp, force)), strict=True):
                axes.plot(*np.stack([p, p - 0.002 * f]).T, color=BLUE, linewidth=1)
            axes.plot(*np.stack([[0, 0], 0.002 * load[:2]]).T, color="k", linewidth=0.8)
        axes.set_title(title)
    panels[-1].semilogy(costs, color=GREY, linewidth=1)
    panels[-1].semilogy(costs[:, costs[-1].argmin()], color=BLUE, linewidth=2)
    panels[-1].set(xlabel="step", ylabel="mean cost (N²)", title=f"{costs.shape[1]} starts")
    return figure
