"""One grasp in a file (.npz), bit for bit: what reproduces a lane in a bug report.

The arrays of the file are ``position``, ``normal``, ``friction`` (mu), ``torsion`` (gamma, m) and ``active`` as the
grasp holds them, and ``header``: JSON in bytes with ``format``, ``version`` and ``model``, the class of the contacts.
"""

from __future__ import annotations

import io
import json
import math
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from zipfile import ZipFile

import numpy as np

from ..contacts import MODELS, Grasp, contact_model, model_name
from ..core import Status, UserError, claimed, open_archive, open_file, read_member
from .parquet import MOST_CONTACTS, Contacts

__all__ = ["SavedGrasps", "load_grasp", "save_grasp"]

FORMAT, VERSION = "jaxgrasp lane", 1
NAMES = ("header", "position", "normal", "friction", "torsion", "active")
MOST_BYTES = 256 << 20  # of all arrays together
HEADER_BYTES = 4096
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
    arrays = {
        "header": np.frombuffer(json.dumps(header).encode(), np.uint8),
        "position": np.asarray(grasp.position),
        "normal": np.asarray(grasp.normal),
        "friction": np.asarray(grasp.model.friction_coefficient),
        "torsion": np.asarray(grasp.model.torsion_coefficient),
        "active": np.asarray(grasp.active),
    }
    if sum(x.nbytes for x in arrays.values()) > MOST_BYTES or grasp.contacts > MOST_CONTACTS:
        raise ValueError("such a file holds one grasp, or a few: index the batch, such as grasps[:1000]")
    beside = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    with claimed(path):
        try:
            with open(beside, "wb") as file:
                np.savez(file, **arrays)
            os.replace(beside, path)
        finally:
            beside.unlink(missing_ok=True)


def load_grasp(path: str | os.PathLike) -> Grasp:
    """The grasp that ``save_grasp`` wrote; ValueError if the file is not one, or holds more than 256 MiB of numbers."""
    with open_file(path, MOST_BYTES + (1 << 20)) as file:
        archive = open_archive(path, file, MOST_BYTES, len(NAMES))
        try:
            known = {name: _array(path, archive, name) for name in NAMES}
            header = json.loads(known["header"].ravel()[:HEADER_BYTES].tobytes().decode())
            if (header["format"], header["version"]) != (FORMAT, VERSION):
                raise ValueError(
                    f"it holds {str(header['format'])[:40]!r} version {str(header['version'])[:40]}"
                )
            model = contact_model(CLASSES[header["model"]], known["friction"], known["torsion"])
            grasp = Grasp(known["position"], known["normal"], model, known["active"])
        except (ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
            reason = (str(error).splitlines() or [""])[0][:200]
            raise ValueError(f"{path} is not a grasp written by jaxgrasp.save_grasp ({reason})") from error
    if grasp.contacts > MOST_CONTACTS:
        raise ValueError(f"{path} has {grasp.contacts} contacts a grasp; at most {MOST_CONTACTS} are read")
    return grasp


def _array(path: Any, archive: ZipFile, name: str) -> np.ndarray:
    """The array of a member; its own header is not believed about how much there is."""
    data = io.BytesIO(read_member(path, archive, f"{name}.npy"))
    version = np.lib.format.read_magic(data)
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    try:
        shape, fortran, dtype = read(data, max_header_size=HEADER_BYTES)
    except Exception as error:  # NumPy reads it as a text of Python's
        raise ValueError(f"the header of {name} is damaged") from error
    left = data.getbuffer()[data.tell() :]
    if dtype.hasobject or len(shape) > 32 or dtype.itemsize * math.prod(shape) != len(left):
        raise ValueError(f"{name} does not hold what its header says")
    return np.frombuffer(left, dtype).reshape(shape, order="F" if fortran else "C")


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
