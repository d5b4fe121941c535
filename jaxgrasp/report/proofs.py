"""Stored answers proved again: in float64, without the solver, from what the file holds alone."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import jax.numpy as jnp
import numpy as np

from ..backend import precision
from ..certificates import check, prove_resistance
from ..core import Status
from ..forces import OptimalForces, closeness, make_criterion
from .answers import ForceAnswer, Verdict

__all__ = ["reprove_forces", "reprove_verdict"]


def reprove_verdict(verdict: Verdict, metadata: dict[str, Any]) -> str:
    """One or two sentences: does the stored evidence, checked without the solver, prove the row, and how exactly?"""
    dtype = np.dtype(metadata.get("dtype", "float64"))
    known = verdict.bound_twist is not None
    with precision(dtype.name):
        grasp = verdict.grasp(dtype)
        blank = np.nan if verdict.status == Status.INVALID else 0.0
        nothing, still = np.full(verdict.active.size * len(verdict.components), blank), np.full(6, blank)
        evidence = SimpleNamespace(
            status=np.asarray(verdict.status.value),
            lower=np.asarray(verdict.margin),
            upper=np.asarray(verdict.upper if known else max(verdict.margin, 1.0)),  # t* <= 1 needs no proof
            rank=np.asarray(-1 if verdict.rank is None else verdict.rank),
            internal_force=nothing if verdict.force is None else verdict.force.ravel(),
            escape_twist=still if verdict.twist is None else verdict.twist,
            bound_twist=verdict.bound_twist if known else still,
        )
        proof = prove_resistance(grasp, evidence, tolerance=metadata.get("tolerance", 1e-8))
    holds = proof.status != Status.REFUSED
    if verdict.status in (Status.UNDECIDED, Status.INVALID):
        return "There is nothing to prove." if holds else (
            "Checked again: the stored numbers do not fit this verdict."
        )  # fmt: skip
    if not holds:
        return "Checked again: the stored evidence does NOT prove it."
    unproved = "" if known or verdict.status == Status.INVALID else (
        " The upper end of the margin is not proved: a file of version 0.1 holds no evidence of it; screen it again."
    )  # fmt: skip
    return f"Checked again without the solver: the proof holds. {proof.sentence()}{unproved}"


def reprove_forces(answer: ForceAnswer) -> bool:
    """Whether the stored numbers, checked in float64 without the solver, prove the stored answer."""
    m, k = len(answer.wrench), len(answer.position)

    def or_zeros(values: np.ndarray | None, size: int) -> Any:
        return jnp.zeros(size) if values is None else jnp.asarray(values).ravel()

    with precision("float64"):
        said = {name: answer.criterion[name] for name in ("weight", "length")}
        found = OptimalForces(
            status=jnp.int32(int(answer.status)),
            force=or_zeros(answer.force, k * len(answer.components)),
            upper=jnp.asarray(answer.cost),
            lower=jnp.asarray(answer.lower),
            escape_twist=or_zeros(answer.escape_twist, m),
            load_twist=or_zeros(answer.load_twist, m),
            joint_rates=jnp.zeros(0),
            smooth=jnp.asarray(False),  # not stored, and no part of the proof
            iterations=jnp.int32(0),
            stop=jnp.int32(0),
        )
        proved = check(
            answer.grasp(),
            found,
            wrench=answer.wrench,
            criterion=make_criterion(answer.criterion["name"], **said),
            max_normal=answer.max_normal,
            tolerance=closeness(answer.tolerance),
        )
        return bool(proved)
