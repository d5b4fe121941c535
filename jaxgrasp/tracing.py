"""One grasp under the magnifying glass: the iterations of the solver, and a file that reproduces a lane."""

from __future__ import annotations

import json
import os
import zlib
from pathlib import Path
from zipfile import BadZipFile

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ._types import Array, Float, gap_floor
from .contacts import Component, Frictionless, HardFinger, SoftFinger
from .grasp import Grasp
from .margin import Contacts, fold, margin_program, project, starting_point
from .resistance import TOTAL_BUDGET, contacts_of
from .solver import Progress, Stop
from .solver.interior_point import Step, advance, begin

__all__ = ["Trace", "load_grasp", "save_grasp", "trace"]


class Trace(eqx.Module):
    """The iterations of one grasp, first entry the starting point; ``print(trace)`` shows a table.

    lower, upper     (n + 1,) the bracket of the margin after each iteration
    gap              (n + 1,) <u, z>
    residual         (n + 1,) |b - B u| before each step (NaN at the start, as the two below)
    centering        (n + 1,) Mehrotra's sigma
    length           (n + 1,) step length
    stop             why it ended, a ``solver.Stop`` number
    """

    lower: Float[Array, " steps"]
    upper: Float[Array, " steps"]
    gap: Float[Array, " steps"]
    residual: Float[Array, " steps"]
    centering: Float[Array, " steps"]
    length: Float[Array, " steps"]
    stop: int = eqx.field(static=True)

    def __str__(self) -> str:
        lines = ["iteration   lower bound    upper bound        gap   residual  centring  length"]
        for i in range(len(self.gap)):
            row = f"{i:9d} {self.lower[i]:13.9f}  {self.upper[i]:13.9f}  {self.gap[i]:9.2e}"
            if i:
                row += f"  {self.residual[i]:9.1e}  {self.centering[i]:8.1e}"
                row += f"  {self.length[i]:6.4f}"
            lines.append(row)
        lines.append(Stop(self.stop).sentence)
        return "\n".join(lines)


def _tile(contacts: Contacts, components: tuple[Component, ...]):
    folded = fold(contacts, components)
    projection = project(folded)
    return folded, projection, margin_program(projection.basis)


def trace(grasp: Grasp, tolerance: float = 1e-8, max_iterations: int = TOTAL_BUDGET) -> Trace:
    """The margin problem of one grasp, iteration by iteration: bracket, residuals, step lengths.

    ``grasp`` must be a single grasp (no batch axes): index a batch first, ``trace(grasps[17])``.
    """
    if grasp.batch_shape:
        raise ValueError(
            f"trace takes one grasp; index the batch {grasp.batch_shape} first, e.g. trace(grasp[0])"
        )
    components = grasp.model.components(grasp.dimension)
    rows = jax.tree.map(lambda x: x[None], contacts_of(grasp))
    goal = jnp.asarray(max(tolerance, gap_floor(grasp.dtype)), grasp.dtype)

    @jax.jit
    def first(rows: Contacts) -> Progress:
        folded, projection, program = _tile(rows, components)
        start = starting_point(folded, projection)
        dual = tuple(jnp.where(start.unbounded, v, jnp.zeros_like(v)) for v in start.iterate.y)
        return begin(program, start.iterate._replace(y=dual), ~folded.valid | start.unbounded)

    @jax.jit
    def values(rows: Contacts, state: Progress) -> tuple[Array, Array]:
        *_, program = _tile(rows, components)
        return -program.primal_value(state.iterate.u), -program.dual_value(state.iterate.y)

    @jax.jit
    def step(rows: Contacts, state: Progress) -> tuple[Progress, Step]:
        *_, program = _tile(rows, components)
        return advance(program, state, goal)

    state = first(rows)
    nan = float("nan")
    log = [[*(float(x[0]) for x in values(rows, state)), float(state.gap[0]), nan, nan, nan]]
    while int(state.stop[0]) == Stop.RUNNING and len(log) <= max_iterations:
        state, info = step(rows, state)
        bounds = (float(x[0]) for x in values(rows, state))
        log.append([*bounds, float(state.gap[0]), *(float(x[0]) for x in info)])
    columns = [jnp.asarray(c, grasp.dtype) for c in np.asarray(log, np.float64).T]
    return Trace(*columns, stop=int(state.stop[0]))


FORMAT, VERSION = "jaxgrasp lane", 1
_MODELS = {"Frictionless": Frictionless, "HardFinger": HardFinger, "SoftFinger": SoftFinger}


def save_grasp(path: str | os.PathLike, grasp: Grasp) -> None:
    """Write one grasp to ``path`` (.npz), bit for bit, for a bug report; ``load_grasp`` reads it back.

    Index the batch for the failing lane: ``save_grasp("lane.npz", grasps[17])``. The file holds arrays and JSON, no
    code; it is written beside and renamed.
    """
    path = Path(path)
    model = type(grasp.model).__name__
    if model not in _MODELS:
        raise ValueError(f"cannot save the contact model {model}; known models: {', '.join(_MODELS)}")
    header = {"format": FORMAT, "version": VERSION, "model": model}
    beside = path.with_name(path.name + ".tmp")
    try:
        with open(beside, "wb") as file:
            np.savez(
                file,
                header=np.frombuffer(json.dumps(header).encode(), np.uint8),
                position=np.asarray(grasp.position),
                normal=np.asarray(grasp.normal),
                friction=np.asarray(grasp.model.friction_coefficient),
                torsion=np.asarray(grasp.model.torsion_coefficient),
                active=np.asarray(grasp.active),
            )
        os.replace(beside, path)
    except BaseException:
        beside.unlink(missing_ok=True)
        raise


def load_grasp(path: str | os.PathLike) -> Grasp:
    """The grasp that ``save_grasp`` wrote; ValueError if the file is not one."""
    try:
        with open(path, "rb") as source, np.load(source, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        header = json.loads(arrays["header"].tobytes().decode())
        if (header["format"], header["version"]) != (FORMAT, VERSION):
            raise ValueError(f"it holds {header['format']!r} version {header['version']}")
        model = _MODELS[header["model"]]()
        coefficients = jnp.asarray(arrays["friction"]), jnp.asarray(arrays["torsion"])
        model = model.with_coefficients(*coefficients)
        return Grasp(arrays["position"], arrays["normal"], model, arrays["active"])
    except (
        OSError,
        KeyError,
        ValueError,
        TypeError,
        AttributeError,
        EOFError,
        BadZipFile,
        zlib.error,
    ) as error:
        raise ValueError(f"{path} is not a grasp written by jaxgrasp.save_grasp ({error})") from error
