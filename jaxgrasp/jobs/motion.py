"""Grasps checked in motion: controllable, and brought back by a controller from a standard set of disturbances?

Six pushes, up, down and sideways along the axes of the mesh, each of half the weight for 50 ms, are six lanes of one
closed loop. Wrench resistant grasps are held by computed torque, grasps that are controllable only by the regulator.
A grasp is recovered if after every push it comes to stay within 1 mm and 1 degree, with forces that were the commanded
ones in every step (for the regulator: or the nearest admissible ones).

A chunk of grasps is checked in one batch and kept as a shard (``shards``): memory does not grow with their number,
and a killed run goes on where it was. A row depends on its grasp alone.

The Parquet file has a row for each grasp:

    row, grasp_id   int64             in the source (a sampled grasp: its number)
    verdict         int8              a Status
    status          int8              a Status: wrench resistance
    rank            float64           of the controllability matrix, 12 where controllable; null where INVALID
    effort          float64           of the direction hardest to reach, in weights; null where not controllable
    weakest         list<float64>[6]  (velocity m/s; angular velocity rad/s): the motion least or not affected
    recovered       bool              null where there is no equilibrium to return to
    settling_time   float64           s after the push begins, the longest of six; null where not recovered
    peak_force      float64           N, the largest normal force; null as recovered
    cone_use        float64           the largest share of friction used; null as recovered
"""

from __future__ import annotations

import dataclasses
import shlex
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from ..backend import precision
from ..contacts import Grasp
from ..core import Status, UserError
from ..formats import Contacts, dump
from ..motion import (
    BodyState,
    ClosedLoop,
    ComputedTorque,
    ContactController,
    Controllability,
    Gains,
    RigidBody,
    close_loop,
    controllability,
    regulator,
)
from ..objects import load_mesh
from .request import Request, Run, prepare_screen
from .shards import Shards
from .summary import Summary

__all__ = [
    "CheckRequest",
    "CheckRun",
    "check",
    "checked_columns",
    "controllability_of",
    "prepare_check",
    "schema",
]

TIMESTEP, STEPS, RATE = 0.002, 800, 25.0  # s, -, 1/s
PUSH, SHARE = (25, 50), 0.5  # steps of the push; its force in weights
NEAR, LEVEL = 1e-3, np.radians(1.0)  # m, rad
V = Status


@dataclass(frozen=True)
class CheckRequest:
    """What the user asked for. ``grasps``: where they come from (a ``run.Request``); mass kg; gravity m/s^2, mesh axes.

    object  the mesh whose inertia counts, if it is not the one the grasps were made on
    most    grasps, the first ones, are checked, ``grasps.chunk`` at a time
    """

    grasps: Request
    mass: float
    gravity: tuple[float, float, float] = (0.0, 0.0, -9.81)
    object: str | None = None
    most: int = 256
    output: Path | None = None


@dataclass(frozen=True)
class CheckRun:
    """A checked request: the grasps, the body they hold. ``metadata`` identify the run and go into the file."""

    run: Run
    body: RigidBody
    gravity: np.ndarray
    count: int
    output: Path
    metadata: dict[str, Any]
    warnings: tuple[str, ...]


