"""The LAPACK calls of a traced program, and which of them wait for which."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from typing import Any

import jax

LAPACK = {
    "cholesky", "cholesky_update", "eig", "eigh", "geqp3", "geqrf", "hessenberg", "householder_product", "lu", "qr",
    "schur", "svd", "triangular_solve", "tridiagonal", "tridiagonal_solve",
}  # fmt: skip
# Done as one piece; all others are written out where they are called.
LOOPS = {"while", "scan", "cond", "custom_linear_solve"}


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
            name, parts = equation.primitive.name, list(_inner(equation))
            if name in LOOPS and parts:
                for part in parts:  # a level of its own
                    inside = Order()
                    inside(part, [frozenset()] * len(part.invars))
                    self.apart += inside.apart
                busy = any(True for part in parts for _ in _calls(part))
                results = self._call(name, all_of_them) if busy else all_of_them
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


COMPUTATION = re.compile(r"^(?:ENTRY )?%(\S+) \(.*?\{$(.*?)^\}", re.MULTILINE | re.DOTALL)
INSTRUCTION = re.compile(r"^ +(?:ROOT )?%(\S+) = (.*)$", re.MULTILINE)
NAMES = re.compile(r"%([^\s,(){}]+)")


def compiled_at_once(text: str) -> list[tuple[str, str]]:
    """As ``at_once``, of the text of a compiled program: what is left after every pass of the compiler."""
    read = {name: INSTRUCTION.findall(lines) for name, lines in COMPUTATION.findall(text)}

    def busy(line: str) -> bool:
        inside = (busy(inner) for part in NAMES.findall(line) for _, inner in read.get(part, ()))
        return 'custom_call_target="lapack' in line or any(inside)

    apart = []
    for lines in read.values():
        before: dict[str, frozenset[str]] = {}
        calls: list[str] = []
        for name, line in lines:
            known = frozenset().union(*(before.get(other, frozenset()) for other in NAMES.findall(line)))
            if busy(line):
                apart += [(other, name) for other in calls if other not in known]
                calls.append(name)
                known |= {name}
            before[name] = known
    return apart
