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
from .rebuilt import component_vectors

__all__ = ["check", "force_claim", "prove", "proved_by"]


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
    tolerance: float | None = None,
) -> Proof:
    """What the evidence in ``answer`` proves, lane by lane: a ``Proof``, the shape of ``answer.status``.

    grasp          a ``Grasp``
    answer         what ``wrench_resistance(grasp)``, ``optimize_forces(grasp, wrench, ..)`` or
                   ``epsilon_quality(grasp, certificate=True)`` returned
    wrench, criterion, max_normal, torque_limits
                   for forces: the problem, exactly as ``optimize_forces`` was asked; wrench and criterion are required.
                   What is proved is this problem, whatever the answer was made for
    tolerance      for verdicts: the |t*| that MARGINAL may claim; by default what the answer's own bracket claims, as
                   long as that is below 1e-3. For forces: the relative gap that OPTIMAL may leave, by default 1e-6.
                   For epsilon: the rounding its bounds may show, by default 1e-9 of epsilon

    PROVED_EXACTLY      true of the very numbers given (as float64), in real arithmetic, with zero tolerance
    PROVED_TO_ROUNDING  true of some numbers within 64 eps of them; ``distance`` says how near
    REFUSED             anything else, and every answer that is damaged: fields missing, of another shape, not numbers

    Runs on the host: floating point with bounds of all rounding first, integers where that leaves a lane open.
    ``docs/verdicts.md`` says what is asked of each status and field. ValueError for an answer without a certificate,
    for forces without wrench and criterion, and for a problem of another shape.
    """
    problem = SimpleNamespace(
        wrench=wrench, criterion=criterion, max_normal=max_normal, torque_limits=torque_limits
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
    tolerance: float | None = None,
) -> np.ndarray:
    """Whether the evidence in ``answer`` proves it, exactly or to rounding: numpy bool, the shape of ``answer.status``.

    Arguments and errors are those of ``prove``, which also says which of the two it is.
    """
    proof = prove(
        grasp, answer, wrench=wrench, criterion=criterion, max_normal=max_normal,
        torque_limits=torque_limits, tolerance=tolerance,
    )  # fmt: skip
    return (proof.status != REFUSED)[()]


def _problem_shape(grasp, problem: SimpleNamespace) -> tuple[int, ...]:
    """Axes of the grasps, and of the loads after them."""
    batch = grasp.position.shape[:-2]
    lead = np.shape(problem.wrench)[:-1] if problem.wrench is not None else ()
    return tuple(lead) if len(lead) > len(batch) else tuple(batch)


def _spread(
    value, own: tuple[int, ...], batch: tuple[int, ...], shape: tuple[int, ...], name: str
) -> np.ndarray:
    """``value`` with trailing axes ``own``, one for all, one a grasp or one a problem, spread over all problems."""
    array = np.asarray(value, np.float64)
    lead = array.shape[: array.ndim - len(own)]
    if array.shape[array.ndim - len(own) :] == own:
        loads = len(shape) - len(batch)
        if len(lead) <= len(batch) and loads:
            array = array.reshape(*lead, *([1] * loads), *own)
        try:
            return np.broadcast_to(array, (*shape, *own))
        except ValueError:
            pass
    raise ValueError(f"{name} of shape {np.shape(value)} does not fit problems of shape {(*shape, *own)}")


def _in_contact_axes(grasp, torque_limits) -> tuple[Any, Any]:
    """(J, tau_max) for forces in contact axes; J in body or world axes is turned here, ``J_contact = B^T J``."""
    axes = getattr(torque_limits, "axes", None)
    if axes is None:
        return torque_limits
    jacobian, torque = np.asarray(torque_limits.jacobian, np.float64), torque_limits.torque
    if axes == "contact":
        return jacobian, torque
    B = component_vectors(grasp, torque_limits.orientation if axes == "world" else None)
    k, r, n = B.shape[-3:]
    rows = jacobian.reshape(*jacobian.shape[:-2], k, r, jacobian.shape[-1])
    turned = np.einsum("...krn,...krq->...knq", B, rows)
    return turned.reshape(*turned.shape[:-3], k * n, turned.shape[-1]), torque


def force_claim(grasp, answer, problem) -> SimpleNamespace:
    """The forces of an answer beside the caller's problem, spread over all lanes: what ``check_forces`` reads."""
    if problem.wrench is None or problem.criterion is None:
        raise ValueError(
            "forces are checked against the problem they answer: give wrench=.. and criterion=.., and max_normal=.., "
            "torque_limits=.. where there were any"
        )
    shape, batch = np.shape(answer.status), grasp.position.shape[:-2]
    k, m = grasp.position.shape[-2], 3 if grasp.position.shape[-1] == 2 else 6
    wrench = _spread(problem.wrench, (m,), batch, shape, "wrench")
    cap = limits = None
    if problem.max_normal is not None:
        value = np.asarray(problem.max_normal, np.float64)
        cap = _spread(np.broadcast_to(value, (*value.shape[:-1], k)), (k,), batch, shape, "max_normal")
    if problem.torque_limits is not None:
        jacobian, torque = _in_contact_axes(grasp, problem.torque_limits)
        rows, joints = np.shape(jacobian)[-2:]
        torque = np.broadcast_to(torque, (*np.shape(torque)[:-1], joints))
        limits = (
            _spread(jacobian, (rows, joints), batch, shape, "J"),
            _spread(torque, (joints,), batch, shape, "tau_max"),
        )
    criterion = problem.criterion
    name = type(criterion).__name__
    weights = {
        key: _spread(getattr(criterion, key), (), batch, shape, f"the criterion's {key}")
        for key in ("weight", "length")
        if getattr(criterion, key, None) is not None
    }
    return SimpleNamespace(
        status=answer.status,
        force=answer.force,
        cost=answer.upper,
        bound=answer.lower,
        escape_twist=answer.escape_twist,
        load_twist=answer.load_twist,
        joint_rates=answer.joint_rates,
        smoothing=answer.smoothing,
        wrench=wrench,
        criterion=type(name, (), weights)(),
        max_normal=cap,
        torque_limits=limits,
    )
