"""A run: everything a screening needs, put together from a request and checked before any work."""

from __future__ import annotations

import hashlib
import platform
import shlex
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import jax
import numpy as np

from ..contacts import MODELS, ContactModel
from ..core import UserError, __version__
from ..formats import ContactFile, Contacts
from ..objects import BLOCK, METRES_PER, OBJECTS, AntipodalSampler, SurfaceSampler, load_mesh

__all__ = ["Request", "Run", "coefficients", "prepare_screen", "provenance"]

SAMPLERS = ("auto", "surface", "antipodal")


@dataclass(frozen=True)
class Request:
    """What the user asked for; None means not said.

    source    a mesh file, a built-in object, or a Parquet file of contacts
    friction  mu; torsion is gamma in m; com in m, mesh frame; tolerance of the margin's gap
    """

    source: str
    output: Path | None = None
    fingers: int | None = None
    model: str | None = None
    friction: float | None = None
    torsion: float | None = None
    samples: int | None = None
    seed: int = 0
    unit: str = "m"
    com: tuple[float, ...] | None = None
    dtype: str = "float64"
    tolerance: float = 1e-8
    verdict_only: bool = False
    sampler: str = "auto"
    filter: bool = False
    chunk: int = 65536
    threads: int = 1


@dataclass(frozen=True)
class Run:
    """A checked request. ``metadata`` is what identifies the run and goes into the file."""

    output: Path
    candidates: int
    fingers: int
    kind: str
    friction: float
    torsion: float
    centre_of_mass: np.ndarray
    dtype: str
    tolerance: float
    verdict_only: bool
    filter: bool
    chunk: int
    threads: int
    metadata: dict[str, Any]
    warnings: tuple[str, ...]
    source: SurfaceSampler | AntipodalSampler | ContactFile
    override: frozenset[str] = field(
        default_factory=frozenset
    )  # coefficients that beat those in a contact file

    def chunks(self) -> Iterator[tuple[int, int, Callable[[], Contacts]]]:
        """First and last + 1 candidate of each chunk, and what loads it: call it in a worker."""
        if isinstance(self.source, ContactFile):
            start = 0
            for contacts in self.source.chunks(self.chunk):
                yield start, start + len(contacts), lambda contacts=contacts: contacts
                start += len(contacts)
            return
        for start in range(0, self.candidates, self.chunk):
            stop = min(start + self.chunk, self.candidates)
            yield start, stop, lambda start=start, stop=stop: self._sampled(start, stop)

    def _sampled(self, start: int, stop: int) -> Contacts:
        assert not isinstance(self.source, ContactFile)
        position, normal = self.source.rows(start, stop)
        return Contacts(np.arange(start, stop), position, normal)

    def coefficients(self, contacts: Contacts) -> tuple[np.ndarray, np.ndarray]:
        """mu and gamma (n, k): the file's where it has them, unless the user said otherwise."""
        shape = contacts.position.shape[:2]
        friction, torsion = np.full(shape, self.friction), np.full(shape, self.torsion)
        if contacts.friction is not None and self.kind != "frictionless" and "friction" not in self.override:
            friction = contacts.friction
        if contacts.torsion is not None and self.kind == "soft" and "torsion" not in self.override:
            torsion = contacts.torsion
        return friction, torsion

    @property
    def model(self) -> ContactModel:
        """The contact model, with no coefficients of its own yet."""
        return MODELS[self.kind]()


def coefficients(kind: str, friction: float | None, torsion: float | None) -> tuple[float, float]:
    """mu and gamma of the model of this name; 0.5 and 0.01 m where not said, 0 where the model has none."""
    if kind not in MODELS:
        raise UserError(f"unknown model {kind!r}; take one of {', '.join(MODELS)}")
    for name, value in (("friction", friction), ("torsion", torsion)):
        if value is not None and not (np.isfinite(value) and value >= 0):
            raise UserError(f"--{name} must be a number >= 0, got {value}")
    if kind == "frictionless" and friction is not None:
        raise UserError("a frictionless contact has no friction; leave --friction out or take --model hard")
    if kind != "soft" and torsion is not None:
        raise UserError(f"a {kind} contact has no torsion; leave --torsion out or take --model soft")
    mu = 0.0 if kind == "frictionless" else 0.5 if friction is None else float(friction)
    gamma = 0.0 if kind != "soft" else 0.01 if torsion is None else float(torsion)
    return mu, gamma


def provenance(words: list[str]) -> dict[str, Any]:
    """What a file says about its making: the command, the backend, the versions."""
    return {
        "command": shlex.join(words),
        "backend": jax.default_backend(),
        "versions": {
            "jaxgrasp": __version__,
            "jax": jax.__version__,
            "numpy": np.__version__,
            "python": platform.python_version(),
        },
    }


def prepare_screen(request: Request) -> Run:
    """Check the request, read its object, make the sampler. UserError: one line saying what to do."""
    if request.dtype not in ("float64", "float32"):
        raise UserError(f"unknown dtype {request.dtype!r}; take float64 or float32")
    if request.unit not in METRES_PER:
        raise UserError(f"unknown unit {request.unit!r}; take one of {', '.join(METRES_PER)}")
    if request.sampler not in SAMPLERS:
        raise UserError(f"unknown sampler {request.sampler!r}; take one of {', '.join(SAMPLERS)}")
    for name, value in (("fingers", request.fingers), ("samples", request.samples), ("chunk", request.chunk)):
        if value is not None and value < 1:
            raise UserError(f"--{name} must be at least 1, got {value}")
    if request.seed < 0:
        raise UserError(f"--seed must not be negative, got {request.seed}")
    if not (np.isfinite(request.tolerance) and request.tolerance > 0):
        raise UserError(f"--tolerance must be a number > 0, got {request.tolerance}")
    com = request.com
    if com is not None and (len(com) != 3 or not np.isfinite(com).all()):
        raise UserError(f"--com must be three finite numbers x,y,z in m, got {','.join(map(str, com))}")
    coefficients(request.model or "hard", None, None)
    if _is_parquet(request.source):
        return _from_contacts(request)
    return _from_mesh(request)


