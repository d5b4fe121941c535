"""The caller's force problem, spread over all lanes, in float64; numpy only.

Every lane is measured in its own unit of force, a power of two near the load, so that nothing over- or underflows.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from .criteria import Asked
from .rebuilt import Rebuilt, component_vectors, rebuild, scaled_wrench

__all__ = ["ForceProblem", "force_problem"]

SQUARED = ("SumOfSquares", "LeastNorm")
KNOWN = ("Gentlest", "SmallestSum", "Robust", *SQUARED)


class ForceProblem(NamedTuple):
    """asked: in units of ``unit`` (N,) newtons; wrench (N, m) as given; shape: axes of the grasps and their loads."""

    asked: Asked
    wrench: np.ndarray
    unit: np.ndarray
    shape: tuple[int, ...]

    @property
    def cost_unit(self) -> np.ndarray:
        """(N,) of the criterion."""
        return self.unit * self.unit if self.asked.name in SQUARED else self.unit


def _shape(batch: tuple[int, ...], wrench: np.ndarray) -> tuple[int, ...]:
    """Axes of the problem: the grasps', then any of the loads."""
    lead = wrench.shape[:-1]
    if not lead:
        return batch
    if len(lead) < len(batch) or any(a not in (1, b) for a, b in zip(lead, batch, strict=False)):
        raise ValueError(f"wrench of shape {wrench.shape} does not fit grasps of shape {batch}")
    return (*batch, *lead[len(batch) :])


def _spread(
    value: Any, own: tuple[int, ...], batch: tuple[int, ...], shape: tuple[int, ...], name: str
) -> np.ndarray:
    """``value`` with trailing axes ``own``, one for all, one a grasp or one a problem, for all problems (N, *own)."""
    array = np.asarray(value, np.float64)
    lead = array.shape[: array.ndim - len(own)]
    if array.shape[array.ndim - len(own) :] == own:
        loads = len(shape) - len(batch)
        if len(lead) <= len(batch) and loads:
            array = array.reshape(*lead, *([1] * loads), *own)
        try:
            return np.broadcast_to(array, (*shape, *own)).reshape(-1, *own)
        except ValueError:
            pass
    raise ValueError(f"{name} of shape {np.shape(value)} does not fit problems of shape {(*shape, *own)}")


def _parameter(
    criterion: Any, name: str, batch: tuple[int, ...], shape: tuple[int, ...]
) -> np.ndarray | None:
    """A number of the criterion for all problems (N,); None where it has none."""
    value = getattr(criterion, name, None)
    return None if value is None else _spread(value, (), batch, shape, f"the criterion's {name}")


def _caps(max_normal: Any, k: int, batch: tuple[int, ...], shape: tuple[int, ...]) -> np.ndarray:
    """(N, k), infinite where there are none."""
    value = np.asarray(np.inf if max_normal is None else max_normal, np.float64)
    return _spread(np.broadcast_to(value, (*value.shape[:-1], k)), (k,), batch, shape, "max_normal")


def _in_contact_axes(grasp, torque_limits) -> tuple[Any, Any, Any]:
    """(J, |J|, tau_max) for forces in contact axes; J in body or world axes is turned here, ``J_contact = B^T J``.

    |J| bounds each entry before and after: what the rounding of the turn is relative to.
    """
    axes = getattr(torque_limits, "axes", None)
    if axes is None:
        J, torque = torque_limits
        return J, np.abs(np.asarray(J, np.float64)), torque
    jacobian, torque = np.asarray(torque_limits.jacobian, np.float64), torque_limits.torque
    if axes == "contact":
        return jacobian, np.abs(jacobian), torque
    B = component_vectors(grasp, torque_limits.orientation if axes == "world" else None)
    k, r, n = B.shape[-3:]
    rows = jacobian.reshape(*jacobian.shape[:-2], k, r, jacobian.shape[-1])
    turned = np.einsum("...krn,...krq->...knq", B, rows)
    size = np.broadcast_to(np.linalg.norm(rows, axis=-2, keepdims=True), turned.shape)
    shape = (*turned.shape[:-3], k * n, turned.shape[-1])
    return turned.reshape(shape), size.reshape(shape), torque


