"""One grasp in a file (.npz), bit for bit: what reproduces a lane in a bug report.

The arrays of the file are ``position``, ``normal``, ``friction`` (mu), ``torsion`` (gamma, m) and ``active`` as the
grasp holds them, and ``header``: JSON in bytes with ``format``, ``version`` and ``model``, the class of the contacts.
"""

from __future__ import annotations

import json
import os
import zlib
from collections.abc import Iterator
from pathlib import Path
from zipfile import BadZipFile

import numpy as np

from ..contacts import MODELS, Grasp, contact_model, model_name
from ..core import Status, UserError
from .parquet import Contacts

__all__ = ["SavedGrasps", "load_grasp", "save_grasp"]

FORMAT, VERSION = "jaxgrasp lane", 1
CLASSES = {kind.__name__: name for name, kind in MODELS.items()}


def save_grasp(grasp: Grasp, path: str | os.PathLike) -> None:
    """Write one grasp to ``path`` (.npz), bit for bit, for a bug report; ``load_grasp`` reads it back.

    Index the batch for the failing lane: ``save_grasp(grasps[17], "lane.npz")``. The file holds arrays and JSON, no
    code; it is written beside and renamed.
    """
    path = Path(path)
    model = type(grasp.model).__name__
    if model not in CLASSES:
        raise ValueError(f"cannot save the contact model {model}; known models: {', '.join(sorted(CLASSES))}")
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
        model = contact_model(CLASSES[header["model"]], arrays["friction"], arrays["torsion"])
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


class SavedGrasps:
    """A file that ``save_grasp`` wrote, read like a table of grasps: a row, or as many as the grasp has lanes.

    ``fingers``, ``dimension``, ``rows`` and ``kind``, the contact model's name in ``contacts.MODELS``; the origin is
    the ``centre_of_mass``; ``about``: metadata that files computed from this one take over. Enable 64-bit arrays before
    reading a float64 grasp.
    """

    def __init__(self, path: Path):
        try:
            grasp = load_grasp(path)
        except ValueError as error:
            raise UserError(str(error)) from error
        self.path, self.kind = path, model_name(grasp.model)
        self.fingers, self.dimension = k, d = grasp.contacts, grasp.dimension
        position = np.asarray(grasp.position, np.float64).reshape(-1, k, d)
        self.rows = len(position)
        self.centre_of_mass, self.about = np.zeros(d), {"model": {"kind": self.kind}}
        self._contacts = Contacts(
            np.arange(self.rows),
            position,
            np.asarray(grasp.normal, np.float64).reshape(-1, k, d),
            np.asarray(grasp.model.friction_coefficient, np.float64).reshape(-1, k),
            np.asarray(grasp.model.torsion_coefficient, np.float64).reshape(-1, k),
            np.asarray(grasp.active).reshape(-1, k),
        )

    def row(self, number: int) -> Contacts:
        """The contacts of row ``number``, from 0."""
        if not 0 <= number < self.rows:
            raise UserError(f"{self.path} has rows 0 to {self.rows - 1}, there is no row {number}")
        return self._contacts.taken(slice(number, number + 1))

    def count(self, status: Status | None) -> int:
        """All rows; such a file holds no verdicts to choose by."""
        if status is not None:
            raise UserError(f"{self.path} holds no verdicts; leave --status out")
        return self.rows

    def selected(self, size: int, status: Status | None = None) -> Iterator[tuple[np.ndarray, Contacts]]:
        """Row numbers and contacts, ``size`` at a time."""
        for start in range(0, self.rows, size):
            part = self._contacts.taken(slice(start, start + size))
            yield part.grasp_id, part