def prepare_check(request: CheckRequest) -> CheckRun:
    """Check the request, read its grasps and its object. UserError: one line saying what to do."""
    if not (np.isfinite(request.mass) and request.mass > 0):
        raise UserError(f"--mass must be a number of kg > 0, got {request.mass}")
    gravity = np.asarray(request.gravity, np.float64)
    if gravity.shape != (3,) or not np.isfinite(gravity).all() or not np.any(gravity):
        raise UserError(
            "--gravity must be three finite numbers x,y,z in m/s^2, not all 0: it is what is carried"
        )
    if request.most < 1:
        raise UserError(f"--most must be at least 1, got {request.most}")
    grasps = request.grasps
    if not grasps.source.endswith((".parquet", ".pq")) and grasps.samples is None:
        grasps = dataclasses.replace(grasps, samples=request.most)
    run = prepare_screen(grasps)
    name = request.object or (run.metadata.get("object") or {}).get("name")
    if name is None:
        raise UserError("the file does not name its object, whose inertia is needed: --object names a mesh")
    solid = load_mesh(name, unit=run.metadata.get("unit", "m"))
    if not solid.watertight or not solid.mesh.volume > 0:
        raise UserError(
            f"{name} encloses no volume, so its inertia is unknown; repair it or name another --object"
        )
    warnings = list(run.warnings)
    if np.linalg.norm(solid.centre_of_mass - run.centre_of_mass) > 1e-6 * solid.mesh.extents.max():
        warnings.append(
            "the centre of mass is not the mesh's: the inertia is taken as if the mass were uniform"
        )
    with precision("float64"):
        body = RigidBody.from_mesh(solid.mesh, mass=request.mass)
    stem = Path(request.grasps.source).name.split(".")[0]
    output = request.output or Path(f"{stem}.check.parquet")
    if output.resolve() == Path(request.grasps.source).resolve():
        raise UserError(f"{output} is the source; name another file with -o")
    count = min(run.candidates, request.most)
    about = {
        "command": _command(request, run),
        "mass": request.mass,
        "gravity": gravity.tolist(),
        "inertia": {"name": solid.name, "sha256": solid.sha256},
        "checked": count,
        "chunk": run.chunk,
    }
    return CheckRun(run, body, gravity, count, output, run.metadata | about, tuple(warnings))


def _command(request: CheckRequest, run: Run) -> str:
    """What to type for this very run."""
    grasps, words = request.grasps, ["jaxgrasp", "check", request.grasps.source]
    options: list[tuple[str, Any]] = [
        ("--mass", request.mass),
        ("--gravity", ",".join(map(repr, map(float, request.gravity)))),
        ("--most", request.most),
        ("--chunk", run.chunk),
        ("--fingers", grasps.fingers),
        ("--model", grasps.model),
        ("--friction", grasps.friction),
        ("--torsion", grasps.torsion),
        ("--seed", run.metadata["seed"] if "sampler" in run.metadata else None),
        ("--unit", run.metadata["unit"] if "sampler" in run.metadata else None),
        ("--object", request.object),
    ]
    return shlex.join(words + [str(x) for pair in options if pair[1] is not None for x in pair])


def schema(metadata: dict[str, Any]) -> pa.Schema:
    """The columns above."""
    real, twist = pa.float64(), pa.list_(pa.float64(), 6)
    kinds = [pa.int64(), pa.int64(), pa.int8(), pa.int8(), real, real, twist, pa.bool_(), real, real, real]
    names = (
        "row", "grasp_id", "verdict", "status", "rank", "effort", "weakest", "recovered", "settling_time",
        "peak_force", "cone_use",
    )  # fmt: skip
    return pa.schema(list(zip(names, kinds, strict=True)), {b"jaxgrasp": dump(metadata)})


def check(run: CheckRun, resume: bool = False, progress: Callable[[Summary], None] | None = None) -> Summary:
    """Check all grasps of the run and write ``run.output``; counts of their wrench resistance, and times.

    resume    go on with an unfinished run of the same options
    progress  called with the running summary before the first chunk and after every chunk

    Raises UserError where the output cannot be written or belongs to another run. KeyboardInterrupt leaves the
    finished shards for ``resume``.
    """
    tell, total = progress or (lambda _: None), Summary(run.count)
    shards, kind = Shards(run.output, dump(run.metadata)), schema(run.metadata)
    if resume and shards.finished() is not None:
        total.add(_counted(checked_columns(run.output)["status"]))
        total.resumed = run.count
        return total
    started = time.perf_counter()
    with shards.claimed(resume), precision("float64"):
        for number, (start, stop, load) in enumerate(run.run.chunks()):
            stop = min(stop, run.count)
            if start >= stop:
                break
            known = shards.read(number, start, stop)
            if known is None:
                tell(total)
                columns = {"row": np.arange(start, stop), **_checked(run, _first(load(), stop - start))}
                shards.write(number, _table(columns, kind), {"start": start, "stop": stop})
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


def _counted(status: np.ndarray) -> Summary:
    return Summary.of(status, np.full(len(status), np.nan))


