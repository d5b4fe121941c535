"""Vectors and motions in words. A twist is told as a rotation about an axis, a slide, or a screw.

A twist (v; omega) at the centre of mass c is a screw: the line through ``c + omega x v / |omega|^2`` along omega, with
pitch ``omega . v / |omega|^2`` metres a radian; with omega = 0 it is a slide along v.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import numpy as np

__all__ = ["SMALL", "Screw", "motion_words", "screw", "status_words", "vector"]

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


def status_words(status: Enum) -> str:
    """The name of a status as words: "not resistant"."""
    return status.name.replace("_", " ").lower()


def vector(x: np.ndarray, smallest: float = 5e-7) -> str:
    """Four digits an entry; entries of at most ``smallest`` are 0. The default is for unit vectors and metres."""
    return "(" + ", ".join(f"{v + 0.0:.4g}" if abs(v) > smallest else "0" for v in x) + ")"


def motion_words(twist: np.ndarray, centre_of_mass: np.ndarray, size: float, distance: bool = True) -> str:
    """A twist (m,) at the centre of mass as a motion, positions in m in the axes of ``centre_of_mass`` (d,).

    size      m, weighs the rotation against the slide (``screw``)
    distance  say where the axis runs and how far from the centre of mass; else only where, or that it is there
    """
    d = len(centre_of_mass)
    if d == 2:  # the plane z = 0
        twist = np.asarray([twist[0], twist[1], 0.0, 0.0, 0.0, twist[2]])
    com = np.concatenate([centre_of_mass, np.zeros(3 - d)])
    motion = screw(twist, com, size)
    if motion.point is None:
        return f"a slide along {vector(motion.direction[:d])}"
    offset = float(np.linalg.norm(motion.point - com))
    near = offset <= SMALL * size
    far = "through the centre of mass" if near else f"{1000 * offset:.3g} mm from the centre of mass"
    place = "the centre of mass" if near and not distance else f"{vector(motion.point[:d])} m"
    if d == 2:
        if not distance:
            return f"a rotation about {place}"
        turn = "anticlockwise" if motion.direction[2] > 0 else "clockwise"
        return f"a rotation ({turn}) about the point {place}, {far}"
    words = f"a rotation about the axis along {vector(motion.direction)} through {place}"
    if motion.pitch:
        words += f", advancing {1000 * motion.pitch * np.pi / 180:.3g} mm along it with each degree"
    return f"{words} ({'the axis passes ' if near else ''}{far})" if distance else words
