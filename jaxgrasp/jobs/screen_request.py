"""A screening: what was asked for, checked before any work, and where its candidates come from."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..contacts import MODELS
from ..core import UserError, open_file
from ..formats import ContactFile, Contacts
from ..objects import BLOCK, METRES_PER, OBJECTS, AntipodalSampler, SurfaceSampler, load_mesh
from .outputs import default_output
from .provenance import digest, provenance
from .threads import thread_count

__all__ = ["Candidates", "Chunk", "ContactChoice", "ScreenPlan", "ScreenRequest", "plan_screen"]

SAMPLERS = ("auto", "surface", "antipodal")


@dataclass(frozen=True)
class ScreenRequest:
    """What the user asked for; None means not said.

    source    a mesh file, a built-in object, or a Parquet file of contacts
    friction  mu; torsion is gamma in m; com in m, mesh frame; tolerance of the margin's bracket
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
    threads: int | None = None


@dataclass(frozen=True)
class ContactChoice:
    """The contact model of a run: ``kind``, its name in ``contacts.MODELS``; mu and gamma in m, 0 where it has none.

    said  the coefficients that the user gave, which beat those in a file of contacts
    """

    kind: str
    friction: float
    torsion: float
    said: frozenset[str]

    @classmethod
    def of(cls, kind: str, friction: float | None, torsion: float | None) -> ContactChoice:
        """mu = 0.5 and gamma = 0.01 m where None and the model has them. UserError where they do not fit it."""
        if kind not in MODELS:
            raise UserError(f"unknown model {kind!r}; take one of {', '.join(MODELS)}")
        given = {"friction": friction, "torsion": torsion}
        for name, value in given.items():
            if value is not None and not (np.isfinite(value) and value >= 0):
                raise UserError(f"--{name} must be a number >= 0, got {value}")
        if kind == "frictionless" and friction is not None:
            raise UserError(
                "a frictionless contact has no friction; leave --friction out or take --model hard"
            )
        if kind != "soft" and torsion is not None:
            raise UserError(f"a {kind} contact has no torsion; leave --torsion out or take --model soft")
        mu = 0.0 if kind == "frictionless" else 0.5 if friction is None else float(friction)
        gamma = 0.0 if kind != "soft" else 0.01 if torsion is None else float(torsion)
        return cls(kind, mu, gamma, frozenset(name for name, value in given.items() if value is not None))

    @property
    def metadata(self) -> dict[str, Any]:
        """``model`` of the file's metadata."""
        return {"kind": self.kind, "friction": self.friction, "torsion": self.torsion}

    def coefficients(self, contacts: Contacts) -> tuple[np.ndarray, np.ndarray]:
        """mu and gamma (n, k): the file's where it has them, unless the user said otherwise."""
        shape = contacts.position.shape[:2]
        friction, torsion = np.full(shape, self.friction), np.full(shape, self.torsion)
        if contacts.friction is not None and self.kind != "frictionless" and "friction" not in self.said:
            friction = contacts.friction
        if contacts.torsion is not None and self.kind == "soft" and "torsion" not in self.said:
            torsion = contacts.torsion
        return friction, torsion


@dataclass(frozen=True)
class Chunk:
    """Candidates ``start`` to ``stop - 1``; ``load`` reads or samples them: call it in a worker."""

    number: int
    start: int
    stop: int
    load: Callable[[], Contacts]


@dataclass(frozen=True)
class Candidates:
    """Where the grasps come from: sampled on a mesh, or read from a file of contacts.

    unit            of the mesh file's numbers; centre_of_mass in m, mesh frame
    metadata        what the file says about all this
    """

    source: SurfaceSampler | AntipodalSampler | ContactFile
    count: int
    fingers: int
    unit: str
    centre_of_mass: np.ndarray
    metadata: dict[str, Any]
    warnings: tuple[str, ...] = ()

    @property
    def sampled(self) -> bool:
        """Not read from a file of contacts."""
        return not isinstance(self.source, ContactFile)

    def chunks(self, size: int) -> Iterator[Chunk]:
        """All of them in order, ``size`` at a time."""
        if isinstance(self.source, ContactFile):
            start = 0
            for number, contacts in enumerate(self.source.chunks(size)):
                yield Chunk(number, start, start + len(contacts), lambda contacts=contacts: contacts)
                start += len(contacts)
            return
        for number, start in enumerate(range(0, self.count, size)):
            stop = min(start + size, self.count)
            yield Chunk(number, start, stop, lambda start=start, stop=stop: self._sampled(start, stop))

    def _sampled(self, start: int, stop: int) -> Contacts:
        assert not isinstance(self.source, ContactFile)
        position, normal = self.source.rows(start, stop)
        return Contacts(np.arange(start, stop), position, normal)


