"""One way to ask for a proof: ``prove(grasp, answer, ..)`` proves the caller's problem with the answer's evidence.

Numpy and the standard library only, and nothing else of this library: a bug elsewhere cannot make a wrong proof look
right. Which prover an answer needs is registered for its class where the class is defined.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import singledispatch
from types import SimpleNamespace
from typing import Any

import numpy as np

from .proof import REFUSED, Proof, refused
from .reading import Malformed

__all__ = ["check", "prove", "proved_by"]


@singledispatch
def _prover(answer: Any) -> Callable[..., Proof]:
    raise ValueError(
        f"a {type(answer).__name__} carries no certificate; check and prove take the answers of wrench_resistance, "
        "optimize_forces and epsilon_quality"
    )


def proved_by(prover: Callable[..., Proof]) -> Callable[[type], type]:
    """Class decorator: ``prover(grasp, answer, problem, tolerance)`` proves answers of this class."""

    def register(kind: type) -> type:
        _prover.register(kind, lambda answer: prover)
        return kind

    return register


def prove(
    grasp,
    answer,
    *,
    wrench=None,
    criterion=None,
    max_normal=None,
    torque_limits=None,
    smoothing: float = 0.0,
    tolerance: float | None = None,
) -> Proof:
    """What the evidence in ``answer`` proves, lane by lane: a ``Proof``, the shape of ``answer.status``.

    grasp          a ``Grasp``
    answer         what ``wrench_resistance(grasp)``, ``optimize_forces(grasp, wrench, ..)`` or
                   ``epsilon_quality(grasp, certificate=True)`` returned
    wrench, criterion, max_normal, torque_limits, smoothing
                   for forces: the problem, exactly as ``optimize_forces`` was asked; wrench and criterion are required.
                   What is proved is this problem, whatever the answer was made for
    tolerance      for verdicts: MARGINAL may claim |t*| up to twice this, and up to 9e-12 (4e-5 in float32) in any
                   case; by default what the answer's own bracket claims, as
                   long as that is below 1e-3. For forces: the relative gap that OPTIMAL may leave, by default 1e-6
                   (2e-3 in float32), or what smoothing costs.
                   For epsilon: the rounding its bounds may show, by default 1e-9 of epsilon

    PROVED_EXACTLY      true of the very numbers given (as float64), in real arithmetic, with zero tolerance
    PROVED_TO_ROUNDING  true of some numbers within 64 eps of them; ``distance`` says how near
    REFUSED             anything else, and every answer that is damaged: fields missing, of another shape, not numbers

    Runs on the host: floating point with bounds of all rounding first, integers where that leaves a lane open.
    ``docs/verdicts.md`` says what is asked of each status and field. ValueError for an answer without a certificate,
    for forces without wrench and criterion, and for a problem of another shape.
    """
    problem = SimpleNamespace(
        wrench=wrench,
        criterion=criterion,
        max_normal=max_normal,
        torque_limits=torque_limits,
        smoothing=smoothing,
    )
    prover = _prover(answer)
    try:
        return prover(grasp, answer, problem, tolerance)
    except Malformed:
        return refused(_problem_shape(grasp, problem))


def check(
    grasp,
    answer,
    *,
    wrench=None,
    criterion=None,
    max_normal=None,
    torque_limits=None,
    smoothing: float = 0.0,
    tolerance: float | None = None,
) -> np.ndarray:
    """Whether the evidence in ``answer`` proves it, exactly or to rounding: numpy bool, the shape of ``answer.status``.

    Arguments and errors are those of ``prove``, which also says which of the two it is.
    """
    proof = prove(
        grasp, answer, wrench=wrench, criterion=criterion, max_normal=max_normal,
        torque_limits=torque_limits, smoothing=smoothing, tolerance=tolerance,
    )  # fmt: skip
    return (proof.status != REFUSED)[()]


def _problem_shape(grasp, problem: SimpleNamespace) -> tuple[int, ...]:
    """Axes of the grasps, and of the loads after them."""
    batch = tuple(grasp.position.shape[:-2])
    lead = np.shape(problem.wrench)[:-1] if problem.wrench is not None else ()
    return (*batch, *lead[len(batch) :])
