"""A placement: what was asked for, checked before any work."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..core import UserError
from ..objects import Body, load_mesh
from ..placement import CANDIDATES, Apart, EdgeClearance, Epsilon, JawWidth, Margin, Objective, Requirement
from .outputs import default_output, not_the_source, writable
from .provenance import provenance
from .screen_request import ContactChoice

__all__ = ["OBJECTIVES", "PlacePlan", "PlaceRequest", "plan_place"]

PICTURES = (".png", ".svg", ".pdf")
DISTANCES = {"apart": Apart, "edge_clearance": EdgeClearance, "jaw_width": JawWidth}

# What --objective names, for an object of a radius in m.
OBJECTIVES: dict[str, Callable[[float], Objective]] = {
    "margin": lambda radius: Margin(),
    "epsilon": lambda radius: Epsilon("L1", radius),
    "epsilon-linf": lambda radius: Epsilon("Linf", radius),
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
class PlacePlan:
    """A checked request. ``metadata`` identify the run and go into the file."""

    request: PlaceRequest
    body: Body
    contact: ContactChoice
    requirements: tuple[Requirement, ...]
    output: Path
    metadata: dict[str, Any]


def plan_place(request: PlaceRequest) -> PlacePlan:
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
    requirements = _requirements(request)
    contact = ContactChoice.of(request.model, request.friction, request.torsion)
    _enough_fingers(request.fingers, contact)
    body = load_mesh(request.source, unit=request.unit)
    output = request.output or default_output(request.source, "placed.parquet")
    not_the_source(output, request.source)
    writable(output)
    if request.picture is not None:
        _drawable(request.picture, output)
    return PlacePlan(request, body, contact, requirements, output, _metadata(request, body, contact))


def _requirements(request: PlaceRequest) -> tuple[Requirement, ...]:
    asked: list[Requirement] = []
    for name, kind in DISTANCES.items():
        distance = getattr(request, name)
        if distance is None:
            continue
        if not (np.isfinite(distance) and distance > 0):
            raise UserError(f"--{name.replace('_', '-')} must be a number of m > 0, got {distance}")
        asked.append(kind(float(distance)))
    return tuple(asked)


def _enough_fingers(fingers: int, contact: ContactChoice) -> None:
    """Six balances leave an internal force only among 7 force components; two points have a line no finger stops."""
    components = 1 + 2 * (contact.friction > 0) + (contact.torsion > 0)
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


def _metadata(request: PlaceRequest, body: Body, contact: ContactChoice) -> dict[str, Any]:
    names = ("objective", "starts", "candidates", "steps", *DISTANCES, "best", "seed", "resolution")
    options: dict[str, Any] = {
        "unit": body.unit,
        "fingers": request.fingers,
        "model": request.model,
        "friction": contact.friction if request.model != "frictionless" else None,
        "torsion": contact.torsion if request.model == "soft" else None,
        **{name: getattr(request, name) for name in names},
    }
    return {
        **options,
        "object": {"name": body.name, "sha256": body.sha256},
        "centre_of_mass": [float(x) for x in body.centre_of_mass],
        "model": contact.metadata,
        "dtype": "float64",
        "tolerance": 1e-8,
        **provenance("place", request.source, options),
    }
