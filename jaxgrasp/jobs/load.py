"""A load on the grasps of a file: what ``jaxgrasp forces`` was asked for, checked before any work."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..contacts import MODELS, Component, ContactModel
from ..core import Status, UserError
from ..forces import CRITERIA, Criterion, make_criterion, positive_option
from ..formats import Contacts, GraspFile, SavedGrasps
from .request import provenance

__all__ = ["Load", "LoadRequest", "LoadRun", "prepare_load", "writable"]


@dataclass(frozen=True)
class LoadRequest:
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
    threads: int = 1


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
class LoadRun:
    """A checked request. ``metadata`` is what identifies the run and goes into the file; ``row`` None: many grasps."""

    source: GraspFile | SavedGrasps
    rows: int
    row: int | None
    status: Status | None
    dimension: int
    kind: str
    centre_of_mass: np.ndarray
    load: Load
    criterion: Criterion
    max_normal: float | None
    tolerance: float
    output: Path | None
    chunk: int
    threads: int
    metadata: dict[str, Any]

    def chunks(self) -> Iterator[tuple[np.ndarray, Contacts]]:
        """Row numbers and contacts, at most ``chunk`` at a time."""
        if self.row is not None:
            yield np.asarray([self.row]), self.source.row(self.row)
        else:
            yield from self.source.selected(self.chunk, self.status)

    @property
    def fingers(self) -> int:
        return self.source.fingers

    @property
    def model(self) -> ContactModel:
        """The contact model, with no coefficients of its own yet."""
        return MODELS[self.kind]()


def _load(request: LoadRequest, dimension: int) -> Load:
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
    names = {status.name.replace("_", "-").lower(): status for status in Status}
    if name not in names:
        raise UserError(f"unknown status {name!r}; take one of {', '.join(names)}")
    return names[name]


def _source(name: str) -> GraspFile | SavedGrasps:
    path = Path(name)
    if not path.is_file():
        hint = f"{name} is no file of grasps: jaxgrasp screen OBJECT writes one"
        raise UserError(hint if not path.suffix or path.exists() else f"{path}: no such file")
    try:
        with path.open("rb") as stream:
            start = stream.read(4)
    except OSError as error:
        raise UserError(f"{path} cannot be read: {error.strerror or error}") from error
    if start == b"PK\x03\x04":
        return SavedGrasps(path)
    if start != b"PAR1":
        raise UserError(
            f"{path} is neither a Parquet file of grasps nor one that save_grasp wrote: screen a mesh first, "
            f"with jaxgrasp screen {path}"
        )
    return GraspFile(path)


def writable(output: Path, option: str = "-o") -> None:
    """Whether a file can be put there: UserError naming the ``option`` that says another place."""
    if output.is_dir():
        raise UserError(f"{output} is a directory; name a file with {option}")
    beside = output.with_name(f".{output.name}.{os.getpid()}.try")
    try:
        beside.touch()
        beside.unlink()
    except OSError as error:
        raise UserError(
            f"{output} cannot be written: {error.strerror or error}; name another file with {option}"
        ) from error


def prepare_load(request: LoadRequest) -> LoadRun:
    """Check the request and open its source. UserError: one line saying what to do."""
    criterion = make_criterion(request.criterion, weight=request.weight, length=request.length)
    status = _status(request.status)
    positive_option("tolerance", request.tolerance)
    positive_option("max-normal", request.max_normal)
    for name, value in (("chunk", request.chunk), ("threads", request.threads)):
        if value < 1:
            raise UserError(f"--{name} must be at least 1, got {value}")
    if request.row is not None and status is not None:
        raise UserError("--row names one grasp; leave --status out")
    source = _source(request.source)
    if isinstance(source, SavedGrasps):
        about: dict[str, Any] = {}
        kind = next(name for name, model in MODELS.items() if isinstance(source.model, model))
        dimension, com = source.dimension, np.zeros(source.dimension)
    else:
        about = {name: source.metadata.get(name) for name in ("object", "unit")}
        kind, dimension = source.metadata["model"].get("kind"), 3
        if kind not in MODELS:
            raise UserError(f"{request.source} has contacts of an unknown model, {kind!r}; update jaxgrasp")
        com = np.asarray(source.metadata["centre_of_mass"], np.float64)
    spins = Component.SPIN in MODELS[kind]().components(dimension)
    if request.length is not None and not spins:
        raise UserError(f"--length weighs a soft finger's torque; {kind} contacts have none: leave it out")
    load = _load(request, dimension)
    row = 0 if request.row is None and source.rows == 1 and status is None else request.row
    if row is not None:
        source.row(row)  # says so if there is none
    rows = 1 if row is not None else source.count(status)
    if not rows:
        raise UserError(f"no grasp in {request.source} is {request.status}; leave --status out")
    output = request.output
    if output is None and row is None:
        output = Path(Path(request.source).name.split(".")[0] + ".forces.parquet")
    if output is not None:
        if output.resolve() == Path(request.source).resolve():
            raise UserError(f"{output} is the source; name another file with -o")
        writable(output)
    metadata = about | _metadata(request, source, kind, dimension, com, load, row)
    return LoadRun(
        source, rows, row, status, dimension, kind, com, load, criterion, request.max_normal, request.tolerance,
        output, min(request.chunk, rows), request.threads, metadata,
    )  # fmt: skip


def _metadata(
    request: LoadRequest, source, kind: str, dimension: int, com, load: Load, row
) -> dict[str, Any]:
    words = ["jaxgrasp", "forces", request.source]
    options: list[tuple[str, Any]] = [
        ("--row", request.row), ("--status", request.status), ("--mass", request.mass),
        ("--gravity", request.gravity), ("--g", request.g), ("--wrench", request.wrench),
        ("--criterion", request.criterion), ("--weight", request.weight), ("--length", request.length),
        ("--max-normal", request.max_normal), ("--tolerance", request.tolerance), ("--chunk", request.chunk),
    ]  # fmt: skip
    for flag, value in options:
        if value is not None:
            told = ",".join(map(repr, map(float, value))) if isinstance(value, tuple) else str(value)
            words += [flag, told]
    with Path(request.source).open("rb") as stream:
        digest = hashlib.file_digest(stream, "sha256").hexdigest()
    weight = (1.0 if request.weight is None else request.weight) if request.criterion == "robust" else None
    model = {"kind": kind}
    if isinstance(source, GraspFile):
        model = source.metadata["model"]
    return {
        "contacts": {"name": request.source, "sha256": digest},
        "row": row,
        "status": request.status,
        "centre_of_mass": com.tolist(),
        "model": model,
        "fingers": source.fingers,
        "dimension": dimension,
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
        **provenance(words),
    }
