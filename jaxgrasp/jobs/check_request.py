"""A check in motion: what was asked for, checked before any work; the grasps, and the body that they hold."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..backend import precision
from ..core import UserError
from ..motion import RigidBody
from ..objects import Body, load_mesh
from .outputs import derived_output, not_the_source
from .provenance import command_line
from .screen_request import ScreenPlan, ScreenRequest, plan_screen

__all__ = ["CheckPlan", "CheckRequest", "plan_check"]


@dataclass(frozen=True)
class CheckRequest:
    """What the user asked for; None means not said. Mass in kg; gravity in m/s^2, mesh axes.

    source   a Parquet file of grasps, a mesh file, or a built-in object; for the latter two ``fingers`` to ``unit`` say
             which grasps are sampled (``ScreenRequest``)
    object   the mesh whose inertia counts, if it is not the one the grasps were made on
    most     grasps, the first ones, are checked, ``chunk`` at a time
    """

    source: str
    mass: float
    gravity: tuple[float, ...] = (0.0, 0.0, -9.81)
    most: int = 256
    chunk: int = 256
    fingers: int | None = None
    model: str | None = None
    friction: float | None = None
    torsion: float | None = None
    seed: int = 0
    unit: str = "m"
    object: str | None = None
    output: Path | None = None

    @property
    def grasps(self) -> ScreenRequest:
        """The screening that these grasps would come from."""
        names = ("source", "fingers", "model", "friction", "torsion", "seed", "unit")
        sampled = not self.source.endswith((".parquet", ".pq"))
        return ScreenRequest(
            samples=self.most if sampled else None,
            chunk=min(self.chunk, self.most),
            **{name: getattr(self, name) for name in names},
        )


@dataclass(frozen=True)
class CheckPlan:
    """A checked request: the grasps, the body they hold. ``metadata`` identify the run and go into the file."""

    grasps: ScreenPlan
    body: RigidBody
    gravity: np.ndarray
    count: int
    output: Path
    metadata: dict[str, Any]
    warnings: tuple[str, ...]


def plan_check(request: CheckRequest) -> CheckPlan:
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
    grasps = plan_screen(request.grasps)
    solid = _solid(request, grasps)
    warnings = list(grasps.candidates.warnings)
    offset = solid.centre_of_mass - grasps.candidates.centre_of_mass
    if np.linalg.norm(offset) > 1e-6 * solid.mesh.extents.max():
        warnings.append(
            "the centre of mass is not the mesh's: the inertia is taken as if the mass were uniform"
        )
    with precision("float64"):
        body = RigidBody.from_mesh(solid.mesh, mass=request.mass)
    output = request.output or derived_output(request.source, "check.parquet")
    not_the_source(output, request.source)
    count = min(grasps.candidates.count, request.most)
    about = {
        "command": _command(request, grasps),
        "mass": request.mass,
        "gravity": gravity.tolist(),
        "inertia": {"name": solid.name, "sha256": solid.sha256},
        "checked": count,
        "chunk": grasps.request.chunk,
    }
    return CheckPlan(grasps, body, gravity, count, output, grasps.metadata | about, tuple(warnings))


def _solid(request: CheckRequest, grasps: ScreenPlan) -> Body:
    """The mesh whose inertia counts."""
    name = request.object or (grasps.metadata.get("object") or {}).get("name")
    if name is None:
        raise UserError("the file does not name its object, whose inertia is needed: --object names a mesh")
    solid = load_mesh(name, unit=grasps.metadata.get("unit", "m"))
    if not solid.watertight or not solid.mesh.volume > 0:
        raise UserError(
            f"{name} encloses no volume, so its inertia is unknown; repair it or name another --object"
        )
    return solid


def _command(request: CheckRequest, grasps: ScreenPlan) -> str:
    """What to type for this very run."""
    options = {name: getattr(request, name) for name in ("mass", "gravity", "most")}
    options["chunk"] = grasps.request.chunk
    options |= {name: getattr(request, name) for name in ("fingers", "model", "friction", "torsion")}
    sampled = "sampler" in grasps.metadata
    options |= {name: grasps.metadata[name] if sampled else None for name in ("seed", "unit")}
    return command_line("check", request.source, {**options, "object": request.object})
