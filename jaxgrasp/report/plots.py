"""The figures of the notebooks, each named after what it draws; matplotlib is imported when the first one is drawn.

Every function returns its figure, and draws nothing else. Lengths are in m, forces in N.
"""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax.numpy as jnp
import numpy as np

from ..contacts import Grasp, SoftFinger
from ..core import Status
from ..motion import ClosedLoop, Controllability
from ..resistance import Trace, WrenchResistance

if TYPE_CHECKING:
    import trimesh
    from matplotlib.figure import Figure

    from .answers import Verdict

__all__ = [
    "bracket_of_the_margin",
    "climb",
    "contact_cones",
    "eigenvalues_of_the_cone",
    "grasp_picture",
    "margin_by_friction",
    "margins_by_two_roads",
    "panels_in_a_row",
    "pendulum",
    "rank_and_effort",
    "recovery",
    "swing",
    "verdict_of",
    "way_on_an_ellipsoid",
]

BLUE, RED, GREY, YELLOW = "#00798c", "#d1495b", "0.45", "#edae49"


def panels_in_a_row(count: int, size: tuple[float, float], **options: Any) -> tuple[Figure, Any]:
    """A figure with ``count`` panels in a row, in the notebooks' style."""
    import matplotlib.pyplot as plt

    # By hand and not in an ``rc_context``, which would also undo what a notebook's backend sets.
    figure, axes = plt.subplots(1, count, figsize=size, dpi=110, layout="constrained", **options)
    for one in np.atleast_1d(axes):
        one.grid(True, alpha=0.3)
    return figure, axes


# Verdicts ------------------------------------------------------------------------------------------------


def verdict_of(grasp: Grasp, answer: WrenchResistance, centre_of_mass: Any, force: Any = None) -> Verdict:
    """One grasp in space with its verdict, as a file holds them: what ``explain`` and ``grasp_picture`` take.

    grasp, answer   of one lane, about the centre of mass     centre_of_mass  (3,) m, mesh frame
    force           (k, n) N, drawn instead of the answer's internal force
    """
    from .answers import Verdict

    status = Status(int(answer.status))
    kind = {"Frictionless": "frictionless", "HardFinger": "hard", "SoftFinger": "soft"}[
        type(grasp.model).__name__
    ]
    shown = answer.internal_force if force is None else force
    escapes = status is Status.NOT_RESISTANT or (status is Status.MARGINAL and force is None)
    row = {
        "position": np.asarray(grasp.position) + np.asarray(centre_of_mass),
        "normal": np.asarray(grasp.normal),
        "friction": np.asarray(grasp.model.friction_coefficient),
        "torsion": np.asarray(grasp.model.torsion_coefficient),
        "active": np.asarray(grasp.active),
        "status": int(status),
        "margin": float(answer.lower),
        "upper": float(answer.upper),
        "rank": int(answer.rank),
        "internal_force": np.asarray(shown).ravel(),
        "escape_twist": np.asarray(answer.escape_twist) if escapes and force is None else None,
    }
    return Verdict.from_row(row, {"centre_of_mass": centre_of_mass, "model": {"kind": kind}})


def grasp_picture(verdict: Verdict, mesh: trimesh.Trimesh | None = None) -> bytes:
    """The PNG of ``draw``: object, contacts, friction cones, forces, or the object moved along its escape."""
    from .drawing import draw

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "grasp.png"
        draw(verdict, path, mesh)
        return path.read_bytes()


def contact_cones(frictions: Sequence[float], soft: SoftFinger) -> Figure:
    """Friction cones of hard fingers cut through their axis; what a soft finger can do sideways and in torsion."""
    figure, (left, right) = panels_in_a_row(2, (8, 3.4))
    f_n = np.linspace(0, 1, 2)
    for mu, shade in zip(frictions, np.linspace(0.45, 0.15, len(frictions)), strict=True):
        left.fill_betweenx(f_n, -mu * f_n, mu * f_n, color=BLUE, alpha=shade, linewidth=0)
        left.text(mu, 1.03, f"{mu}", ha="center", va="bottom")
    left.set(
        xlabel="tangential force (N)", ylabel="normal force (N)", aspect="equal", title="hard finger, $\\mu$"
    )
    left.set(xlim=(-1.2, 1.2), ylim=(0, 1.25))
    mu, gamma = float(soft.friction_coefficient), float(soft.torsion_coefficient)
    f_x, tau = np.meshgrid(1.2 * mu * np.linspace(-1, 1, 121), 1.3 * gamma * np.linspace(-1, 1, 121))
    force = np.stack([f_x, np.zeros_like(f_x), np.ones_like(f_x), tau], axis=-1)
    slack = np.asarray(soft.feasibility_slack(jnp.asarray(force), 3))
    levels = np.linspace(-0.6, 1, 17)
    shown = right.contourf(f_x, 1000 * tau, slack, levels=levels, cmap="RdBu", vmin=-1, vmax=1)
    right.contour(f_x, 1000 * tau, slack, levels=[0], colors="k")
    right.set(xlabel="$f_x$ (N), $f_n$ = 1 N", ylabel="$\\tau_n$ (N mm)", title="soft finger")
    figure.colorbar(shown, ax=right, label="$f_n - \\psi(f)$ (N)", ticks=[-0.5, 0, 0.5, 1])
    return figure


