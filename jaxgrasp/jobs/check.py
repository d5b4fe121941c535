"""Grasps checked in motion: controllable, and brought back by a controller from a standard set of disturbances?

Six pushes, up, down and sideways along the axes of the mesh, each of half the weight for 50 ms, are six lanes of one
closed loop. Wrench resistant grasps are held by computed torque, grasps that are controllable only by the regulator.
A grasp is recovered if after every push it comes to stay within 1 mm and 1 degree, with forces that were the commanded
ones in every step (for the regulator: or the nearest admissible ones).

A chunk of grasps is checked in one batch and kept as a shard (``shards``): memory does not grow with their number,
and a killed run goes on where it was. A row depends on its grasp alone. The columns: ``formats.check_table``.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ..backend import precision
from ..contacts import Grasp, contact_model
from ..core import Status
from ..formats import Contacts, check_schema, check_table, dump_metadata, read_check_columns
from ..motion import (
    BodyState,
    ClosedLoop,
    ComputedTorque,
    ContactController,
    Controllability,
    Gains,
    RigidBody,
    Simulation,
    close_loop,
    controllability,
    regulator,
)
from .check_request import CheckPlan
from .shards import Shards
from .summary import Summary

__all__ = ["check", "controllability_of"]

TIMESTEP, STEPS, RATE = 0.002, 800, 25.0  # s, -, 1/s
PUSH, SHARE = (25, 50), 0.5  # steps of the push; its force in weights
NEAR, LEVEL = 1e-3, np.radians(1.0)  # m, rad
V = Status


def check(
    plan: CheckPlan, resume: bool = False, progress: Callable[[Summary], None] | None = None
) -> Summary:
    """Check all grasps of the run and write ``plan.output``; counts of their wrench resistance, and times.

    resume    go on with an unfinished run of the same options
    progress  called with the running summary before the first chunk and after every chunk

    Raises UserError where the output cannot be written or belongs to another plan. KeyboardInterrupt leaves the
    finished shards for ``resume``.
    """
    tell, total = progress or (lambda _: None), Summary(plan.count)
    shards, kind = Shards(plan.output, dump_metadata(plan.metadata)), check_schema(plan.metadata)
    if resume and shards.finished() is not None:
        total.add(_counted(read_check_columns(plan.output)["status"]))
        total.resumed = plan.count
        return total
    started = time.perf_counter()
    with shards.claimed(resume), precision("float64"):
        for chunk in plan.grasps.chunks():
            start, stop = chunk.start, min(chunk.stop, plan.count)
            if start >= stop:
                break
            known = shards.read(chunk.number, start, stop)
            if known is None:
                tell(total)
                contacts = chunk.load().taken(slice(None, stop - start))
                columns = {"row": np.arange(start, stop), **_checked(plan, contacts)}
                rows = check_table(columns, _steerable(columns["verdict"]), kind)
                shards.write(chunk.number, rows, {"start": start, "stop": stop})
                part = _counted(columns["status"])
                part.solved = stop - start
            else:
                part = _counted(known[0]["status"].to_numpy())
                total.resumed += stop - start
            total.add(part)
            total.seconds = time.perf_counter() - started
            tell(total)
        shards.assemble(kind)
    return total


def _steerable(verdict: np.ndarray) -> np.ndarray:
    """There is an equilibrium, and forces reach all of the motion."""
    return np.isin(verdict, (V.RESISTANT.value, V.CONTROLLABLE.value))


def _counted(status: np.ndarray) -> Summary:
    return Summary.of(status, np.full(len(status), np.nan))


def controllability_of(plan: CheckPlan, row: int) -> Controllability:
    """That of the grasp in ``row``, in a batch of one."""
    for chunk in plan.grasps.chunks():
        if chunk.start <= row < chunk.stop:
            with precision("float64"):
                grasp = _grasp(plan, chunk.load().taken(slice(None, plan.count - chunk.start)))
                found = controllability(grasp, plan.body, gravity=plan.gravity)
            lane = slice(row - chunk.start, row - chunk.start + 1)
            return jax.tree.map(lambda x, lane=lane: x[lane], found)
    raise ValueError(f"there is no row {row}")


def _grasp(plan: CheckPlan, contacts: Contacts) -> Grasp:
    """With lanes without contacts at the end, so that every chunk has one shape; they end at once."""
    friction, torsion = plan.grasps.contact.coefficients(contacts)
    active = np.ones(friction.shape, bool) if contacts.active is None else contacts.active
    centred = contacts.position - plan.grasps.candidates.centre_of_mass
    full = Contacts(contacts.grasp_id, centred, contacts.normal, friction, torsion, active).padded(
        min(plan.grasps.request.chunk, plan.count)
    )
    assert full.friction is not None and full.torsion is not None
    model = contact_model(plan.grasps.contact.kind, full.friction, full.torsion)
    return Grasp(full.position, full.normal, model, full.active)


def _checked(plan: CheckPlan, contacts: Contacts) -> dict[str, np.ndarray]:
    """The columns of these rows, but their number."""
    grasp, body, gravity, count = _grasp(plan, contacts), plan.body, plan.gravity, len(contacts)
    found = controllability(grasp, body, gravity=gravity)
    verdict = np.asarray(found.status)
    held = _disturbed(grasp, body, ComputedTorque(Gains.of_rate(RATE)), gravity)
    only = verdict == V.CONTROLLABLE.value
    if only.any():
        keeper = regulator(grasp, body, timestep=TIMESTEP, gravity=gravity, force=found.force, effort=3.0)
        six = jax.tree.map(lambda x: jnp.repeat(x, 6, axis=0) if jnp.ndim(x) else x, keeper)
        other = _disturbed(grasp, body, six, gravity)
        held = {name: np.where(only, other[name], held[name]) for name in held}
    recovered = held["recovered"] & _steerable(verdict)
    columns = {
        "verdict": verdict,
        "status": np.asarray(found.resistance),
        "rank": np.asarray(found.rank),
        "effort": np.asarray(found.effort),
        "weakest": np.asarray(found.uncontrollable),
        "recovered": recovered,
        "settling_time": np.where(recovered, held["settling_time"], np.inf),
        "peak_force": held["peak_force"],
        "cone_use": held["cone_use"],
    }
    return {"grasp_id": contacts.grasp_id, **{name: x[:count] for name, x in columns.items()}}


def _disturbed(
    grasp: Grasp, body: RigidBody, controller: ContactController, gravity: np.ndarray
) -> dict[str, Any]:
    """The six pushes; (N,) of the worst of them."""
    n = grasp.batch_shape[0]
    lanes = jax.tree.map(lambda x: jnp.repeat(x, 6, axis=0), grasp)
    sides = np.concatenate([np.eye(3), -np.eye(3)])
    push = np.zeros((STEPS, 6, 6))
    push[PUSH[0] : PUSH[1], :, :3] = SHARE * float(body.mass) * np.linalg.norm(gravity) * sides
    start = BodyState.at_rest(3, (6 * n,), grasp.dtype)
    out: ClosedLoop = close_loop(
        lanes,
        body,
        controller=controller,
        state=start,
        simulation=Simulation(STEPS, timestep=TIMESTEP, gravity=gravity),
        disturbance=np.tile(push, (1, n, 1)),
    )
    settled = np.asarray(out.settled(position=NEAR, orientation=float(LEVEL)))
    fine = (Status.COMMANDED.value, Status.PROJECTED.value)
    good = np.isin(np.asarray(out.status), fine).all(axis=0) & (settled < STEPS)
    use = np.asarray(out.cone_use).max(axis=0)
    return {
        "recovered": good.reshape(n, 6).all(axis=1),
        "settling_time": TIMESTEP * np.maximum(settled - PUSH[0], 0).reshape(n, 6).max(axis=1),
        "peak_force": np.asarray(out.largest_normal).max(axis=0).reshape(n, 6).max(axis=1),
        "cone_use": use.reshape(n, 6).max(axis=1),
    }