def _repeated(known: Rebuilt, loads: int) -> Rebuilt:
    """Each grasp once for each of its loads."""
    if loads == 1:
        return known
    arrays = {name: x for name, x in known._asdict().items() if isinstance(x, np.ndarray)}
    return known._replace(**{name: np.repeat(x, loads, axis=0) for name, x in arrays.items()})


def _load_limit(dtype: np.dtype) -> float:
    """Loads in N (torques over L) are 0 or between this and its inverse: squares neither over- nor underflow."""
    return 2.0 ** (np.finfo(dtype).maxexp // 2 - 2)


def _power_of_two(size: np.ndarray) -> np.ndarray:
    """Near ``size``; 1 where it is no size."""
    usable = np.isfinite(size) & (size > 0)
    return np.exp2(np.floor(np.log2(np.where(usable, size, 1.0))))


def force_problem(grasp, problem) -> ForceProblem:
    """The problem that ``optimize_forces`` was asked; ValueError where it is none, or does not fit the grasp."""
    if problem.wrench is None or problem.criterion is None:
        raise ValueError(
            "forces are checked against the problem they answer: give wrench=.. and criterion=.., and max_normal=.., "
            "torque_limits=.. where there were any"
        )
    if type(problem.criterion).__name__ not in KNOWN:
        raise ValueError(f"no cost of {problem.criterion!r} can be proved; criteria are {', '.join(KNOWN)}")
    batch, k, dimension = grasp.position.shape[:-2], grasp.position.shape[-2], grasp.position.shape[-1]
    wrench = np.asarray(problem.wrench, np.float64)
    if wrench.shape[-1:] != (3 if dimension == 2 else 6,):
        raise ValueError(f"wrench of shape {wrench.shape} does not fit a body in {dimension} dimensions")
    shape = _shape(batch, wrench)
    wrench = _spread(wrench, wrench.shape[-1:], batch, shape, "wrench")
    known = rebuild(grasp)
    known = _repeated(known, len(wrench) // max(len(known.valid), 1))
    live, n = known.live, len(known.components)
    valid = known.valid & np.isfinite(wrench).all(-1)

    cap = _caps(problem.max_normal, k, batch, shape)
    valid &= ((cap > 0) | ~live).all(-1)
    jacobian, torque = np.zeros((len(live), k, n, 0)), np.zeros((len(live), 0))
    turned = jacobian
    if problem.torque_limits is not None:
        J, sizes, tau = _in_contact_axes(grasp, problem.torque_limits)
        joints = np.shape(J)[-1]
        tau = np.broadcast_to(tau, (*np.shape(tau)[:-1], joints))
        jacobian, turned = (
            _spread(x, (k * n, joints), batch, shape, "J").reshape(-1, k, n, joints) for x in (J, sizes)
        )
        torque = _spread(tau, (joints,), batch, shape, "tau_max")
        valid &= (torque > 0).all(-1) & (np.isfinite(jacobian).all((-1, -2)) | ~live).all(-1)
        jacobian, turned = (np.where(live[..., None, None], x, 0.0) for x in (jacobian, turned))
    weight, length = (_parameter(problem.criterion, name, batch, shape) for name in ("weight", "length"))
    for value in (weight, length):
        valid &= value is None or (np.isfinite(value) & (value > 0))

    with np.errstate(all="ignore"):
        load = scaled_wrench(wrench, known.length, dimension)
        size = np.max(np.abs(load), -1, initial=0.0)
        limit = _load_limit(np.dtype(grasp.position.dtype))
        valid &= ((size >= 1 / limit) & (size <= limit)) | ~wrench.any(-1)
        unit = _power_of_two(size)
        if weight is not None:  # a barrier's logarithms are those of newtons
            unit = np.ones_like(unit)
        asked = Asked(
            known=known,
            name=type(problem.criterion).__name__,
            weight=None if weight is None else weight / unit,
            length=length,
            cap=np.where(live, cap / unit[:, None], np.inf),
            jacobian=jacobian,
            turned=turned,
            torque=torque / unit[:, None],
            load=np.where(valid[:, None], load / unit[:, None], 0.0),
            valid=valid,
            dimension=dimension,
        )
    return ForceProblem(asked, wrench, unit, shape)