def eigenvalues_of_the_cone(sideways: np.ndarray, eigenvalues: np.ndarray, mu: float) -> Figure:
    """Eigenvalues of P(f) as the tangential force of one contact grows; feasible where the smallest is positive."""
    figure, axes = panels_in_a_row(1, (5.5, 3.2))
    axes.plot(sideways, eigenvalues, color=GREY, linewidth=1)
    axes.plot(sideways, eigenvalues[:, 0], color=RED, linewidth=2, label="smallest eigenvalue of $P(f)$")
    some = sideways[::4]
    axes.plot(some, mu - some, "o", color=BLUE, markersize=4, label="$\\mu (f_n - \\psi)$")
    axes.axvline(mu, color="k", linewidth=0.8, linestyle="--")
    axes.set(xlabel="$f_x$ of the first contact (N), $f_n$ = 1 N", ylabel="eigenvalues (N)")
    axes.set_title("feasible up to $f_x = \\mu f_n$")
    axes.legend(loc="lower left")
    return figure


def margins_by_two_roads(answer: WrenchResistance, other: np.ndarray) -> Figure:
    """The margins of ``answer`` against those of another road; equal ones lie on the line."""
    figure, axes = panels_in_a_row(1, (4.2, 4))
    holds = np.asarray(answer.status) == Status.RESISTANT
    for chosen, colour, label in ((holds, BLUE, "resistant"), (~holds, RED, "not resistant, or marginal")):
        axes.plot(answer.margin[chosen], other[chosen], ".", color=colour, label=f"{label}: {chosen.sum()}")
    axes.axline((0, 0), slope=1, color="k", linewidth=0.6)
    axes.set(
        xlabel="margin, structured solver", ylabel="margin, LMI", aspect="equal", xlim=(-4, 1), ylim=(-4, 1)
    )
    axes.legend(loc="upper left")
    return figure


def bracket_of_the_margin(trace: Trace) -> Figure:
    """Lower and upper bound of the margin after each iteration, and the duality gap."""
    figure, (left, right) = panels_in_a_row(2, (8, 3.2))
    steps = np.arange(len(trace.gap))
    left.fill_between(steps, trace.lower, trace.upper, color=BLUE, alpha=0.25, linewidth=0)
    left.plot(steps, trace.lower, "o-", color=BLUE, markersize=3, label="lower bound (a force)")
    left.plot(steps, trace.upper, "o-", color=RED, markersize=3, label="upper bound (a twist)")
    left.set(xlabel="iteration", ylabel="margin $t^\\star$", title="the bracket")
    left.legend()
    right.semilogy(steps, trace.gap, "o-", color="k", markersize=3)
    right.set(xlabel="iteration", ylabel="duality gap", title="the gap")
    return figure


def margin_by_friction(mu: np.ndarray, answer: WrenchResistance) -> Figure:
    """The margin of one grasp as its friction coefficient grows; it is resistant where the margin is positive."""
    figure, axes = panels_in_a_row(1, (5.5, 3.2))
    margin = np.asarray(answer.margin)
    holds = np.asarray(answer.status) == Status.RESISTANT
    for chosen, colour, label in (
        (holds, BLUE, "resistant"),
        (np.isfinite(margin) & ~holds, RED, "not resistant"),
    ):
        axes.plot(mu[chosen], margin[chosen], ".-", color=colour, label=label)
    axes.axhline(0, color="k", linewidth=0.8)
    axes.set(xlabel="friction coefficient $\\mu$", ylabel="margin $t^\\star$", ylim=(-3, 1))
    axes.set_title(f"holds from $\\mu$ = {mu[holds].min():.2f} on")
    axes.legend(loc="lower right")
    return figure


# Motion --------------------------------------------------------------------------------------------------


def rank_and_effort(heights: np.ndarray, found: Controllability) -> Figure:
    """Rank of the controllability matrix, and how hard the weakest direction is, against a height in m."""
    figure, panels = panels_in_a_row(2, (9, 3))
    panels[0].step(1000 * heights, np.asarray(found.rank), color=BLUE, where="mid")
    panels[0].set(xlabel="height of the line (mm)", ylabel="rank of (11.30)", yticks=[10, 11, 12])
    least, effort = np.asarray(found.singular_values)[:, -1], np.asarray(found.effort)
    panels[1].semilogy(1000 * heights, least, color=BLUE, label="least singular value")
    finite = np.isfinite(effort)
    panels[1].semilogy(1000 * heights[finite], effort[finite], color=RED, label="effort (weights)")
    panels[1].set(xlabel="height of the line (mm)")
    panels[1].legend()
    return figure


