"""A twist as the motion a person can picture: a rotation about an axis, a slide, or a screw.

A twist (v; omega) at the centre of mass c is a screw: the line through ``c + omega x v / |omega|^2`` along omega, with
pitch ``omega . v / |omega|^2`` metres a radian; with omega = 0 it is a slide along v.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

__all__ = ["Screw", "screw", "vector"]

SMALL = 1e-6  # a part of a twist below this share of the whole counts as zero
SLIGHT = 0.02  # a screw that advances less than this share of the object's size a radian is called a rotation


@dataclass(frozen=True)
class Screw:
    """A twist as a motion: ``kind`` is "rotation", "slide" or "screw".

    direction  unit vector: of the axis, or of the slide
    point      the axis' nearest point to the centre of mass, m, mesh frame; None for a slide
    pitch      m a radian; small or 0 for a rotation, infinite for a slide
    """

    kind: str
    direction: np.ndarray
    point: np.ndarray | None
    pitch: float


def screw(twist: np.ndarray, centre_of_mass: np.ndarray, size: float) -> Screw:
    """The motion that ``twist`` (v; omega) at the centre of mass is; ``size`` in m weighs omega against v."""
    v, omega = twist[:3], twist[3:]
    turning, sliding = size * np.linalg.norm(omega), np.linalg.norm(v)
    if turning <= SMALL * sliding:
        return Screw("slide", v / sliding, None, float("inf"))
    rate = float(omega @ omega)
    point, pitch = centre_of_mass + np.cross(omega, v) / rate, float(omega @ v) / rate
    kind = "rotation" if abs(pitch) <= SLIGHT * size else "screw"
    return Screw(kind, omega / np.sqrt(rate), point, 0.0 if abs(pitch) <= SMALL * size else pitch)


def vector(x: np.ndarray) -> str:
    return "(" + ", ".join(f"{v + 0.0:.4g}" if abs(v) > 5e-7 else "0" for v in x) + ")"
