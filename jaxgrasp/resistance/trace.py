"""One grasp under the magnifying glass: the iterations of the solver, and a file that reproduces a lane."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ..conic import LinearState, LinearStep, advance_linear_cone_program, begin_linear_cone_program
from ..contacts import Component, Contacts, Grasp, contacts_of, fold, project
from ..core import Array, Float, Status, gap_floor
from .problem import margin_program, starting_point
from .solve import TOTAL_BUDGET

__all__ = ["Trace", "trace"]


class Trace(eqx.Module):
    """The iterations of one grasp, first entry the starting point; ``print(trace)`` shows a table.

    lower, upper     (n + 1,) the bracket of the margin after each iteration
    gap              (n + 1,) <u, z>
    residual         (n + 1,) |b - B u| before each step (NaN at the start, as the two below)
    centering        (n + 1,) Mehrotra's sigma
    length           (n + 1,) step length
    stop             why it ended, a ``Status`` number
    """

    lower: Float[Array, " steps"]
    upper: Float[Array, " steps"]
    gap: Float[Array, " steps"]
    residual: Float[Array, " steps"]
    centering: Float[Array, " steps"]
    length: Float[Array, " steps"]
    stop: int = eqx.field(static=True)

    def __str__(self) -> str:
        lines = ["iteration   lower bound    upper bound        gap   residual  centring  length"]
        for i in range(len(self.gap)):
            row = f"{i:9d} {self.lower[i]:13.9f}  {self.upper[i]:13.9f}  {self.gap[i]:9.2e}"
            if i:
                row += f"  {self.residual[i]:9.1e}  {self.centering[i]:8.1e}"
                row += f"  {self.length[i]:6.4f}"
            lines.append(row)
        lines.append(Status(self.stop).sentence)
        return "\n".join(lines)


def _tile(contacts: Contacts, components: tuple[Component, ...]):
    folded = fold(contacts, components)
    projection = project(folded)
    return folded, projection, margin_program(projection.basis)


def trace(grasp: Grasp, *, tolerance: float = 1e-8, max_iterations: int = TOTAL_BUDGET) -> Trace:
    """``lower <= t* <= upper`` after each iteration of the solver, for one grasp; residuals and step lengths beside it.

    grasp           a single grasp (no batch axes): index a batch first, ``trace(grasps[17])``
    tolerance       duality gap to reach, relative to the margin
    max_iterations  at most

    Returns a ``Trace``; ``print`` it. ValueError where the grasp has batch axes.
    """
    if grasp.batch_shape:
        raise ValueError(
            f"trace takes one grasp; index the batch {grasp.batch_shape} first, e.g. trace(grasp[0])"
        )
    components = grasp.model.components(grasp.dimension)
    rows = jax.tree.map(lambda x: x[None], contacts_of(grasp))
    goal = jnp.asarray(max(tolerance, gap_floor(grasp.dtype)), grasp.dtype)

    @jax.jit
    def first(rows: Contacts) -> LinearState:
        folded, projection, program = _tile(rows, components)
        start = starting_point(folded, projection)
        dual = jnp.where(start.unbounded, start.point.y, jnp.zeros_like(start.point.y))
        return begin_linear_cone_program(
            program, start.point._replace(y=dual), ~folded.valid | start.unbounded
        )

    @jax.jit
    def values(rows: Contacts, state: LinearState) -> tuple[Array, Array]:
        *_, program = _tile(rows, components)
        return -program.primal_value(state.point.u), -program.dual_value(state.point.y)

    @jax.jit
    def step(rows: Contacts, state: LinearState) -> tuple[LinearState, LinearStep]:
        *_, program = _tile(rows, components)
        return advance_linear_cone_program(program, state, goal)

    state = first(rows)
    nan = float("nan")
    log = [[*(float(x[0]) for x in values(rows, state)), float(state.gap[0]), nan, nan, nan]]
    while int(state.stop[0]) == Status.RUNNING and len(log) <= max_iterations:
        state, info = step(rows, state)
        bounds = (float(x[0]) for x in values(rows, state))
        log.append([*bounds, float(state.gap[0]), *(float(x[0]) for x in info)])
    columns = [jnp.asarray(c, grasp.dtype) for c in np.asarray(log, np.float64).T]
    return Trace(*columns, stop=int(state.stop[0]))
