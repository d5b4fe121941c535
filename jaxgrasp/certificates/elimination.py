"""Exact linear algebra over the integers: fraction-free elimination. Source: Bareiss 1968."""

from __future__ import annotations

from collections.abc import Sequence

__all__ = ["independent", "null_vector", "solve"]

Vector = Sequence[int]


class _Echelon:
    """Rows reduced to ``pivot``s times the identity on the pivot columns, without leaving the integers.

    rows      the first ``len(columns)`` of them are reduced     columns  pivot columns, in the order they were found
    pivot     the common entry of the pivots; a minor of the matrix
    """

    def __init__(self, rows: list[list[int]], order: Sequence[int]):
        self.rows, self.columns, self.pivot = rows, [], 1
        for column in order:
            if len(self.columns) == len(rows):
                break
            self._reduce(column)

    def _reduce(self, column: int) -> None:
        rows, rank = self.rows, len(self.columns)
        found = next((i for i in range(rank, len(rows)) if rows[i][column]), None)
        if found is None:
            return
        rows[rank], rows[found] = rows[found], rows[rank]
        lead, old = rows[rank], self.pivot
        head = lead[column]
        for i, row in enumerate(rows):
            if i != rank:
                factor = row[column]
                rows[i] = [(head * x - factor * y) // old for x, y in zip(row, lead, strict=True)]
        self.columns.append(column)
        self.pivot = head


def solve(columns: Sequence[Vector], right: Vector) -> tuple[list[int], int, int] | None:
    """``sum_j x_j column_j = d * right``: (x, d, rank) with d > 0; None where the system has no solution.

    The first independent columns carry the solution: put the best ones in front. ``rank`` is that of the columns.
    """
    count = len(columns)
    rows = [[*entries, b] for *entries, b in zip(*columns, right, strict=True)]
    echelon = _Echelon(rows, range(count))
    rank = len(echelon.columns)
    if any(row[-1] for row in echelon.rows[rank:]):
        return None
    sign = 1 if echelon.pivot > 0 else -1
    x = [0] * count
    for row, column in zip(echelon.rows, echelon.columns, strict=False):
        x[column] = sign * row[-1]
    return x, sign * echelon.pivot, rank


def independent(columns: Sequence[Vector]) -> bool:
    """Whether no column is a combination of the others."""
    rows = [list(entries) for entries in zip(*columns, strict=True)]
    return len(_Echelon(rows, range(len(columns))).columns) == len(columns)


def null_vector(rows: Sequence[Vector], near: Vector) -> list[int] | None:
    """An integer vector x with ``row . x = 0`` for all rows, parallel to ``near`` where it can be; None for only x = 0.

    The largest entries of ``near`` are free and keep their value; the others follow from them.
    """
    size = len(near)
    order = sorted(range(size), key=lambda j: abs(near[j]))
    echelon = _Echelon([list(row) for row in rows], order)
    free = [j for j in range(size) if j not in echelon.columns]
    if not free:
        return None
    x = [0] * size
    for j in free:
        x[j] = near[j] * echelon.pivot
    for row, column in zip(echelon.rows, echelon.columns, strict=False):
        x[column] = -sum(row[j] * near[j] for j in free)
    return x if any(x) else None
