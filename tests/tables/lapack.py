"""The LAPACK calls of a traced program, and which of them wait for which."""

from __future__ import annotations

from typing import Any

import jax

LAPACK = {
    "cholesky", "cholesky_update", "eig", "eigh", "geqp3", "geqrf", "hessenberg", "householder_product", "lu", "qr",
    "schur", "svd", "triangular_solve", "tridiagonal", "tridiagonal_solve",
}  # fmt: skip
LOOPS = {
    "while",
    "scan",
    "cond",
    "custom_linear_solve",
}  # done as one piece; all others are written out where they are called


def inner(equation: Any) -> list[Any]:
    """The programs inside an equation."""
    found = []
    for value in equation.params.values():
        for part in value if isinstance(value, tuple | list) else (value,):
            part = getattr(part, "jaxpr", part)
            if hasattr(part, "eqns"):
                found.append(part)
    return found


def calls(program: Any) -> int:
    """LAPACK calls in a jaxpr, those inside others included."""
    return sum(
        (equation.primitive.name in LAPACK) + sum(map(calls, inner(equation))) for equation in program.eqns
    )


class Order:
    """Which LAPACK calls each value comes after; ``apart``: pairs of calls of one level that do not know each other."""

    def __init__(self):
        self.names: list[str] = []
        self.apart: list[tuple[str, str]] = []

    def __call__(self, program: Any, given: list[frozenset[int]]) -> list[frozenset[int]]:
        before = dict(zip(program.invars, given, strict=True))

        def known(v: Any) -> frozenset[int]:
            return frozenset() if hasattr(v, "val") else before.get(v, frozenset())

        for equation in program.eqns:
            inputs = [known(v) for v in equation.invars]
            all_of_them = frozenset().union(*inputs)
            name, parts = equation.primitive.name, inner(equation)
            if name in LOOPS and parts:
                for part in parts:  # a level of its own
                    inside = Order()
                    inside(part, [frozenset()] * len(part.invars))
                    self.apart += inside.apart
                results = self._call(name, all_of_them) if any(map(calls, parts)) else all_of_them
                outputs = [results] * len(equation.outvars)
            elif parts:
                part = parts[0]  # of a function with its own derivative: the function
                outputs = self(part, inputs[len(inputs) - len(part.invars) :])
            else:
                results = self._call(name, all_of_them) if name in LAPACK else all_of_them
                outputs = [results] * len(equation.outvars)
            before.update(zip(equation.outvars, outputs, strict=True))
        return [known(v) for v in program.outvars]

    def _call(self, name: str, before: frozenset[int]) -> frozenset[int]:
        self.apart += [(self.names[i], name) for i in range(len(self.names)) if i not in before]
        self.names.append(name)
        return before | {len(self.names) - 1}


def at_once(function: Any, *arguments: Any) -> list[tuple[str, str]]:
    """Pairs of LAPACK calls of ``function`` that nothing keeps from running at once."""
    program = jax.make_jaxpr(function)(*arguments).jaxpr
    order = Order()
    order(program, [frozenset()] * len(program.invars))
    return order.apart


def lapack_calls(function: Any, *arguments: Any) -> int:
    """How many LAPACK calls ``function`` makes."""
    return calls(jax.make_jaxpr(function)(*arguments).jaxpr)