def pendulum(titles: Mapping[str, float]) -> Figure:
    """A body turned about a line at each height in m (cross), seen along it; dots are the centre of mass."""
    figure, panels = panels_in_a_row(len(titles), (3.5 * len(titles), 3.2))
    outline = 0.03 * np.array([[-0.7, -1.4], [0.7, -1.4], [0.7, 1.4], [-0.7, 1.4], [-0.7, -1.4]])
    for axes, (title, height) in zip(np.atleast_1d(panels), titles.items(), strict=True):
        pivot = np.array([0, height])
        for angle, colour, width in ((0.0, GREY, 1.5), (0.5, YELLOW, 2.0)):
            c, s = np.cos(angle), np.sin(angle)
            turn = np.array([[c, -s], [s, c]])
            axes.plot(*((outline - pivot) @ turn.T + pivot).T, color=colour, linewidth=width)
            axes.plot(*(pivot - turn @ pivot), "o", color=colour, markersize=6)
        axes.plot(0, height, "x", color=RED, markersize=9, markeredgewidth=2)
        axes.set(aspect="equal", title=title, xlabel="y", ylabel="z", xticks=[], yticks=[])
    return figure


def swing(time: np.ndarray, loop: ClosedLoop, names: Sequence[str]) -> Figure:
    """The tilt of every lane over time, and the share of friction that the first one uses."""
    figure, panels = panels_in_a_row(2, (9, 3))
    for lane, (name, colour) in enumerate(zip(names, (BLUE, RED, YELLOW), strict=False)):
        panels[0].plot(time, np.asarray(loop.orientation_error)[:, lane], color=colour, label=name)
    panels[0].set(xlabel="time (s)", ylabel="tilt (rad)")
    panels[0].legend()
    panels[1].plot(time, np.asarray(loop.cone_use)[:, 0], color=BLUE)
    panels[1].axhline(1, color=GREY, linestyle=":")
    panels[1].set(xlabel="time (s)", ylabel=f"friction used, {names[0]}")
    return figure


def recovery(time: np.ndarray, loop: ClosedLoop) -> Figure:
    """Position error, largest normal force and share of friction used over time, one line a lane."""
    figure, panels = panels_in_a_row(3, (11, 3))
    shown = {
        "position error (mm)": 1000 * np.asarray(loop.position_error),
        "largest normal force (N)": np.asarray(loop.largest_normal),
        "friction used": np.asarray(loop.cone_use),
    }
    for axes, (label, values) in zip(panels, shown.items(), strict=True):
        for lane, line in enumerate(values.T):
            axes.plot(time, line, color=_shade(lane / values.shape[1]))
        axes.set(xlabel="time (s)", ylabel=label)
    panels[2].set_ylim(0, 1.05)
    return figure


def _shade(share: float) -> Any:
    import matplotlib

    return matplotlib.colormaps["viridis"](share)


# Placement -----------------------------------------------------------------------------------------------


def climb(steps: np.ndarray, margins: np.ndarray) -> Figure:
    """The margin of each start (steps, starts) on its way uphill; resistant above 0."""
    figure, axes = panels_in_a_row(1, (6, 3.5))
    axes.plot(steps, np.maximum(margins, -1.5))
    axes.axhline(0, color="black", linewidth=0.8)
    axes.set(xlabel="step", ylabel="margin t* (resistant above 0)")
    return figure


def way_on_an_ellipsoid(half_axes: Sequence[float], way: np.ndarray) -> Figure:
    """The way (steps, k, 3) of contacts over an ellipsoid, from the open circles to the filled ones."""
    figure, axes = panels_in_a_row(1, (6, 6), subplot_kw={"projection": "3d"})
    turn, height = np.meshgrid(np.linspace(0, 2 * np.pi, 40), np.linspace(0, np.pi, 20))
    body = [np.sin(height) * np.cos(turn), np.sin(height) * np.sin(turn), np.cos(height)]
    scaled = [a * x for a, x in zip(half_axes, body, strict=True)]
    axes.plot_surface(*scaled, alpha=0.2, color="steelblue")
    for finger in range(way.shape[1]):
        axes.plot(*way[:, finger].T, linewidth=2.5)
        axes.scatter(*way[0, finger], s=60, facecolors="none", edgecolors="black")
        axes.scatter(*way[-1, finger], s=60, color="black")
    axes.set_box_aspect(half_axes)
    for side in (axes.xaxis, axes.yaxis, axes.zaxis):
        side.set_major_locator(_few_ticks())
    return figure


def _few_ticks() -> Any:
    from matplotlib.ticker import MaxNLocator

    return MaxNLocator(4)
