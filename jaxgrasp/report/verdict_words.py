"""One grasp's verdict in words: what it is, by how much, and the forces or the motion that prove it."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..core import Status
from .answers import Verdict
from .words import SMALL, motion_words

__all__ = ["explain"]


def _escape(verdict: Verdict) -> list[str]:
    assert verdict.twist is not None
    motion = motion_words(verdict.twist, verdict.centre_of_mass, verdict.size)
    lines = [f"The object escapes by {motion}."]
    r = verdict.position - verdict.centre_of_mass
    velocity = verdict.twist[:3] + np.cross(verdict.twist[3:], r)
    for i in np.flatnonzero(verdict.active):
        told, moves = _passing(verdict, i, velocity[i])
        held = (
            f"; friction holds up to {np.degrees(np.arctan(verdict.friction[i])):.1f} degrees"
            if moves
            else ""
        )
        lines.append(f"  contact {i}: {told}{held}.")
    return lines


def _passing(verdict: Verdict, contact: Any, velocity: np.ndarray) -> tuple[str, bool]:
    """What the surface does at a contact when the object escapes, and whether it moves there at all."""
    assert verdict.twist is not None
    n = verdict.normal[contact] / np.linalg.norm(verdict.normal[contact])
    away = float(velocity @ n)
    across = float(np.linalg.norm(velocity - away * n))
    speed = np.hypot(away, across)
    spin = float(verdict.twist[3:] @ n)
    if speed * (1 + SMALL) <= SMALL * verdict.size * np.linalg.norm(verdict.twist[3:]) or speed == 0:
        still = abs(spin) * verdict.size < SMALL
        told = "the surface stands still" if still else "the surface only spins on the finger"
    elif away <= SMALL * speed:
        told = "the surface only slides along the finger"
    else:
        told = f"the surface draws away at {np.degrees(np.arctan2(away, across)):.1f} degrees to itself"
    return told, speed > 0


def _forces(verdict: Verdict) -> list[str]:
    assert verdict.force is not None
    lines = [
        "Internal forces that balance (mean normal force 1 N; friction as a share of what the cone allows):"
    ]
    for i in np.flatnonzero(verdict.active):
        part = dict(zip(verdict.components, verdict.force[i], strict=True))
        f_n, tangential = part["f_n"], float(np.hypot(part.get("f_x", 0.0), part.get("f_y", 0.0)))
        words = [f"normal {f_n:.4g} N", f"tangential {tangential:.4g} N"]
        if "tau_n" in part:
            words.append(f"spin torque {part['tau_n']:.4g} N m")
        share = verdict.cone_use(i, verdict.force[i])
        used = "no pressing force" if np.isnan(share) else f"{100 * share:.0f} % of the cone"
        lines.append(f"  contact {i}: {', '.join(words)}, {used}.")
    return lines


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
        lines.append(
            f"Margin: between {verdict.margin:.6g} and {verdict.upper:.6g} (1 is the best there is: equal normal "
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
