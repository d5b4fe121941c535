"""``jaxgrasp place``: contacts of many random grasps of one object moved by gradients, the best ones to a file.

The file has the columns of ``formats.parquet``, best grasp first, with the number of its start as ``grasp_id``, and two
more:

    objective      float64   what was maximised (metadata: ``objective``), at these contacts
    margin_before  float64   margin of the random grasp that the row began as, the best of ``candidates``

Only RESISTANT grasps within the requirements are written.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pyarrow as pa

from ..backend import precision
from ..contacts import contact_model
from ..core import Status, UserError, claimed
from ..formats import Contacts, Verdicts, read_row, verdict_schema, verdict_table, write
from ..placement import FLOOR, Placement, PlacementProgress, Search, place_contacts
from ..report import Verdict, draw
from ..surfaces import MeshSurface
from .place_request import OBJECTIVES, PlacePlan

__all__ = ["Placed", "draw_best", "place"]

EXTRA = (("objective", pa.float64()), ("margin_before", pa.float64()))

# What the user reads while it happens.
PHASES = {
    "margin": "climbing the margin",
    "epsilonfloor": "climbing a bound of epsilon",
    "epsilon": "climbing epsilon",
    "settling": "settling on the mesh",
}


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


def place(plan: PlacePlan, progress: Callable[[str, int, str], None] | None = None) -> Placed:
    """Place the contacts and write the grasps that hold to ``plan.output``.

    progress  called with what is being done, starts finished so far, and a word about them

    Raises UserError where no start ends in a grasp that holds within the requirements, where the grid cannot resolve
    the object, and where the file cannot be written. However it ends, no half-written file is left.
    """
    tell, started = progress or (lambda *_: None), time.perf_counter()
    request, contact = plan.request, plan.contact

    def climbed(so_far: PlacementProgress) -> None:
        doing = PHASES.get(so_far.phase, so_far.phase)
        tell(doing, so_far.done, f"best {so_far.best:.4g}" if np.isfinite(so_far.best) else "")

    tell("measuring the object", 0, "")
    with claimed(plan.output), precision("float64"):
        surface = MeshSurface.from_body(plan.body, resolution=request.resolution)
        tell("screening", 0, "compiling")
        found = place_contacts(
            surface,
            fingers=request.fingers,
            model=contact_model(contact.kind, contact.friction, contact.torsion),
            objective=OBJECTIVES[request.objective](float(surface.radius)),
            requirements=plan.requirements,
            search=Search(request.starts, request.steps, request.candidates, seed=request.seed),
            best=request.best,
            progress=climbed,
        )
        kept = np.flatnonzero(np.asarray(found.verdict.status) == Status.RESISTANT)
        if not len(kept):
            raise UserError(_why_none(plan, found))
        _write(plan, found, kept)
    return Placed(found, kept, int(found.proved[kept].sum()), surface.warnings, time.perf_counter() - started)


def draw_best(plan: PlacePlan) -> None:
    """Draw the first grasp of the file that ``place`` wrote, where the request names a picture."""
    if plan.request.picture is not None:
        draw(Verdict.from_row(*read_row(plan.output, 0)), plan.request.picture, plan.body.mesh)


def _why_none(plan: PlacePlan, found: Placement) -> str:
    if not len(found.value):
        return (
            "no start ended within the requirements: ask for less distance or clearance, or for more --starts"
        )
    starts = plan.request.starts
    return f"none of {starts} starts ended in a grasp that holds; take more --fingers, --friction or --starts"


def _write(plan: PlacePlan, found: Placement, kept: np.ndarray) -> None:
    shape = (len(kept), plan.request.fingers)
    normal = np.asarray(found.grasp.normal)[kept]
    coefficient = (
        np.full(shape, plan.contact.friction),
        np.full(shape, plan.contact.torsion),
        np.ones(shape, bool),
    )
    contacts = Contacts(found.start[kept], found.position[kept], normal, *coefficient)
    verdicts = Verdicts.of(found.verdict, kept)
    plain = verdict_schema(plan.request.fingers, "float64", plan.metadata)
    kind, rows = plain, verdict_table(contacts, verdicts, plain)
    before = found.before[found.start[kept]]
    values = (pa.array(found.value[kept]), pa.array(before, mask=before <= FLOOR))
    for (name, real), column in zip(EXTRA, values, strict=True):
        kind, rows = kind.append(pa.field(name, real)), rows.append_column(name, column.cast(real))
    try:
        write(plan.output, [rows], kind)
    except OSError as error:
        raise UserError(f"cannot write {plan.output}: {error.strerror or error}") from error
