"""One grasp's forces against a load in words: what each finger does, or the motion that the load drives."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import numpy as np

from ..backend import precision
from ..certificates import check
from ..contacts import MODELS, Component, Grasp, grasp_map
from ..core import Status, UserError
from ..forces import CRITERIA, OptimalForces, closeness, make_criterion
from .words import screw

__all__ = ["ForceAnswer", "contact_rows", "cost_words", "infeasible_words", "load_words", "reprove_forces"]

UNITS = {"f_x": "N", "f_y": "N", "f_n": "N", "tau_n": "N m"}


@dataclass(frozen=True)
class ForceAnswer:
    """One grasp, its load and its answer, mesh frame, as in a file. Forces (k, n) and (k, d), or None."""

    row: int
    grasp_id: int
    position: np.ndarray
    normal: np.ndarray
    friction: np.ndarray
    torsion: np.ndarray
    active: np.ndarray
    centre_of_mass: np.ndarray
    model: str
    load: dict[str, Any]
    criterion: dict[str, Any]
    max_normal: float | None
    tolerance: float
    status: Status
    cost: float
    bound: float
    force: np.ndarray | None
    contact_force: np.ndarray | None
    escape_twist: np.ndarray | None
    load_twist: np.ndarray | None

    @classmethod
    def from_row(cls, row: dict[str, Any], metadata: dict[str, Any]) -> ForceAnswer:
        """From a row of a file of forces (``formats.force_table``) and the file's metadata."""
        try:
            k = len(row["position"])
            force = None if row["force"] is None else np.reshape(row["force"], (k, -1))
            names = ("position", "normal", "friction", "torsion", "active", "contact_force")
            names += ("escape_twist", "load_twist", "row", "grasp_id", "cost", "bound")
            said = ("load", "criterion", "max_normal", "tolerance")
            return cls(
                centre_of_mass=np.asarray(metadata["centre_of_mass"], float),
                model=metadata["model"]["kind"],
                status=Status(row["status"]),
                force=force,
                **{name: row[name] for name in names},
                **{name: metadata[name] for name in said},
            )
        except (KeyError, TypeError, ValueError) as error:
            raise UserError(f"the file of forces is damaged or incomplete ({error})") from error

    @property
    def components(self) -> tuple[Component, ...]:
        return MODELS[self.model]().components(self.position.shape[1])

    @property
    def wrench(self) -> np.ndarray:
        return np.asarray(self.load["wrench"], float)

    @property
    def grasp(self) -> Grasp:
        """As it was solved: at the centre of mass, float64 (enable it first)."""
        model = MODELS[self.model]().with_coefficients(jnp.asarray(self.friction), jnp.asarray(self.torsion))
        return Grasp(self.position - self.centre_of_mass, self.normal, model, self.active)


def vector(x: np.ndarray) -> str:
    """Four digits an entry; entries that are rounding next to the largest are 0."""
    largest = float(np.max(np.abs(x), initial=0.0))
    return "(" + ", ".join(f"{v:.4g}" if abs(v) > 1e-9 * largest else "0" for v in x) + ")"


def load_words(load: dict[str, Any]) -> str:
    """The load in one sentence."""
    wrench = np.asarray(load["wrench"], float)
    d = 2 if len(wrench) == 3 else 3
    if load.get("mass") is not None:
        return (
            f"Load: {load['mass']:g} kg, {np.linalg.norm(wrench[:d]):.4g} N at the centre of mass along "
            f"{vector(np.asarray(load['gravity']))}."
        )
    torque = vector(wrench[d:]) if d == 3 else f"{wrench[d]:.4g}"
    return f"Load: {vector(wrench[:d])} N at the centre of mass and {torque} N m about it."


def _share(part: np.ndarray, answer: ForceAnswer, contact: Any) -> str:
    """psi / f_n: how much of what friction allows at this normal force is used."""
    values = dict(zip((c.value for c in answer.components), part, strict=True))
    normal, square = values["f_n"], 0.0
    coefficient = {"f_x": answer.friction[contact], "f_y": answer.friction[contact]}
    coefficient["tau_n"] = answer.torsion[contact]
    for name, value in values.items():
        if name != "f_n" and value != 0:
            square += (value / coefficient[name]) ** 2 if coefficient[name] > 0 else np.inf
    if normal <= 0:
        return "-"
    return f"{100 * np.sqrt(square) / normal:.1f} %"


