"""The verdicts of a Parquet file with their evidence, chunk by chunk: what a proof is made of."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace

from ..core import UserError
from .contact_file import GraspFile
from .lists import dense
from .parquet import LATER, VERDICT_COLUMNS, Contacts, batches, open_parquet, require

__all__ = ["StoredVerdicts"]


@dataclass
class StoredVerdicts:
    """A file that ``jaxgrasp screen`` or ``jaxgrasp place`` wrote. UserError where it cannot be proved from."""

    path: Path

    def __post_init__(self):
        self.file = GraspFile(self.path)
        if "load" in self.file.metadata:
            raise UserError(
                f"{self.path} holds forces; jaxgrasp forces proves each row as it writes it, and jaxgrasp explain again"
            )
        if "centre_of_mass" not in self.file.metadata or not self.file.kind:
            raise UserError(f"{self.path} does not say its centre of mass and contact model; screen it first")
        with open_parquet(self.path) as file:
            if LATER not in file.schema_arrow.names and "status" in file.schema_arrow.names:
                raise UserError(
                    f"{self.path} was written by version 0.1, without the evidence of its upper bounds; screen it again"
                )
            require(self.path, file, (*VERDICT_COLUMNS, LATER))

    @property
    def rows(self) -> int:
        """How many there are."""
        return self.file.rows

    def chunks(self, size: int) -> Iterator[tuple[Contacts, SimpleNamespace]]:
        """Contacts and answers in the order of the rows; a list that is null is all NaN."""
        with open_parquet(self.path) as file:
            answers = batches(self.path, file, size, [*VERDICT_COLUMNS, LATER])
            for contacts, batch in zip(self.file.chunks(size), answers, strict=True):
                columns = {name: dense(batch.column(name), name) for name in (*VERDICT_COLUMNS, LATER)}
                yield contacts, SimpleNamespace(lower=columns.pop("margin"), **columns)
