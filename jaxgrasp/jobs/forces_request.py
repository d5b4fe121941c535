"""Forces against one load for the grasps of a file: what was asked for, checked before any work."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ..contacts import MODELS, component_names
from ..core import Status, UserError, open_file
from ..forces import CRITERIA, Criterion, make_criterion, positive_option
from ..formats import MOST_BYTES, Contacts, GraspFile, SavedGrasps
from .outputs import derived_output, not_the_source, writable
from .provenance import digest, provenance
from .threads import thread_count

__all__ = ["ForcesPlan", "ForcesRequest", "Load", "plan_forces"]


@dataclass(frozen=True)
class ForcesRequest:
    """What the user asked for; None means not said.

    source  a Parquet file of screened grasps, or a file that ``save_grasp`` wrote
    row     this grasp only; status: only grasps with this verdict in the source
    mass    kg, with ``gravity``, a direction in the mesh's frame, and ``g`` in m/s^2; or ``wrench``: force in N and
            torque in N m about the centre of mass, mesh axes
    weight  N, of robust; length in m, of least-norm; max_normal in N
    """

    source: str
    output: Path | None = None
    row: int | None = None
    status: str | None = None
    mass: float | None = None
    gravity: tuple[float, ...] | None = None
    g: float | None = None
    wrench: tuple[float, ...] | None = None
    criterion: str = "gentlest"
    weight: float | None = None
    length: float | None = None
    max_normal: float | None = None
    tolerance: float = 1e-8
    chunk: int = 65536
    threads: int | None = None


@dataclass(frozen=True)
class Load:
    """wrench  (m,) on the object: force in N, torque in N m about the centre of mass, mesh axes.

    mass, gravity, g  where it is a weight: kg, unit vector, m/s^2; ``assumed``: nobody said where down is
    """

    wrench: np.ndarray
    mass: float | None = None
    gravity: np.ndarray | None = None
    g: float | None = None
    assumed: bool = False

    @property
    def metadata(self) -> dict[str, Any]:
        about: dict[str, Any] = {"wrench": self.wrench.tolist()}
        if self.gravity is not None:
            about |= {"mass": self.mass, "gravity": self.gravity.tolist(), "g": self.g}
        return about


@dataclass(frozen=True)
class Selection:
    """Which grasps of the source: ``row`` alone, or the ``count`` rows with this verdict; None: all of them."""

    row: int | None
    status: Status | None
    count: int


@dataclass(frozen=True)
class ForcesPlan:
    """A checked request. ``metadata`` is what identifies the run and goes into the file.

    output  None where one grasp is asked for and no file
    """

    request: ForcesRequest
    source: GraspFile | SavedGrasps
    selection: Selection
    load: Load
    criterion: Criterion
    output: Path | None
    metadata: dict[str, Any]

    @property
    def threads(self) -> int:
        """Chunks worked on at a time."""
        return thread_count(self.request.threads)

    @property
    def chunk(self) -> int:
        """Grasps solved together."""
        return min(self.request.chunk, self.selection.count)

    def chunks(self) -> Iterator[tuple[np.ndarray, Contacts]]:
        """Row numbers and contacts, at most ``chunk`` at a time."""
        row = self.selection.row
        if row is not None:
            yield np.asarray([row]), self.source.row(row)
        else:
            yield from self.source.selected(self.chunk, self.selection.status)


def _load(request: ForcesRequest, dimension: int) -> Load:
    m = 3 if dimension == 2 else 6
    axes = "x,y,z"[: 2 * dimension - 1]
    if (request.mass is None) == (request.wrench is None):
        raise UserError(f"give one load: --mass KG, with --gravity {axes} if down is not -z, or --wrench")
    if request.wrench is not None:
        for option, value in (("gravity", request.gravity), ("g", request.g)):
            if value is not None:
                raise UserError(f"--{option} belongs to --mass; with --wrench the load is the wrench alone")
        wrench = np.asarray(request.wrench, np.float64)
        if wrench.shape != (m,) or not np.isfinite(wrench).all():
            words = "fx,fy,fz,tx,ty,tz" if dimension == 3 else "fx,fy,t"
            raise UserError(
                f"--wrench must be {m} finite numbers {words} for these grasps, got {len(wrench)}"
            )
        return Load(wrench)
    g = 9.81 if request.g is None else request.g
    positive_option("mass", request.mass)
    positive_option("g", g)
    assert request.mass is not None
    assumed = request.gravity is None
    gravity = -np.eye(dimension)[-1] if request.gravity is None else np.asarray(request.gravity, np.float64)
    size = float(np.linalg.norm(gravity))
    if gravity.shape != (dimension,) or not np.isfinite(size) or size == 0:
        raise UserError(f"--gravity must be a direction {axes}: {dimension} finite numbers, not all 0")
    gravity = gravity / size + 0.0
    wrench = np.concatenate([request.mass * g * gravity, np.zeros(m - dimension)]) + 0.0
    return Load(wrench, request.mass, gravity, g, assumed)


def _status(name: str | None) -> Status | None:
    if name is None:
        return None
    known = (Status(value) for value in range(Status.RESISTANT, Status.STALLED + 1))
    names = {status.name.replace("_", "-").lower(): status for status in known}
    if name not in names:
        raise UserError(f"unknown status {name!r}; take one of {', '.join(names)}")
    return names[name]


def _source(name: str) -> GraspFile | SavedGrasps:
    path = Path(name)
    if not path.suffix and not path.exists():
        raise UserError(f"{name} is no file of grasps: jaxgrasp screen OBJECT writes one")
    with open_file(path, MOST_BYTES) as stream:
        start = stream.read(4)
    if start == b"PK\x03\x04":
        return SavedGrasps(path)
    if start != b"PAR1":
        raise UserError(
            f"{path} is neither a Parquet file of grasps nor one that save_grasp wrote: screen a mesh first, "
            f"with jaxgrasp screen {path}"
        )
    return GraspFile(path)


def plan_forces(request: ForcesRequest) -> ForcesPlan:
    """Check the request and open its source. UserError: one line saying what to do."""
    criterion = make_criterion(request.criterion, weight=request.weight, length=request.length)
    status = _status(request.status)
    positive_option("tolerance", request.tolerance)
    if request.max_normal == float("inf"):  # no limit
        request = replace(request, max_normal=None)
    positive_option("max-normal", request.max_normal)
    for name, value in (("chunk", request.chunk), ("threads", request.threads)):
        if value is not None and value < 1:
            raise UserError(f"--{name} must be at least 1, got {value}")
    if request.row is not None and status is not None:
        raise UserError("--row names one grasp; leave --status out")
    source = _source(request.source)
    if source.kind not in MODELS:
        raise UserError(
            f"{request.source} has contacts of an unknown model, {source.kind!r}; update jaxgrasp"
        )
    if request.length is not None and "tau_n" not in component_names(source.kind, source.dimension):
        raise UserError(
            f"--length weighs a soft finger's torque; {source.kind} contacts have none: leave it out"
        )
    load = _load(request, source.dimension)
    selection = _select(request, source, status)
    output = _output(request, selection)
    metadata = _metadata(request, source, load, selection.row)
    return ForcesPlan(request, source, selection, load, criterion, output, metadata)


def _select(request: ForcesRequest, source: GraspFile | SavedGrasps, status: Status | None) -> Selection:
    row = 0 if request.row is None and source.rows == 1 and status is None else request.row
    if row is not None:
        source.row(row)  # says so if there is none
    count = 1 if row is not None else source.count(status)
    if not count:
        raise UserError(f"no grasp in {request.source} is {request.status}; leave --status out")
    return Selection(row, status, count)


def _output(request: ForcesRequest, selection: Selection) -> Path | None:
    output = request.output
    if output is None and selection.row is None:
        output = derived_output(request.source, "forces.parquet")
    if output is not None:
        not_the_source(output, request.source)
        writable(output)
    return output


def _metadata(
    request: ForcesRequest, source: GraspFile | SavedGrasps, load: Load, row: int | None
) -> dict[str, Any]:
    names = ("row", "status", "mass", "gravity", "g", "wrench", "criterion", "weight", "length")
    names += ("max_normal", "tolerance", "chunk")
    weight = (1.0 if request.weight is None else request.weight) if request.criterion == "robust" else None
    return {
        **source.about,
        "contacts": {"name": request.source, "sha256": digest(request.source)},
        "row": row,
        "status": request.status,
        "centre_of_mass": source.centre_of_mass.tolist(),
        "fingers": source.fingers,
        "dimension": source.dimension,
        "dtype": "float64",
        "load": load.metadata,
        "criterion": {
            "name": request.criterion,
            "weight": weight,
            "length": request.length,
            "unit": CRITERIA[request.criterion][1],
        },
        "max_normal": request.max_normal,
        "tolerance": request.tolerance,
        **provenance("forces", request.source, {name: getattr(request, name) for name in names}),
    }
