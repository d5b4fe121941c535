"""One grasp's verdict in words, and as a picture.

An escape twist (v; omega) is told as the screw it is (``screws``).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import jax.numpy as jnp
import numpy as np

from ..backend import precision
from ..certificates import check_resistance
from ..contacts import MODELS, Grasp
from ..core import Status, UserError
from .words import Screw, screw, vector

if TYPE_CHECKING:
    import trimesh

__all__ = ["Screw", "Verdict", "draw", "explain", "reprove_verdict", "screw"]

SMALL = 1e-6  # a part of a twist below this share of the whole counts as zero
COMPONENTS = {"frictionless": ("f_n",), "hard": ("f_x", "f_y", "f_n"), "soft": ("f_x", "f_y", "f_n", "tau_n")}


@dataclass(frozen=True)
class Verdict:
    """One grasp and its answer, mesh frame, as in a file. Forces (k, n) or None; twist (6,) or None."""

    position: np.ndarray
    normal: np.ndarray
    friction: np.ndarray
    torsion: np.ndarray
    active: np.ndarray
    centre_of_mass: np.ndarray
    model: str
    status: Status
    margin: float
    gap: float
    rank: int | None
    force: np.ndarray | None
    twist: np.ndarray | None

    @classmethod
    def from_row(cls, row: dict[str, Any], metadata: dict[str, Any]) -> Verdict:
        """From what ``formats.parquet.read_row`` returns."""
        try:
            com, kind = np.asarray(metadata["centre_of_mass"], float), metadata["model"]["kind"]
            names = COMPONENTS[kind]
        except (KeyError, TypeError) as error:
            raise UserError(
                "the file's metadata lack the centre of mass or the model; screen it again"
            ) from error
        force = row["internal_force"]
        position = np.asarray(row["position"], float).reshape(-1, 3)
        return cls(
            position=position,
            normal=np.asarray(row["normal"], float).reshape(-1, 3),
            friction=np.asarray(row["friction"], float),
            torsion=np.asarray(row["torsion"], float),
            active=np.asarray(row["active"], bool),
            centre_of_mass=com,
            model=kind,
            status=Status(row["status"]),
            margin=float("nan") if row["margin"] is None else row["margin"],
            gap=float("nan") if row["gap"] is None else row["gap"],
            rank=row["rank"],
            force=None if force is None else np.asarray(force, float).reshape(len(position), len(names)),
            twist=None if row["escape_twist"] is None else np.asarray(row["escape_twist"], float),
        )

    @property
    def size(self) -> float:
        """Largest distance of an active contact from the centre of mass, m."""
        distance = np.linalg.norm(self.position - self.centre_of_mass, axis=1)[self.active]
        return float(distance.max()) if len(distance) and np.isfinite(distance).all() else 1.0


def _escape(verdict: Verdict) -> list[str]:
    assert verdict.twist is not None
    motion = screw(verdict.twist, verdict.centre_of_mass, verdict.size)
    if motion.kind == "slide" or motion.point is None:
        text = f"a slide along {vector(motion.direction)}"
    else:
        where = f"the axis along {vector(motion.direction)} through {vector(motion.point)} m"
        text = f"a rotation about {where}"
        if motion.pitch:
            text += f", advancing {1000 * motion.pitch * np.pi / 180:.3g} mm along it with each degree"
        offset = float(np.linalg.norm(motion.point - verdict.centre_of_mass))
        near = offset <= 1e-6 * verdict.size
        text += (
            " (the axis passes through the centre of mass)"
            if near
            else f" ({1000 * offset:.3g} mm from the centre of mass)"
        )
    lines = [f"The object escapes by {text}."]
    r = verdict.position - verdict.centre_of_mass
    velocity = verdict.twist[:3] + np.cross(verdict.twist[3:], r)
    for i in np.flatnonzero(verdict.active):
        n = verdict.normal[i] / np.linalg.norm(verdict.normal[i])
        away = float(velocity[i] @ n)
        across = float(np.linalg.norm(velocity[i] - away * n))
        speed = np.hypot(away, across)
        spin = float(verdict.twist[3:] @ n)
        if speed * (1 + SMALL) <= SMALL * verdict.size * np.linalg.norm(verdict.twist[3:]) or speed == 0:
            told = (
                "the surface stands still"
                if abs(spin) * verdict.size < SMALL
                else "the surface only spins on the finger"
            )
        else:
            told = f"the surface draws away at {np.degrees(np.arctan2(away, across)):.1f} degrees to itself"
            if away <= SMALL * speed:
                told = "the surface only slides along the finger"
        needed = f"{np.degrees(np.arctan(verdict.friction[i])):.1f}"
        lines.append(
            f"  contact {i}: {told}" + (f"; friction holds up to {needed} degrees" if speed > 0 else "") + "."
        )
    return lines


def _forces(verdict: Verdict) -> list[str]:
    assert verdict.force is not None
    names = COMPONENTS[verdict.model]
    lines = [
        "Internal forces that balance (mean normal force 1 N; friction as a share of what the cone allows):"
    ]
    for i in np.flatnonzero(verdict.active):
        part = dict(zip(names, verdict.force[i], strict=True))
        f_n, tangential = part["f_n"], float(np.hypot(part.get("f_x", 0.0), part.get("f_y", 0.0)))
        words = [f"normal {f_n:.4g} N", f"tangential {tangential:.4g} N"]
        share = _share(tangential, verdict.friction[i]) if "f_x" in part else 0.0
        if "tau_n" in part:
            words.append(f"spin torque {part['tau_n']:.4g} N m")
            share = float(np.hypot(share, _share(abs(part["tau_n"]), verdict.torsion[i])))
        used = f"{100 * share / f_n:.0f} % of the cone" if f_n > 0 else "no pressing force"
        lines.append(f"  contact {i}: {', '.join(words)}, {used}.")
    return lines


def _share(value: float, coefficient: float) -> float:
    return 0.0 if value == 0 else value / coefficient if coefficient > 0 else float("inf")


def explain(verdict: Verdict) -> str:
    """The verdict in words: what it is, by how much, and the forces or the motion that prove it."""
    lines = [verdict.status.sentence]
    if verdict.status is Status.INVALID:
        return "\n".join([*lines, *_faults(verdict)])
    if np.isneginf(verdict.margin):
        lines.append(
            "Margin: -inf: no internal force presses on any contact, so the fingers cannot squeeze at all."
        )
    else:
        top = verdict.margin + verdict.gap
        lines.append(
            f"Margin: between {verdict.margin:.6g} and {top:.6g} (1 is the best there is: equal normal "
            "forces and no friction needed; 0 or below is no grip)."
        )
    if verdict.rank is not None and verdict.rank < 6:
        lines.append(
            f"Rank: {verdict.rank} of 6: some motions the contacts cannot feel at all, whatever the forces; "
            "another finger, friction or torsion would help."
        )
    elif verdict.rank is not None:
        lines.append("Rank: 6 of 6: contacts that could push and pull would balance every load.")
    if verdict.force is not None and verdict.status is not Status.NOT_RESISTANT:
        lines += _forces(verdict)
    if verdict.twist is not None:
        lines += _escape(verdict)
    return "\n".join(lines)


def _faults(verdict: Verdict) -> list[str]:
    faults = [] if verdict.active.any() else ["  no contact is active."]
    for i in np.flatnonzero(verdict.active):
        for name in ("position", "normal", "friction", "torsion"):
            if not np.isfinite(getattr(verdict, name)[i]).all():
                faults.append(f"  contact {i}: the {name} is not finite.")
        if not np.any(verdict.normal[i]):
            faults.append(f"  contact {i}: the normal has length zero.")
        for name in ("friction", "torsion"):
            if getattr(verdict, name)[i] < 0:
                faults.append(f"  contact {i}: the {name} is negative.")
    return faults


def reprove_verdict(verdict: Verdict, metadata: dict[str, Any]) -> str:
    """One sentence: does the stored evidence, checked in float64 without the solver, prove the verdict?"""
    dtype, zero = np.dtype(metadata.get("dtype", "float64")), np.zeros(1)
    with precision(dtype.name):
        model = MODELS[verdict.model]().with_coefficients(
            jnp.asarray(verdict.friction, dtype), jnp.asarray(verdict.torsion, dtype)
        )
        position = (verdict.position - verdict.centre_of_mass).astype(dtype)
        grasp = Grasp(position, verdict.normal.astype(dtype), model, verdict.active)
        force = (
            np.zeros(verdict.active.size * model.force_size(3))
            if verdict.force is None
            else verdict.force.ravel()
        )
        evidence = SimpleNamespace(
            status=np.asarray(verdict.status.value),
            internal_force=force,
            escape_twist=np.resize(zero, 6) if verdict.twist is None else verdict.twist,
        )
        proved = bool(check_resistance(grasp, evidence, tolerance=metadata.get("tolerance", 1e-8)))
    if verdict.status in (Status.UNDECIDED, Status.INVALID):
        return (
            "There is nothing to prove."
            if proved
            else "Checked again: the stored numbers do not fit this verdict."
        )
    return (
        "Checked again in float64: the proof holds."
        if proved
        else "Checked again: the stored evidence does NOT prove it."
    )


def draw(verdict: Verdict, path: Path, mesh: trimesh.Trimesh | None = None) -> None:
    """A picture: object, contacts, friction cones, forces; and the object moved along its escape."""
    from .drawing import picture

    if verdict.status is Status.INVALID:
        raise UserError("an invalid grasp has no picture; jaxgrasp explain says what is wrong with it")

    motion = None if verdict.twist is None else screw(verdict.twist, verdict.centre_of_mass, verdict.size)
    picture(verdict, motion, path, mesh)
