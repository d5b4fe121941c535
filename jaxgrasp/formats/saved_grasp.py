"""A file that ``jaxgrasp.save_grasp`` wrote (.npz), read like a table of grasps: a row, or as many as it has."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from ..core import Status, UserError
from .grasp_npz import load_grasp
from .parquet import Contacts

__all__ = ["SavedGrasps"]


class SavedGrasps:
    """``fingers``, ``dimension``, ``rows`` and the contact ``model`` of the file; the origin is the centre of mass.

    Enable 64-bit arrays before reading a float64 grasp.
    """

    def __init__(self, path: Path):
        try:
            grasp = load_grasp(path)
        except ValueError as error:
            raise UserError(str(error)) from error
        self.path, self.model = path, grasp.model
        self.fingers, self.dimension = k, d = grasp.contacts, grasp.dimension
        position = np.asarray(grasp.position, np.float64).reshape(-1, k, d)
        self.rows = len(position)
        self._contacts = Contacts(
            np.arange(self.rows),
            position,
            np.asarray(grasp.normal, np.float64).reshape(-1, k, d),
            np.asarray(grasp.model.friction_coefficient, np.float64).reshape(-1, k),
            np.asarray(grasp.model.torsion_coefficient, np.float64).reshape(-1, k),
            np.asarray(grasp.active).reshape(-1, k),
        )

    def _slice(self, start: int, stop: int) -> Contacts:
        return Contacts(
            *(getattr(self._contacts, name)[start:stop] for name in Contacts.__dataclass_fields__)
        )

    def row(self, number: int) -> Contacts:
        """The contacts of row ``number``, from 0."""
        if not 0 <= number < self.rows:
            raise UserError(f"{self.path} has rows 0 to {self.rows - 1}, there is no row {number}")
        return self._slice(number, number + 1)

    def count(self, status: Status | None) -> int:
        """All rows; such a file holds no verdicts to choose by."""
        if status is not None:
            raise UserError(f"{self.path} holds no verdicts; leave --status out")
        return self.rows

    def selected(self, size: int, status: Status | None = None) -> Iterator[tuple[np.ndarray, Contacts]]:
        """Row numbers and contacts, ``size`` at a time."""
        for start in range(0, self.rows, size):
            part = self._slice(start, start + size)
            yield part.grasp_id, part