def _is_parquet(source: str) -> bool:
    if source in OBJECTS:
        return False
    path = Path(source)
    if path.suffix.lower() in (".parquet", ".pq"):
        return True
    try:
        with path.open("rb") as stream:
            return stream.read(4) == b"PAR1"
    except OSError:
        return False


def _from_mesh(request: Request) -> Run:
    kind = request.model or "hard"
    friction, torsion = coefficients(kind, request.friction, request.torsion)
    fingers = 4 if request.fingers is None else request.fingers
    pairs = request.sampler == "antipodal" or (request.sampler == "auto" and kind == "soft" and fingers == 2)
    if pairs and fingers != 2:
        raise UserError(f"antipodal pairs have two contacts; take --fingers 2, not {fingers}")
    body = load_mesh(request.source, unit=request.unit, com=request.com)
    source: SurfaceSampler | AntipodalSampler
    if pairs:
        source = AntipodalSampler(body.mesh, friction=friction, seed=request.seed)
    else:
        source = SurfaceSampler(body.mesh, fingers=fingers, seed=request.seed)
    samples = 100_000 if request.samples is None else request.samples
    about = {
        "object": {"name": body.name, "sha256": body.sha256},
        "sampler": "antipodal" if pairs else "surface",
        "sampler_block": BLOCK,
        "samples": samples,
        "seed": request.seed,
    }
    model = (kind, friction, torsion)
    return _run(
        request, source, samples, fingers, model, body.centre_of_mass, body.unit, about, body.warnings
    )


def _from_contacts(request: Request) -> Run:
    path = Path(request.source)
    for name, value in (("samples", request.samples), ("fingers", request.fingers)):
        if value is not None:
            raise UserError(f"--{name} is for sampling; the contacts come from {path}")
    if request.sampler != "auto":
        raise UserError(f"--sampler is for sampling; the contacts come from {path}")
    if request.unit != "m":
        raise UserError(f"a Parquet file of contacts is in metres; leave --unit {request.unit} out")
    source = ContactFile(path)
    known = source.metadata
    com = request.com if request.com is not None else known.get("centre_of_mass")
    if com is None:
        raise UserError(f"{path} does not say where the centre of mass is; give --com x,y,z in m, mesh frame")
    told = known.get("model") or {}
    kind = request.model or told.get("kind", "hard")
    said = {"friction": request.friction, "torsion": request.torsion}
    model = (kind, *coefficients(kind, said["friction"], said["torsion"]))
    with path.open("rb") as stream:
        digest = hashlib.file_digest(stream, "sha256").hexdigest()
    about = {
        "object": known.get("object"),
        "contacts": {"name": request.source, "sha256": digest},
        "samples": source.rows,
        "seed": known.get("seed"),
    }
    override = frozenset(name for name, value in said.items() if value is not None)
    centre = np.asarray(com, np.float64)
    return _run(
        request,
        source,
        source.rows,
        source.fingers,
        model,
        centre,
        known.get("unit", "m"),
        about,
        (),
        override,
    )


def _run(
    request: Request, source, samples, fingers, model, com, unit, about, warnings, override=frozenset()
) -> Run:
    kind, friction, torsion = model
    words = ["jaxgrasp", "screen", request.source, "--model", kind]
    sampled = not isinstance(source, ContactFile)
    options: list[tuple[str, object]] = [
        ("--fingers", fingers if sampled else None),
        ("--friction", friction if kind != "frictionless" and (sampled or "friction" in override) else None),
        ("--torsion", torsion if kind == "soft" and (sampled or "torsion" in override) else None),
        ("--samples", samples if sampled else None),
        ("--seed", request.seed if sampled else None),
        ("--sampler", about.get("sampler")),
        ("--unit", unit if sampled else None),
        ("--com", ",".join(map(repr, map(float, request.com))) if request.com is not None else None),
        ("--dtype", request.dtype),
        ("--tolerance", request.tolerance),
        ("--chunk", request.chunk),
    ]
    for flag, value in options:
        if value is not None:
            words += [flag, str(value)]
    words += ["--verdict-only"] * request.verdict_only + ["--filter"] * request.filter
    metadata = {
        **about,
        "unit": unit,
        "centre_of_mass": [float(x) for x in com],
        "model": {"kind": kind, "friction": friction, "torsion": torsion},
        "fingers": fingers,
        "dtype": request.dtype,
        "tolerance": request.tolerance,
        "verdict_only": request.verdict_only,
        "filter": request.filter,
        **provenance(words),
    }
    name = Path(request.source).name.removesuffix(".gz")
    stem = name if request.source in OBJECTS else Path(name).stem
    return Run(
        output=request.output or Path(f"{stem}.grasps.parquet" if sampled else f"{stem}.verdicts.parquet"),
        candidates=samples,
        fingers=fingers,
        kind=kind,
        friction=friction,
        torsion=torsion,
        centre_of_mass=np.asarray(com, np.float64),
        dtype=request.dtype,
        tolerance=request.tolerance,
        verdict_only=request.verdict_only,
        filter=request.filter,
        chunk=request.chunk,
        threads=request.threads,
        metadata=metadata,
        warnings=tuple(warnings),
        source=source,
        override=override,
    )
