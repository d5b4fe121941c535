"""Linear matrix inequalities (11.10) and the problem of minimising a convex cost over one (Definitions 3, 4).

An LMI in x is ``Q(x) = Q_0 + sum_i x_i Q_i >= 0`` (positive semidefinite). ``Q_0 .. Q_N`` are any symmetric
matrices, and their size q has nothing to do with the number N of variables. Nothing here knows of grasps.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ..core import Answer, Array, Float, Int, Status

__all__ = [
    "LMIProblem",
    "LMISolution",
    "LogDetTerm",
    "bracket_words",
    "check_shapes",
    "expect_shape",
    "over_batch",
]


class LogDetTerm(eqx.Module):
    """``-weight log det B(x)``, ``B(x) = B_0 + sum_i x_i B_i``: a convex cost (erratum 2) that keeps B(x) > 0.

    weight    (*batch)           at least 0; at 0 B(x) > 0 still holds
    constant  (*batch, r, r)     B_0, symmetric
    matrices  (*batch, N, r, r)  B_1 .. B_N, symmetric
    """

    weight: Float[Array, "*batch"]
    constant: Float[Array, "*batch r r"]
    matrices: Float[Array, "*batch N r r"]

    def B(self, x: Float[Array, "*batch N"]) -> Float[Array, "*batch r r"]:
        """``B(x) = B_0 + sum_i x_i B_i``."""
        return self.constant + jnp.einsum("...i,...iab->...ab", x, self.matrices)


class LMIProblem(eqx.Module):
    """``min c.x + 1/2 x^T H x - weight log det B(x)  subject to  Q(x) = Q_0 + sum_i x_i Q_i >= 0``.

    cost       (*batch, N)                c
    constant   (*batch, q, q)             Q_0, symmetric
    matrices   (*batch, N, q, q)          Q_1 .. Q_N, symmetric
    start      (*batch, N)                a point with Q(x) > 0 and B(x) > 0
    curvature  (*batch, N, N), optional   H, symmetric, positive semidefinite; left out: 0
    log_det    a LogDetTerm, optional     left out: no such cost

    For linear equations ``A x = b`` pass the problem in z, ``x = x_0 + V z``, with V a basis of Null(A).
    """

    cost: Float[Array, "*batch N"]
    constant: Float[Array, "*batch q q"]
    matrices: Float[Array, "*batch N q q"]
    start: Float[Array, "*batch N"]
    curvature: Float[Array, "*batch N N"] | None = None
    log_det: LogDetTerm | None = None

    def Q(self, x: Float[Array, "*batch N"]) -> Float[Array, "*batch q q"]:
        """``Q(x) = Q_0 + sum_i x_i Q_i`` (11.10)."""
        return self.constant + jnp.einsum("...i,...iab->...ab", x, self.matrices)


class LMISolution(Answer):
    """``lower <= min h <= upper``: a strictly feasible point and how far from optimal it can be.

    status      (*batch) int32, a ``Status``: OPTIMAL where ``upper - lower <= tolerance * max(1, |upper|)``; UNBOUNDED,
                ``ray`` proves it; else STALLED, with the best point; INVALID where there is no start
    x           (*batch, N)     strictly feasible, rounding allowed for
    upper       (*batch)        its cost, rounded up; NaN where INVALID
    lower       (*batch)        no feasible x costs less; -infinite before the first dual point
    dual        (*batch, q, q)  Z >= 0, the multiplier of Q(x) >= 0 that proves ``lower``; 0 before
    ray         (*batch, N)     where UNBOUNDED, d: ``sum_i d_i Q_i >= 0``, B likewise, ``H d = 0``, ``c.d < 0``; else 0
    iterations  (*batch)        steps, int32

    For a linear cost ``lower = -tr(Q_0 Z)`` with ``Z >= 0, tr(Q_i Z) = c_i``; with curvature
    ``-tr(Q_0 Z) - 1/2 y^T H y``, ``tr(Q_i Z) = c_i + (H y)_i`` for some y; a log-det term has a multiplier of its own.
    """

    status: Int[Array, "*batch"]
    x: Float[Array, "*batch N"]
    upper: Float[Array, "*batch"]
    lower: Float[Array, "*batch"]
    dual: Float[Array, "*batch q q"]
    ray: Float[Array, "*batch N"]
    iterations: Int[Array, "*batch"]

    SENTENCES: ClassVar[Mapping[Status, str]] = {
        Status.STALLED: "Stalled: rounding, the budget of steps or a problem without a dual point inside its cone "
        "ended the method before its gap; the best point and the gap reached are given.",
        Status.INVALID: "Invalid: the start is not strictly feasible, the curvature is not positive semidefinite, or a "
        "number is not finite.",
    }

    @property
    def gap(self) -> Float[Array, "*batch"]:
        """``upper - lower``: no feasible point is cheaper by more."""
        return self.upper - self.lower

    def values(self, index: int | tuple[int, ...] = ()) -> str:
        """The bracket of one lane's cost in words."""
        return bracket_words("Cost", self.lower, self.upper, index)


def bracket_words(name: str, lower: Array, upper: Array, index: int | tuple[int, ...]) -> str:
    """``name`` between two numbers; empty where the upper one is no number or infinite."""
    low, high = np.asarray(lower)[index], np.asarray(upper)[index]
    return f"{name} between {low:.6g} and {high:.6g}." if np.isfinite(high) else ""


# Shapes ------------------------------------------------------------------------------------------------


def expect_shape(condition: bool, name: str, shape: str, value) -> None:
    if not condition:
        raise ValueError(f"{name} must have shape {shape}, got {jnp.shape(value)}")


def check_shapes(problem: LMIProblem) -> None:
    N, q = problem.cost.shape[-1], problem.constant.shape[-1]
    H, term = problem.curvature, problem.log_det
    expected = [
        ("constant", problem.constant, (q, q)),
        ("matrices", problem.matrices, (N, q, q)),
        ("start", problem.start, (N,)),
    ]
    if H is not None:
        expected.append(("curvature", H, (N, N)))
    if term is not None:
        r = term.constant.shape[-1]
        expected += [
            ("log_det.constant", term.constant, (r, r)),
            ("log_det.matrices", term.matrices, (N, r, r)),
        ]
    for name, value, shape in expected:
        expect_shape(
            value.shape[-len(shape) :] == shape, name, f"(*batch, {', '.join(map(str, shape))})", value
        )


def over_batch(function, arguments, ranks: tuple[int, ...]):
    """Apply a function of one problem over the leading batch axes. ``ranks``: how many axes of each array of
    ``arguments``, in order, belong to one problem; the others broadcast against each other."""
    leaves, structure = jax.tree.flatten(arguments)
    pairs = list(zip(leaves, ranks, strict=True))
    batch = jnp.broadcast_shapes(*(leaf.shape[: leaf.ndim - rank] for leaf, rank in pairs))
    lanes = []
    for leaf, rank in pairs:
        own = leaf.shape[leaf.ndim - rank :]
        lanes.append(jnp.broadcast_to(leaf, (*batch, *own)).reshape(-1, *own))
    if not batch:
        return function(jax.tree.unflatten(structure, [lane[0] for lane in lanes]))
    result = jax.vmap(function)(jax.tree.unflatten(structure, lanes))
    return jax.tree.map(lambda leaf: leaf.reshape(*batch, *leaf.shape[1:]), result)
