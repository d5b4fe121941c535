"""``jaxgrasp place``: contacts of many random grasps of one object moved by gradients, the best ones to a file.

The request is checked before any work. The file has the columns of ``formats.parquet``, best grasp first, with the
number of its start as ``grasp_id``, and two more:

    objective      float64   what was maximised (metadata: ``objective``), at these contacts
    margin_before  float64   margin of the random grasp that the row began as, the best of ``candidates``

Only RESISTANT grasps within the requirements are written.
"""

from __future__ import annotations

import importlib.util
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import pyarrow as pa

from ..backend import precision
from ..contacts import MODELS
from ..core import Status, UserError
from ..formats import Contacts, Verdicts, read_row, schema, table, write
from ..objects import OBJECTS, Body, load_mesh
from ..placement import (
    CANDIDATES,
    FLOOR,
    Apart,
    EdgeClearance,
    Epsilon,
    JawWidth,
    Margin,
    Objective,
    Placement,
    PlacementProgress,
    Requirement,
    Search,
    place_contacts,
)
from ..report import Verdict, draw
from ..surfaces import MeshSurface
from .load import writable
from .request import coefficients, provenance

__all__ = ["OBJECTIVES", "PlaceRequest", "PlaceRun", "Placed", "draw_best", "place", "prepare_place"]

PICTURES = (".png", ".svg", ".pdf")
EXTRA = (("objective", pa.float64()), ("margin_before", pa.float64()))


# What --objective names, for an object of a radius in m.
OBJECTIVES: dict[str, Callable[[float], Objective]] = {
    "margin": lambda radius: Margin(),
    "epsilon": lambda radius: Epsilon("L1", radius),
    "epsilon-linf": lambda radius: Epsilon("Linf", radius),
}


# What the user reads while it happens.
PHASES = {
    "margin": "climbing the margin",
    "epsilonfloor": "climbing a bound of epsilon",
    "epsilon": "climbing epsilon",
    "settling": "settling on the mesh",
}


@dataclass(frozen=True)
class PlaceRequest:
    """What the user asked for; None means not said. Distances in m, torsion gamma in m, resolution in nodes a side.

    source   a mesh file or a built-in object       picture  of the best grasp, by its suffix png, svg or pdf
    """

    source: str
    output: Path | None = None
    unit: str = "m"
    fingers: int = 3
    model: str = "hard"
    friction: float | None = None
    torsion: float | None = None
    objective: str = "margin"
    starts: int = 256
    steps: int = 150
    candidates: int = CANDIDATES
    apart: float | None = None
    edge_clearance: float | None = None
    jaw_width: float | None = None
    best: int = 16
    seed: int = 0
    resolution: int = 96
    picture: Path | None = None


@dataclass(frozen=True)
class PlaceRun:
    """A checked request. ``metadata`` identify the run and go into the file."""

    request: PlaceRequest
    body: Body
    friction: float
    torsion: float
    requirements: tuple[Requirement, ...]
    output: Path
    metadata: dict[str, Any]
    warnings: tuple[str, ...]


@dataclass(frozen=True)
class Placed:
    """What became of the starts, and of the ``rows`` written how many the checker proved; wall clock in s."""

    placement: Placement
    kept: np.ndarray  # of the placement's grasps, those in the file
    proved: int
    warnings: tuple[str, ...]
    seconds: float

    @property
    def rows(self) -> int:
        """Grasps in the file."""
        return len(self.kept)


def prepare_place(request: PlaceRequest) -> PlaceRun:
    """Check the request, read its object. UserError: one line saying what to do."""
    for name in ("fingers", "starts", "steps", "candidates", "best"):
        if getattr(request, name) < 1:
            raise UserError(f"--{name} must be at least 1, got {getattr(request, name)}")
    if request.resolution < 16:
        raise UserError(f"--resolution must be at least 16 nodes a side, got {request.resolution}")
    if request.seed < 0:
        raise UserError(f"--seed must not be negative, got {request.seed}")
    if request.objective not in OBJECTIVES:
        raise UserError(f"unknown objective {request.objective!r}; take one of {', '.join(OBJECTIVES)}")
    asked: list[Requirement] = []
    for name, kind in (("apart", Apart), ("edge_clearance", EdgeClearance), ("jaw_width", JawWidth)):
        distance = getattr(request, name)
        if distance is None:
            continue
        if not (np.isfinite(distance) and distance > 0):
            raise UserError(f"--{name.replace('_', '-')} must be a number of m > 0, got {distance}")
        asked.append(kind(float(distance)))
    friction, torsion = coefficients(request.model, request.friction, request.torsion)
    _enough_fingers(request.fingers, friction, torsion)
    body = load_mesh(request.source, unit=request.unit)
    name = Path(request.source).name.removesuffix(".gz")
    stem = name if request.source in OBJECTS else Path(name).stem
    output = request.output or Path(f"{stem}.placed.parquet")
    if output.resolve() == Path(request.source).resolve():
        raise UserError(f"{output} is the source; name another file with -o")
    writable(output)
    if request.picture is not None:
        _drawable(request.picture, output)
    metadata = _metadata(request, body, friction, torsion)
    return PlaceRun(request, body, friction, torsion, tuple(asked), output, metadata, body.warnings)


