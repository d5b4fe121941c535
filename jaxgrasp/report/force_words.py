"""One grasp's forces against a load in words: what each finger does, or the motion that the load drives."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np

from ..backend import precision
from ..contacts import grasp_map
from ..forces import CRITERIA
from .answers import ForceAnswer
from .words import motion_words, vector

__all__ = ["contact_rows", "cost_words", "infeasible_words", "load_words"]

UNITS = {"f_x": "N", "f_y": "N", "f_n": "N", "tau_n": "N m"}


def load_words(load: dict[str, Any]) -> str:
    """The load in one sentence."""
    wrench = np.asarray(load["wrench"], float)
    d = 2 if len(wrench) == 3 else 3

    def told(x: np.ndarray) -> str:
        return vector(
            x, 1e-9 * float(np.max(np.abs(x), initial=0.0))
        )  # what is rounding next to the largest is 0

    if load.get("mass") is not None:
        return (
            f"Load: {load['mass']:g} kg, {np.linalg.norm(wrench[:d]):.4g} N at the centre of mass along "
            f"{told(np.asarray(load['gravity']))}."
        )
    torque = told(wrench[d:]) if d == 3 else f"{wrench[d]:.4g}"
    return f"Load: {told(wrench[:d])} N at the centre of mass and {torque} N m about it."


def _decimals(values: np.ndarray) -> int:
    """Decimals that show the largest value with four digits."""
    largest = float(np.abs(values).max(initial=0.0))
    return int(np.clip(3 - np.floor(np.log10(largest)), 0, 12)) if np.isfinite(largest) and largest > 0 else 0


def _fixed(value: float, decimals: int) -> str:
    return f"{round(value, decimals) + 0.0:.{decimals}f}"


def contact_rows(answer: ForceAnswer) -> tuple[list[str], list[list[str]]]:
    """A table: heads, then a row for each active contact; empty where there are no forces."""
    names = answer.components
    shown = ["f_t" if len(answer.centre_of_mass) == 2 and name == "f_x" else name for name in names]
    heads = ["contact", *(f"{word}\n({UNITS[name]})" for word, name in zip(shown, names, strict=True))]
    heads += ["friction\nused", "force on the object\nin mesh axes (N)"]
    rows: list[list[str]] = []
    if answer.force is None or answer.contact_force is None:
        return heads, rows
    live = answer.force[answer.active]
    newtons = _decimals(live[:, [name != "tau_n" for name in names]])
    decimals = [_decimals(live[:, j]) if name == "tau_n" else newtons for j, name in enumerate(names)]
    for i in np.flatnonzero(answer.active):
        told = [_fixed(v, n) for v, n in zip(answer.force[i], decimals, strict=True)]
        pull = ", ".join(_fixed(v, newtons) for v in answer.contact_force[i])
        used = answer.cone_use(i, answer.force[i])
        rows.append([str(i), *told, "-" if np.isnan(used) else f"{100 * used:.1f} %", f"({pull})"])
    return heads, rows


def cost_words(answer: ForceAnswer) -> str:
    """Cost, unit, what it is, and the proven gap."""
    about = answer.criterion
    name, unit = about["name"], about["unit"]
    for option, its in (("weight", "N"), ("length", "m")):
        name += f", {option} {about[option]:g} {its}" if about[option] is not None else ""
    gap = answer.cost - answer.lower
    proven = (
        f"at most {gap:.1e} {unit} above the least there is" if np.isfinite(gap) else "no bound is proven"
    )
    return f"Cost: {answer.cost:.6g} {unit} ({name}: {CRITERIA[about['name']][0]}), {proven}."


def infeasible_words(answer: ForceAnswer) -> list[str]:
    """Why no forces balance the load: the motion it drives, and what each contact can do against it."""
    twist = answer.escape_twist
    assert twist is not None
    d = len(answer.centre_of_mass)
    with precision("float64"):
        grasp = answer.grasp()
        velocity = (np.asarray(grasp_map(grasp)).T @ twist).reshape(len(answer.position), -1)
        slack = np.asarray(grasp.model.dual_slack(jnp.asarray(velocity), d))
    # A contact of normal force f_n takes up at most f_n times this of the power that the load puts into the motion.
    taken = np.maximum(-slack, 0.0) / float(twist @ answer.wrench)
    shares = np.zeros(len(taken)) if answer.max_normal is None else answer.max_normal * taken
    lines = [f"The load drives the object into {motion_words(twist, answer.centre_of_mass, answer.size)}."]
    if answer.max_normal is None:
        lines.append("No force that friction allows the contacts opposes that motion:")
    else:
        lines.append(
            f"With at most {answer.max_normal:g} N each, the contacts take up at most "
            f"{100 * shares[answer.active].sum():.1f} % of the power that the load puts into that motion:"
        )
    names = answer.components
    for i in np.flatnonzero(answer.active):
        away = velocity[i, names.index("f_n")]
        if shares[i] >= 5e-4:
            told = f"it takes up at most {100 * shares[i]:.1f} %"
        else:
            told = _passing(answer, i, twist, away)
        lines.append(f"  contact {i}: {told}.")
    return lines


def _passing(answer: ForceAnswer, contact: Any, twist: np.ndarray, away: float) -> str:
    """How the surface leaves a contact that does not oppose the motion."""
    r = answer.position[contact] - answer.centre_of_mass
    if len(r) == 2:
        velocity = twist[:2] + twist[2] * np.asarray([-r[1], r[0]])
    else:
        velocity = twist[:3] + np.cross(twist[3:], r)
    speed = float(np.linalg.norm(velocity))
    if speed <= 1e-6 * max(np.linalg.norm(r), 1e-12) * np.linalg.norm(twist):
        return "the surface stands still or only turns on the finger"
    across = np.sqrt(max(speed**2 - away**2, 0.0))
    if across <= 1e-6 * speed:
        return "the surface draws straight away"
    if away <= 1e-6 * speed:
        return "the surface only slides along the finger, without friction"
    angle, held = np.degrees(np.arctan2(away, across)), np.degrees(np.arctan(answer.friction[contact]))
    return f"the surface draws away at {angle:.1f} degrees to itself; friction holds up to {held:.1f} degrees"
