"""Grasps checked in motion: controllable, and brought back by a controller from a standard set of disturbances?

Six pushes, up, down and sideways along the axes of the mesh, each of half the weight for 50 ms, are six lanes of one
closed loop. Wrench resistant grasps are held by computed torque, grasps that are controllable only by the regulator.
A grasp is recovered if after every push it comes to stay within 1 mm and 1 degree, with forces that were the commanded
ones in every step (for the regulator: or the nearest admissible ones).

The Parquet file has a row for each grasp:

    row, grasp_id   int64             in the source (a sampled grasp: its number)
    verdict         int8              a ControllabilityVerdict
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
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pyarrow as pa

from . import meshes
from .backend import precision
from .closed_loop import ClosedLoop, close_loop
from .control import ComputedTorque, ContactController, ControlStatus, Gains
from .controllability import Controllability, ControllabilityVerdict, controllability
from .dynamics import BodyState, RigidBody
from .errors import UserError
from .formats.parquet import Contacts, dump, write
from .grasp import Grasp
from .regulator import regulator
from .run import Request, Run
from .run import prepare as prepare_run

__all__ = ["CheckRequest", "CheckRun", "check", "prepare", "schema"]

TIMESTEP, STEPS, RATE = 0.002, 800, 25.0  # s, -, 1/s
PUSH, SHARE = (25, 50), 0.5  # steps of the push; its force in weights
NEAR, LEVEL = 1e-3, np.radians(1.0)  # m, rad
V = ControllabilityVerdict


@dataclass(frozen=True)
class CheckRequest:
    """What the user asked for. ``grasps``: where they come from (a ``run.Request``); mass kg; gravity m/s^2, mesh axes.

    object  the mesh whose inertia counts, if it is not the one the grasps were made on; grasps at most ``most``
    """

    grasps: Request
    mass: float
    gravity: tuple[float, float, float] = (0.0, 0.0, -9.81)
    object: str | None = None
    most: int = 256
    output: Path | None = None


@dataclass(frozen=True)
class CheckRun:
    """A checked request: the grasps, the body they hold."""

    run: Run
    body: RigidBody
    gravity: np.ndarray
    count: int
    output: Path
    warnings: tuple[str, ...]


@dataclass(frozen=True)
class Checked:
    """Columns of the file as arrays, and the controllability behind them."""

    columns: dict[str, np.ndarray]
    found: Controllability


def prepare(request: CheckRequest) -> CheckRun:
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
    run = prepare_run(grasps)
    name = request.object or (run.metadata.get("object") or {}).get("name")
    if name is None:
        raise UserError("the file does not name its object, whose inertia is needed: --object names a mesh")
    solid = meshes.load(name, run.metadata.get("unit", "m"))
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
    return CheckRun(run, body, gravity, min(run.candidates, request.most), output, tuple(warnings))


def schema(metadata: dict[str, Any]) -> pa.Schema:
    """The columns above."""
    real, twist = pa.float64(), pa.list_(pa.float64(), 6)
    kinds = [pa.int64(), pa.int64(), pa.int8(), pa.int8(), real, real, twist, pa.bool_(), real, real, real]
    names = (
        "row", "grasp_id", "verdict", "status", "rank", "effort", "weakest", "recovered", "settling_time",
        "peak_force", "cone_use",
    )  # fmt: skip
    return pa.schema(list(zip(names, kinds, strict=True)), {b"jaxgrasp": dump(metadata)})


def check(run: CheckRun) -> Checked:
    """All grasps of the run, in one batch, written to ``run.output``."""
    parts = list(_first(run))
    with precision("float64"):
        contacts = [c for _, c in parts]
        coefficients = [run.run.coefficients(c) for c in contacts]
        position = np.concatenate([c.position for c in contacts]) - run.run.centre_of_mass
        normal = np.concatenate([c.normal for c in contacts])
        friction, torsion = (np.concatenate([pair[i] for pair in coefficients]) for i in (0, 1))
        masks = [c.active for c in contacts if c.active is not None]
        active = np.concatenate(masks) if masks else None
        model = run.run.model.with_coefficients(jnp.asarray(friction), jnp.asarray(torsion))
        checked = _checked(Grasp(position, normal, model, active), run.body, run.gravity)
    rows = {"row": np.concatenate([r for r, _ in parts])}
    rows["grasp_id"] = np.concatenate([c.grasp_id for c in contacts])
    checked = dataclasses.replace(checked, columns=rows | checked.columns)
    kind = schema(run.run.metadata | {"mass": float(run.body.mass), "gravity": run.gravity.tolist()})
    try:
        write(run.output, [_table(checked.columns, kind)], kind)
    except OSError as error:
        raise UserError(f"cannot write {run.output}: {error.strerror or error}") from error
    return checked


def _first(run: CheckRun) -> Iterator[tuple[np.ndarray, Contacts]]:
    """Row numbers and contacts of the first ``run.count`` grasps."""
    for start, stop, load in run.run.chunks():
        keep = min(stop, run.count) - start
        if keep <= 0:
            return
        contacts = load()
        values: dict[str, Any] = {f.name: getattr(contacts, f.name) for f in dataclasses.fields(contacts)}
        kept = {name: None if x is None else np.asarray(x)[:keep] for name, x in values.items()}
        yield np.arange(start, start + keep), dataclasses.replace(contacts, **kept)


def _checked(grasp: Grasp, body: RigidBody, gravity: np.ndarray) -> Checked:
    found = controllability(grasp, body, gravity)
    verdict = np.asarray(found.verdict)
    held = _disturbed(grasp, body, ComputedTorque(Gains.of_rate(RATE)), gravity)
    only = verdict == V.CONTROLLABLE.value
    if only.any():
        keeper = regulator(grasp, body, TIMESTEP, gravity, found.force, effort=3.0)
        six = jax.tree.map(lambda x: jnp.repeat(x, 6, axis=0) if jnp.ndim(x) else x, keeper)
        other = _disturbed(grasp, body, six, gravity)
        held = {name: np.where(only, other[name], held[name]) for name in held}
    known = np.isin(verdict, (V.RESISTANT.value, V.CONTROLLABLE.value))
    recovered = held["recovered"] & known
    columns = {
        "verdict": verdict,
        "status": np.asarray(found.status),
        "rank": np.asarray(found.rank),
        "effort": np.asarray(found.effort),
        "weakest": np.asarray(found.uncontrollable),
        "recovered": recovered,
        "settling_time": np.where(recovered, held["settling_time"], np.inf),
        "peak_force": held["peak_force"],
        "cone_use": held["cone_use"],
    }
    return Checked(columns, found)


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
        lanes, body, controller, start, STEPS, TIMESTEP, None, np.tile(push, (1, n, 1)), gravity
    )
    settled = np.asarray(out.settled(NEAR, float(LEVEL)))
    fine = (ControlStatus.COMMANDED.value, ControlStatus.PROJECTED.value)
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
        "rank": np.isnan(columns["rank"]),
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
