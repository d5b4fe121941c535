"""How near the numbers lie of which a twist escapes exactly: what a proof to rounding says.

Positions over the length, angles of the normals, mu, gamma over the length; the largest change of all counts. A contact
gives way where it is moved onto the axis, or its normal is turned, or its friction is lowered.
"""

from __future__ import annotations

from fractions import Fraction

import numpy as np

from .dyadic import ExactGrasp, Twist, dot, twist_of
from .enclosures import root_above, root_below
from .exact_force import Scaled
from .exact_twist import physical
from .rebuilt import EPS

__all__ = ["rounding_distance"]

CHANGE = 1e-6  # of the twist
STILL = 1e-9  # a contact that a twist moves by less, over its size, is meant to be at rest


def rounding_distance(grasp: ExactGrasp, lane: Scaled, xi: np.ndarray, nearby: float) -> tuple[float, Twist]:
    """How far, at most, the numbers lie for which a twist escapes exactly, and that twist; infinite: none found.

    nearby  what is looked for: no better way is sought once one is found

    The twist xi (m,), lengths over L, is taken as it stands, and freed of its translation along its own axis, so that a
    contact can be moved to where it does not notice it; the share of that translation counts as distance, too: another
    motion is no proof of this one. Then the same of the twist next to it that the contacts at rest notice least.
    """
    found = _as_it_stands(grasp, lane, xi)
    if found[0] <= nearby:
        return found
    settled = _settled(lane, xi, nearby)
    return found if settled is None else min(found, _as_it_stands(grasp, lane, settled), key=lambda x: x[0])


def _as_it_stands(grasp: ExactGrasp, lane: Scaled, xi: np.ndarray) -> tuple[float, Twist]:
    """The better of the twist itself and the one without its pitch, and how far the numbers lie."""
    direct = twist_of(grasp, physical(lane, grasp.dimension, xi))
    best = np.inf, direct
    for least, twist in ((0.0, direct), (_pitch(grasp.dimension, xi), _without_pitch(direct))):
        if any(twist.velocity) or any(twist.rotation):
            best = min(best, (_farthest(grasp, lane, twist, least), twist), key=lambda x: x[0])
    return best


def _settled(lane: Scaled, xi: np.ndarray, nearby: float) -> np.ndarray | None:
    """The part of xi that the contacts hardly moved by it notice to rounding only; None: there is none near xi."""
    k, n = len(lane.torsion), len(lane.kinds)
    rows = lane.A.T.reshape(k, n, -1)
    length = np.linalg.norm(rows, axis=-1)
    unit = rows / np.where(length > 0, length, 1.0)[..., None]
    still = (np.abs(unit @ xi) <= max(STILL, 64 * nearby) * np.linalg.norm(xi)).all(-1)
    if not still.any():
        return None
    _, values, V = np.linalg.svd(unit[still].reshape(-1, len(xi)))
    values = np.pad(values, (0, len(xi) - len(values)))
    null = V[values <= max(nearby * values[0], values[-1])]
    settled = null.T @ (null @ xi)
    # Another motion is no proof of this one.
    near = np.linalg.norm(settled - xi) <= max(CHANGE, 64 * nearby) * np.linalg.norm(xi)
    return settled if near else None


def _farthest(grasp: ExactGrasp, lane: Scaled, twist: Twist, least: float) -> float:
    """The distance of the contact that has to change most; at least ``least``."""
    opposed = (i for i in grasp.contacts if grasp.opposes(i, twist))
    return max([least, *(_contact_distance(grasp, lane, twist, i) for i in opposed)])


def _pitch(dimension: int, xi: np.ndarray) -> float:
    """The share of the twist's translation along its own axis, less what the rounding of its numbers makes of it."""
    turn = xi[dimension:]
    if dimension == 2 or not turn.any():
        return 0.0
    axis = turn / np.max(np.abs(turn))  # its square may underflow
    along = abs(float(xi[:3] @ axis)) / float(np.linalg.norm(axis))
    return max(along / float(np.linalg.norm(xi)) - 8 * EPS, 0.0)


def _without_pitch(twist: Twist) -> Twist:
    """The twist freed of its translation along its own axis, ``v . omega = 0`` exactly, times a positive number."""
    square, pitch = dot(twist.rotation, twist.rotation), dot(twist.velocity, twist.rotation)
    if not square:
        return twist
    velocity = [square * v - pitch * w for v, w in zip(twist.velocity, twist.rotation, strict=True)]
    return Twist(velocity, [square * w for w in twist.rotation])


def _root(value: Fraction) -> float:
    """The square root, rounded up."""
    root = root_above(value, 20)
    return float(root) * (1 + 1e-15) if root < 2**1000 else np.inf


def _contact_distance(grasp: ExactGrasp, lane: Scaled, twist: Twist, i: int) -> float:
    """What it takes to make contact i blind to the twist, or to lower its friction until it gives way."""
    mu, length = float(lane.friction[i]), Fraction(lane.length) / Fraction(2) ** grasp.length_exponent
    u, turn = grasp.velocity(i, twist), twist.rotation
    speed, spin = dot(u, u), dot(turn, turn)
    n, nn = grasp.normal[i], grasp.normal_square[i]
    h, about = dot(u, n), dot(turn, n)
    gamma = float(Fraction(grasp.torsion[i]) / length)
    # The torsion goes by turning the normal across the axis, or by giving up gamma.
    twisting = 0.0
    if grasp.torsion[i] and about:
        twisting = min(_root(Fraction(about * about, spin * nn)) * 1.6, gamma)
    ways = []
    if spin and not dot(twist.velocity, turn):  # the contact moves onto the axis
        ways.append(max(_root(Fraction(speed) / (spin * length * length)), twisting))
    if twisting == 0.0 or twisting == gamma:
        across = spin * nn - about * about
        if across and h < 0:  # the contact moves until it slides, without friction
            ways.append(max(_root(Fraction(h * h, across) / (length * length)), mu, gamma))
        if speed and h < 0:  # the normal turns until the contact slides, without friction
            ways.append(max(_root(Fraction(h * h, speed * nn)) * 1.6, mu, gamma))
        elif h >= 0:
            sliding = Fraction(speed * nn - h * h, nn)
            if sliding > 0:
                limit = float(min(root_below(Fraction(h * h, nn) / sliding, 20), Fraction(2) ** 1000))
                ways.append(max(mu - limit * (1 - 1e-15), gamma))
    area = speed * spin - dot(u, turn) ** 2
    if area and twisting > 0.0:  # the normal turns until the contact slides and does not twist: torsion stays
        off = h * h * spin + about * about * speed - 2 * h * about * dot(u, turn)
        ways.append(max(_root(Fraction(off, nn * area)) * 1.6, mu))
    return min(ways, default=np.inf)