def _enough_fingers(fingers: int, friction: float, torsion: float) -> None:
    """Six balances leave an internal force only among 7 force components; two points have a line no finger stops."""
    components = 1 + 2 * (friction > 0) + (torsion > 0)
    least = -(-7 // components)
    if fingers < least:
        raise UserError(
            f"{fingers} such contacts never hold an object; take --fingers {least} or more, or another --model"
        )


def _drawable(picture: Path, output: Path) -> None:
    if picture.suffix.lower() not in PICTURES:
        raise UserError(f"--picture must end in {', '.join(PICTURES)}, got {picture}")
    if picture.resolve() == output.resolve():
        raise UserError(f"{picture} is the output; name another file with --picture")
    if importlib.util.find_spec("matplotlib") is None:
        raise UserError("pictures need matplotlib: pip install 'jaxgrasp[viz]'")
    writable(picture, "--picture")


def _metadata(request: PlaceRequest, body: Body, friction: float, torsion: float) -> dict[str, Any]:
    asked = {name: getattr(request, name) for name in ("apart", "edge_clearance", "jaw_width")}
    options: dict[str, Any] = {
        "unit": body.unit,
        "fingers": request.fingers,
        "model": request.model,
        "friction": friction if request.model != "frictionless" else None,
        "torsion": torsion if request.model == "soft" else None,
        "objective": request.objective,
        "starts": request.starts,
        "candidates": request.candidates,
        "steps": request.steps,
        **asked,
        "best": request.best,
        "seed": request.seed,
        "resolution": request.resolution,
    }
    words = ["jaxgrasp", "place", request.source]
    for name, value in options.items():
        words += [] if value is None else [f"--{name.replace('_', '-')}", str(value)]
    return {
        **options,
        "object": {"name": body.name, "sha256": body.sha256},
        "centre_of_mass": [float(x) for x in body.centre_of_mass],
        "model": {"kind": request.model, "friction": friction, "torsion": torsion},
        "dtype": "float64",
        "tolerance": 1e-8,
        **provenance(words),
    }


def place(run: PlaceRun, progress: Callable[[str, int, str], None] | None = None) -> Placed:
    """Place the contacts and write the grasps that hold to ``run.output``.

    progress  called with what is being done, starts finished so far, and a word about them

    Raises UserError where no start ends in a grasp that holds within the requirements, where the grid cannot resolve
    the object, and where the file cannot be written. However it ends, no half-written file is left.
    """
    tell, request, started = progress or (lambda *_: None), run.request, time.perf_counter()

    def climbed(so_far: PlacementProgress) -> None:
        doing = PHASES.get(so_far.phase, so_far.phase)
        tell(doing, so_far.done, f"best {so_far.best:.4g}" if np.isfinite(so_far.best) else "")

    tell("measuring the object", 0, "")
    with precision("float64"):
        surface = MeshSurface.from_body(run.body, resolution=request.resolution)
        tell("screening", 0, "compiling")
        found = place_contacts(
            surface,
            fingers=request.fingers,
            model=MODELS[request.model]().with_coefficients(
                jnp.asarray(run.friction), jnp.asarray(run.torsion)
            ),
            objective=OBJECTIVES[request.objective](float(surface.radius)),
            requirements=run.requirements,
            search=Search(request.starts, request.steps, request.candidates, seed=request.seed),
            best=request.best,
            progress=climbed,
        )
        kept = np.flatnonzero(np.asarray(found.verdict.status) == Status.RESISTANT)
        if not len(kept):
            raise UserError(_why_none(run, found))
        _write(run, found, kept)
    return Placed(found, kept, int(found.proved[kept].sum()), surface.warnings, time.perf_counter() - started)


def draw_best(run: PlaceRun) -> None:
    """Draw the first grasp of the file that ``place`` wrote, where the request names a picture."""
    if run.request.picture is not None:
        draw(Verdict.from_row(*read_row(run.output, 0)), run.request.picture, run.body.mesh)


def _why_none(run: PlaceRun, found: Placement) -> str:
    if not len(found.value):
        return (
            "no start ended within the requirements: ask for less distance or clearance, or for more --starts"
        )
    starts = run.request.starts
    return f"none of {starts} starts ended in a grasp that holds; take more --fingers, --friction or --starts"


def _write(run: PlaceRun, found: Placement, kept: np.ndarray) -> None:
    shape = (len(kept), run.request.fingers)
    normal = np.asarray(found.grasp.normal)[kept]
    coefficient = (np.full(shape, run.friction), np.full(shape, run.torsion), np.ones(shape, bool))
    contacts = Contacts(found.start[kept], found.position[kept], normal, *coefficient)
    names = Verdicts.__dataclass_fields__
    verdicts = Verdicts(**{name: np.asarray(getattr(found.verdict, name))[kept] for name in names})
    plain = schema(run.request.fingers, "float64", run.metadata)
    kind, rows = plain, table(contacts, verdicts, plain)
    before = found.before[found.start[kept]]
    values = (pa.array(found.value[kept]), pa.array(before, mask=before <= FLOOR))
    for (name, real), column in zip(EXTRA, values, strict=True):
        kind, rows = kind.append(pa.field(name, real)), rows.append_column(name, column.cast(real))
    try:
        write(run.output, [rows], kind)
    except OSError as error:
        raise UserError(f"cannot write {run.output}: {error.strerror or error}") from error
