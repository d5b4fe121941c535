"""Proofs of verdicts that can be written down, sent, and checked by ``tools/check_proofs.py`` without this library.

A line is a JSON object. Numbers are hexadecimal floats; an exact number that needs more bits is a list of floats whose
exact sum is meant. Forces and twists may be multiplied by any positive number, so they are integers times 2^-e.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from .exact_lane import ExactLane
from .proof import EXACTLY, TO_ROUNDING, Proof
from .rebuilt import rebuild
from .resistance import NEARBY, claim_of, of_size_one

__all__ = ["proof_lines"]

CLAIMS = {1: "RESISTANT", 2: "NOT_RESISTANT", 3: "MARGINAL"}
HOW = {EXACTLY: "exactly", TO_ROUNDING: "to rounding"}


def _parts(value: int, exponent: int) -> str | list[str]:
    """``value 2^exponent`` as hexadecimal floats whose sum it is; OverflowError where floats do not reach as far."""
    parts = []
    while value:
        shift = max(abs(value).bit_length() - 53, 0)
        head = abs(value) >> shift
        signed = head if value > 0 else -head
        if shift + exponent < -1074:
            raise OverflowError("numbers of too different sizes")
        parts.append(math.ldexp(signed, shift + exponent).hex())
        value -= signed << shift
    return parts[0] if len(parts) == 1 else parts or "0x0.0p+0"


def _rows(rows: Sequence[Sequence[int]], size: int) -> tuple[list[Any], int]:
    """The first ``size`` entries of each row, all times one power of two that brings the largest near 1."""
    largest = max((abs(x) for row in rows for x in row), default=0).bit_length()
    return [[_parts(x, -largest) for x in list(row)[:size]] for row in rows], largest


def _hex(array: np.ndarray) -> list[Any]:
    return [_hex(x) if np.ndim(x) else float(x).hex() for x in array]


def proof_lines(grasp, answer, proof: Proof) -> list[dict[str, Any] | None]:
    """One object for each lane of ``grasp`` (N,), None where there is no verdict, its proof was refused, or
    its numbers differ too much in size to be sums of floats.

    proof  what ``prove(grasp, answer)`` said
    """
    known, dimension = rebuild(grasp), grasp.position.shape[-1]
    claim = claim_of(grasp, answer, known)
    sized = of_size_one(known, claim, dimension)
    nearby = NEARBY * float(np.finfo(np.dtype(grasp.position.dtype)).eps)
    out: list[dict[str, Any] | None] = []
    for i, (status, how) in enumerate(zip(claim.status.astype(int), proof.status.reshape(-1), strict=True)):
        if status not in CLAIMS or int(how) not in HOW:
            out.append(None)
            continue
        lane = ExactLane(
            known,
            i,
            dimension,
            sized.s[i],
            sized.escape[i],
            sized.bound[i],
            (claim.escape[i], claim.bound[i]),
            nearby,
        )
        ends = float(claim.lower[i]), float(claim.upper[i])
        try:
            out.append(_line(lane, CLAIMS[status], ends) | _numbers(known, i))
        except OverflowError:
            out.append(None)
    return out


def _numbers(known, i: int) -> dict[str, Any]:
    """The numbers that are given: contacts that count, positions about the centre of mass."""
    live = known.live[i]
    names = ("position", "normal", "friction", "torsion")
    return {"dimension": known.position.shape[-1]} | {
        name: _hex(getattr(known, name)[i][live]) for name in names
    }


def _line(lane: ExactLane, claim: str, ends: tuple[float, float]) -> dict[str, Any]:
    d = lane.grasp.dimension
    line: dict[str, Any] = {"claim": claim, "proof": "exactly"}
    lower, upper = ends
    margin: list[str | None] = [None, None]
    if np.isfinite(upper) and lane.at_most(upper):
        margin[1], line["bound_twist"] = upper.hex(), _hex(lane.given[1])
    pressing = np.isfinite(lower) and lane.at_least(lower)
    if pressing:
        margin[0] = lower.hex()
    if pressing or claim == "RESISTANT":
        line |= _forces(lane)
    if claim == "NOT_RESISTANT":
        line |= _twist(lane, d)
    return line | {"margin": margin}


def _forces(lane: ExactLane) -> dict[str, Any]:
    """Forces, and torques as multiples of the normals, in newtons and metres up to one factor."""
    forces = lane.forces
    assert forces is not None
    d, exponent = lane.grasp.dimension, lane.grasp.length_exponent
    rows, largest = _rows(forces.force, d)
    # An integer torque is spin N, lengths in units of 2^exponent, N = n / 2^(exponent of n).
    spins = [
        _parts(s, exponent - e - largest)
        for s, e in zip(forces.spin, lane.grasp.normal_exponent, strict=True)
    ]
    return {"force": rows, "spin": spins}


def _twist(lane: ExactLane, d: int) -> dict[str, Any]:
    """The escape twist, exact; or one freed of its translation along its own axis, which holds to rounding."""
    twist, found = lane.escape, {}
    if twist is None:
        _, twist = lane.nearest
        assert twist is not None  # the lane is proved
        if lane.distance:
            found = {"proof": "to rounding", "within": lane.distance.hex()}
    e = lane.grasp.length_exponent
    size = max(abs(x) for x in (*twist.velocity, *twist.rotation)).bit_length()
    velocity = [_parts(x, e - size) for x in twist.velocity[:d]]
    rotation = [_parts(x, -size) for x in (twist.rotation if d == 3 else twist.rotation[2:])]
    return found | {"twist": velocity + rotation}