@dataclass(frozen=True)
class ScreenPlan:
    """A checked request. ``metadata`` is what identifies the run and goes into the file."""

    request: ScreenRequest
    contact: ContactChoice
    candidates: Candidates
    output: Path
    metadata: dict[str, Any]

    @property
    def threads(self) -> int:
        """Chunks worked on at a time."""
        return thread_count(self.request.threads)

    def chunks(self) -> Iterator[Chunk]:
        """All candidates in order, ``request.chunk`` at a time."""
        return self.candidates.chunks(self.request.chunk)


def plan_screen(request: ScreenRequest) -> ScreenPlan:
    """Check the request, read its object, make the sampler. UserError: one line saying what to do."""
    _check(request)
    from_file = _is_parquet(request.source)
    contact, candidates = _from_contacts(request) if from_file else _from_mesh(request)
    output = request.output or default_output(
        request.source, "verdicts.parquet" if from_file else "grasps.parquet"
    )
    return ScreenPlan(request, contact, candidates, output, _metadata(request, contact, candidates))


def _check(request: ScreenRequest) -> None:
    if request.threads is not None and request.threads < 1:
        raise UserError(f"--threads must be at least 1, got {request.threads}")
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
    ContactChoice.of(request.model or "hard", None, None)


def _is_parquet(source: str) -> bool:
    if source in OBJECTS:
        return False
    path = Path(source)
    if path.suffix.lower() in (".parquet", ".pq"):
        return True
    try:
        with open_file(path, sys.maxsize) as stream:
            return stream.read(4) == b"PAR1"
    except (UserError, OSError):
        return False


def _from_mesh(request: ScreenRequest) -> tuple[ContactChoice, Candidates]:
    contact = ContactChoice.of(request.model or "hard", request.friction, request.torsion)
    fingers = 4 if request.fingers is None else request.fingers
    two_soft = contact.kind == "soft" and fingers == 2
    pairs = request.sampler == "antipodal" or (request.sampler == "auto" and two_soft)
    if pairs and fingers != 2:
        raise UserError(f"antipodal pairs have two contacts; take --fingers 2, not {fingers}")
    body = load_mesh(request.source, unit=request.unit, com=request.com)
    source: SurfaceSampler | AntipodalSampler
    if pairs:
        source = AntipodalSampler(body.mesh, friction=contact.friction, seed=request.seed)
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
    centre = np.asarray(body.centre_of_mass, np.float64)
    return contact, Candidates(source, samples, fingers, body.unit, centre, about, tuple(body.warnings))


def _from_contacts(request: ScreenRequest) -> tuple[ContactChoice, Candidates]:
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
    contact = ContactChoice.of(request.model or source.kind or "hard", request.friction, request.torsion)
    about = {
        "object": known.get("object"),
        "contacts": {"name": request.source, "sha256": digest(request.source)},
        "samples": source.rows,
        "seed": known.get("seed"),
    }
    unit, centre = known.get("unit", "m"), np.asarray(com, np.float64)
    return contact, Candidates(source, source.rows, source.fingers, unit, centre, about)


def _metadata(request: ScreenRequest, contact: ContactChoice, candidates: Candidates) -> dict[str, Any]:
    sampled = candidates.sampled

    def told(name: str, exists: bool) -> float | None:
        """A coefficient that the contacts have and that was not read from the file."""
        return contact.metadata[name] if exists and (sampled or name in contact.said) else None

    options = {
        "model": contact.kind,
        "fingers": candidates.fingers if sampled else None,
        "friction": told("friction", contact.kind != "frictionless"),
        "torsion": told("torsion", contact.kind == "soft"),
        "samples": candidates.count if sampled else None,
        "seed": request.seed if sampled else None,
        "sampler": candidates.metadata.get("sampler"),
        "unit": candidates.unit if sampled else None,
        "com": request.com,
        "dtype": request.dtype,
        "tolerance": request.tolerance,
        "chunk": request.chunk,
        "verdict_only": request.verdict_only,
        "filter": request.filter,
    }
    return {
        **candidates.metadata,
        "unit": candidates.unit,
        "centre_of_mass": candidates.centre_of_mass.tolist(),
        "model": contact.metadata,
        "fingers": candidates.fingers,
        "dtype": request.dtype,
        "tolerance": request.tolerance,
        "verdict_only": request.verdict_only,
        "filter": request.filter,
        **provenance("screen", request.source, options),
    }
