"""The LAPACK calls of a traced program."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import jax

LAPACK = {
    "cholesky", "cholesky_update", "eig", "eigh", "geqp3", "geqrf", "hessenberg", "householder_product", "lu", "qr",
    "schur", "svd", "triangular_solve", "tridiagonal", "tridiagonal_solve",
}  # fmt: skip


def _inner(equation: Any) -> Iterator[Any]:
    """The programs inside an equation."""
    for value in equation.params.values():
        for part in value if isinstance(value, tuple | list) else (value,):
            part = getattr(part, "jaxpr", part)
            if hasattr(part, "eqns"):
                yield part


def _calls(program: Any) -> Iterator[tuple[str, int]]:
    for equation in program.eqns:
        if equation.primitive.name in LAPACK:
            yield equation.primitive.name, math.prod(equation.invars[0].aval.shape[:-2])
        for part in _inner(equation):
            yield from _calls(part)


def lapack_calls(function: Any, *arguments: Any) -> list[tuple[str, int]]:
    """(name, matrices) of each LAPACK call that ``function`` makes, loops and functions inside included."""
    return list(_calls(jax.make_jaxpr(function)(*arguments).jaxpr))
