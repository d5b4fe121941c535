"""Proofs of a file of verdicts: each row's evidence tested without the solver, and written down for others to check."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace

import numpy as np

from ..backend import precision
from ..certificates import Malformed, proof_lines, prove_resistance
from ..contacts import Grasp, component_names, contact_model
from ..core import Status, UserError, claimed
from ..formats import Contacts, StoredVerdicts
from .outputs import derived_output, not_the_source

__all__ = ["ProofSummary", "prove_verdicts"]

CHUNK = 512


@dataclass
class ProofSummary:
    """A run so far: rows done of ``rows``, counts by Status, the first rows that were refused, seconds."""

    rows: int
    output: Path
    done: int = 0
    counts: dict[Status, int] = field(default_factory=dict)
    refused: list[int] = field(default_factory=list)
    silent: int = 0  # rows without a verdict: there is nothing to write down
    seconds: float = 0.0


def prove_verdicts(
    source: Path, output: Path | None = None, progress: Callable[[ProofSummary], None] | None = None
) -> ProofSummary:
    """Prove all rows of ``source``; write a line for each proved verdict to ``output``, by default SOURCE.proofs.jsonl.

    progress  called with the running summary after every chunk

    UserError where the source holds no evidence, or the output cannot be written. However it ends, no half-written file
    is left.
    """
    verdicts = StoredVerdicts(source)
    output = output or derived_output(str(source), "proofs.jsonl")
    not_the_source(output, str(source))
    total, started = ProofSummary(verdicts.rows, output), time.perf_counter()
    with claimed(output), precision("float64"):
        beside = output.with_name(f".{output.name}.{os.getpid()}.tmp")
        try:
            with beside.open("w") as file:
                for start, proof, lines in _proofs(verdicts):
                    _count(total, start, proof, lines)
                    file.writelines(
                        json.dumps({"row": start + i} | line) + "\n" for i, line in enumerate(lines) if line
                    )
                    total.seconds = time.perf_counter() - started
                    if progress:
                        progress(total)
            os.replace(beside, output)
        except OSError as error:
            raise UserError(f"cannot write {output}: {error.strerror or error}") from error
        finally:
            beside.unlink(missing_ok=True)
    return total


def _count(total: ProofSummary, start: int, proof: np.ndarray, lines: list) -> None:
    for value, count in zip(*np.unique(proof, return_counts=True), strict=True):
        word = Status(int(value))
        total.counts[word] = total.counts.get(word, 0) + int(count)
    total.refused += [start + int(i) for i in np.flatnonzero(proof == Status.REFUSED)][
        : 10 - len(total.refused)
    ]
    total.silent += sum(line is None for line in lines) - int((proof == Status.REFUSED).sum())
    total.done += len(proof)


def _proofs(verdicts: StoredVerdicts) -> Iterator[tuple[int, np.ndarray, list]]:
    """(first row, status of each proof, a line or None for each row), chunk by chunk."""
    dtype, start = np.dtype(verdicts.file.metadata.get("dtype", "float64")), 0
    components = len(component_names(verdicts.file.kind, 3))
    for contacts, answer in verdicts.chunks(CHUNK):
        grasp, answer = _grasp(verdicts, contacts, dtype), _answer(contacts, answer, components)
        try:
            proof = prove_resistance(grasp, answer, tolerance=verdicts.file.metadata.get("tolerance"))
            lines = proof_lines(grasp, answer, proof)
        except Malformed as name:
            raise UserError(
                f"{verdicts.path}: the column {name} does not fit these grasps; screen it again"
            ) from name
        yield start, proof.status, lines
        start += len(contacts)


def _grasp(verdicts: StoredVerdicts, contacts: Contacts, dtype: np.dtype) -> Grasp:
    """As the solver saw it."""
    if contacts.friction is None or contacts.torsion is None:
        raise UserError(f"{verdicts.path} lacks the columns friction and torsion; screen it again")
    model = contact_model(verdicts.file.kind, contacts.friction.astype(dtype), contacts.torsion.astype(dtype))
    position = (contacts.position - verdicts.file.centre_of_mass).astype(dtype)
    return Grasp(position, contacts.normal.astype(dtype), model, contacts.active)


def _answer(contacts: Contacts, answer: SimpleNamespace, components: int) -> SimpleNamespace:
    """Nulls as the solver has them: no force is 0, no rank is -1."""
    n, width = len(contacts), contacts.position.shape[1] * components
    for name, size in (("internal_force", width), ("escape_twist", 6), ("bound_twist", 6)):
        values = getattr(answer, name)
        full = np.zeros((n, size)) if values.size == 0 else np.where(np.isnan(values), 0.0, values)
        setattr(answer, name, full)
    answer.rank = np.where(np.isnan(answer.rank), -1, answer.rank)
    return answer