def checked_columns(path: Path) -> dict[str, np.ndarray]:
    """The columns of a file of checked grasps as arrays: NaN where a number is null, False where recovered is."""
    table = pq.read_table(path)
    columns = {name: table[name] for name in table.column_names if name != "weakest"}
    columns["recovered"] = columns["recovered"].fill_null(False)
    return {name: x.to_numpy() for name, x in columns.items()}


def controllability_of(run: CheckRun, row: int) -> Controllability:
    """That of the grasp in ``row``, in a batch of one."""
    for start, stop, load in run.run.chunks():
        if start <= row < stop:
            with precision("float64"):
                grasp = _grasp(run, _first(load(), run.count - start))
                found = controllability(grasp, run.body, gravity=run.gravity)
            lane = slice(row - start, row - start + 1)
            return jax.tree.map(lambda x, lane=lane: x[lane], found)
    raise ValueError(f"there is no row {row}")


def _first(contacts: Contacts, count: int) -> Contacts:
    values: dict[str, Any] = {f.name: getattr(contacts, f.name) for f in dataclasses.fields(contacts)}
    kept: dict[str, Any] = {name: None if x is None else np.asarray(x)[:count] for name, x in values.items()}
    return Contacts(**kept)


def _grasp(run: CheckRun, contacts: Contacts) -> Grasp:
    """With lanes without contacts at the end, so that every chunk has one shape; they end at once."""
    count, size = len(contacts), min(run.run.chunk, run.count)
    friction, torsion = run.run.coefficients(contacts)
    active = np.ones(friction.shape, bool) if contacts.active is None else contacts.active
    values = (contacts.position - run.run.centre_of_mass, contacts.normal, friction, torsion, active)
    fill = [(0, max(size - count, 0))]
    position, normal, friction, torsion, active = (np.pad(x, fill + [(0, 0)] * (x.ndim - 1)) for x in values)
    return Grasp(
        position, normal, run.run.model.with_coefficients(jnp.asarray(friction), jnp.asarray(torsion)), active
    )


def _checked(run: CheckRun, contacts: Contacts) -> dict[str, np.ndarray]:
    """The columns of these rows, but their number."""
    grasp, body, gravity, count = _grasp(run, contacts), run.body, run.gravity, len(contacts)
    found = controllability(grasp, body, gravity=gravity)
    verdict = np.asarray(found.status)
    held = _disturbed(grasp, body, ComputedTorque(Gains.of_rate(RATE)), gravity)
    only = verdict == V.CONTROLLABLE.value
    if only.any():
        keeper = regulator(grasp, body, timestep=TIMESTEP, gravity=gravity, force=found.force, effort=3.0)
        six = jax.tree.map(lambda x: jnp.repeat(x, 6, axis=0) if jnp.ndim(x) else x, keeper)
        other = _disturbed(grasp, body, six, gravity)
        held = {name: np.where(only, other[name], held[name]) for name in held}
    known = np.isin(verdict, (V.RESISTANT.value, V.CONTROLLABLE.value))
    recovered = held["recovered"] & known
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
        steps=STEPS,
        timestep=TIMESTEP,
        reference=None,
        disturbance=np.tile(push, (1, n, 1)),
        gravity=gravity,
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


def _table(columns: dict[str, np.ndarray], kind: pa.Schema) -> pa.Table:
    known = np.isin(columns["verdict"], (V.RESISTANT.value, V.CONTROLLABLE.value))
    missing = {
        "rank": columns["rank"] < 0,
        "effort": ~np.isfinite(columns["effort"]),
        "recovered": ~known,
        "settling_time": ~columns["recovered"],
        "peak_force": ~known,
        "cone_use": ~known,
    }
    arrays = []
    for name in kind.names:
        values = columns[name]
        if values.ndim == 2:
            flat = pa.array(np.ascontiguousarray(values).reshape(-1))
            arrays.append(pa.FixedSizeListArray.from_arrays(flat, values.shape[1]))
        else:
            arrays.append(pa.array(values, mask=missing.get(name)).cast(kind.field(name).type))
    return pa.Table.from_arrays(arrays, schema=kind)