def _decimals(values: np.ndarray) -> int:
    """Decimals that show the largest value with four digits."""
    largest = float(np.abs(values).max(initial=0.0))
    return int(np.clip(3 - np.floor(np.log10(largest)), 0, 12)) if np.isfinite(largest) and largest > 0 else 0


def _fixed(value: float, decimals: int) -> str:
    return f"{round(value, decimals) + 0.0:.{decimals}f}"


def contact_rows(answer: ForceAnswer) -> tuple[list[str], list[list[str]]]:
    """A table: heads, then a row for each active contact; empty where there are no forces."""
    names = [c.value for c in answer.components]
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
        rows.append([str(i), *told, _share(answer.force[i], answer, i), f"({pull})"])
    return heads, rows


def cost_words(answer: ForceAnswer) -> str:
    """Cost, unit, what it is, and the proven gap."""
    about = answer.criterion
    name, unit = about["name"], about["unit"]
    for option, its in (("weight", "N"), ("length", "m")):
        name += f", {option} {about[option]:g} {its}" if about[option] is not None else ""
    gap = answer.cost - answer.bound
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
        grasp = answer.grasp
        velocity = (np.asarray(grasp_map(grasp)).T @ twist).reshape(len(answer.position), -1)
        slack = np.asarray(grasp.model.dual_slack(jnp.asarray(velocity), d))
    # A contact of normal force f_n takes up at most f_n times this of the power that the load puts into the motion.
    taken = np.maximum(-slack, 0.0) / float(twist @ answer.wrench)
    shares = np.zeros(len(taken)) if answer.max_normal is None else answer.max_normal * taken
    lines = [f"The load drives the object into {_motion(answer, twist)}."]
    if answer.max_normal is None:
        lines.append("No force that friction allows the contacts opposes that motion:")
    else:
        lines.append(
            f"With at most {answer.max_normal:g} N each, the contacts take up at most "
            f"{100 * shares[answer.active].sum():.1f} % of the power that the load puts into that motion:"
        )
    names = [c.value for c in answer.components]
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


def _motion(answer: ForceAnswer, twist: np.ndarray) -> str:
    d = len(answer.centre_of_mass)
    distance = np.linalg.norm(answer.position - answer.centre_of_mass, axis=1)[answer.active]
    size = float(distance.max(initial=0.0)) or 1.0
    if d == 2:  # the plane z = 0
        twist = np.asarray([twist[0], twist[1], 0.0, 0.0, 0.0, twist[2]])
    com = np.concatenate([answer.centre_of_mass, np.zeros(3 - d)])
    motion = screw(twist, com, size)
    if motion.point is None:
        return f"a slide along {vector(motion.direction[:d])}"
    offset = float(np.linalg.norm(motion.point - com))
    where = (
        "through the centre of mass"
        if offset <= 1e-6 * size
        else f"{1000 * offset:.3g} mm from the centre of mass"
    )
    if d == 2:
        turn = "anticlockwise" if motion.direction[2] > 0 else "clockwise"
        return f"a rotation ({turn}) about the point {vector(motion.point[:2])} m, {where}"
    words = f"a rotation about the axis along {vector(motion.direction)} through {vector(motion.point)} m"
    if motion.pitch:
        words += f", advancing {1000 * motion.pitch * np.pi / 180:.3g} mm along it with each degree"
    return f"{words} ({where})"


def reprove_forces(answer: ForceAnswer) -> bool:
    """Whether the stored numbers, checked in float64 without the solver, prove the stored answer."""
    m, k = len(answer.wrench), len(answer.position)
    with precision("float64"):
        grasp = answer.grasp
        nothing = jnp.zeros(m)
        said = {name: answer.criterion[name] for name in ("weight", "length")}
        criterion = make_criterion(answer.criterion["name"], **said)
        found = OptimalForces(
            status=jnp.int32(int(answer.status)),
            force=jnp.zeros(k * len(answer.components))
            if answer.force is None
            else jnp.asarray(answer.force).ravel(),
            upper=jnp.asarray(answer.cost),
            lower=jnp.asarray(answer.bound),
            escape_twist=nothing if answer.escape_twist is None else jnp.asarray(answer.escape_twist),
            load_twist=nothing if answer.load_twist is None else jnp.asarray(answer.load_twist),
            joint_rates=jnp.zeros(0),
            smooth=jnp.asarray(False),  # not stored, and no part of the proof
            iterations=jnp.int32(0),
            stop=jnp.int32(0),
        )
        return bool(
            check(
                grasp,
                found,
                wrench=answer.wrench,
                criterion=criterion,
                max_normal=answer.max_normal,
                tolerance=closeness(answer.tolerance),
            )
        )
