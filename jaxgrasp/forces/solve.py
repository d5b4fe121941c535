"""11.3: with which contact forces, and at what least cost, does a grasp balance a load?

One lane's way: fold and orthonormalise as for wrench resistance; scale the load (``problem.force_problem``); iterate to
the optimum or to a proof that there is none (``conic.convex_interior_point``); read the answer off and bound it
(``answer.answer``). Everyone for a few iterations, then the stragglers, then the answers.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from ..backend import Sweeps, batched, in_chunks, in_sweeps, is_traced, tile_width, to_lanes, to_rows
from ..certificates import prove_forces, proved_by
from ..conic import ConvexState, begin_convex_cone_program, regular, solve_convex_cone_program
from ..contacts import Component, Grasp, TorqueLimits, tile_of, to_twist
from ..core import (
    Answer,
    Array,
    Bool,
    Float,
    Int,
    Status,
    bracket_width,
    gap_goal,
    unit_roundoff,
    wrench_dimension,
)
from .answer import Answer as LaneAnswer
from .answer import answer
from .criteria import Criterion, Gentlest
from .demand import demand_rows, spread_loads
from .derivatives import Rows, Scales, Solved, differentiable
from .infeasibility import proves
from .problem import ForceProblem, force_problem
from .starting_point import starting_point

__all__ = ["OptimalForces", "optimize_forces"]

FIRST_BUDGET = 12  # iterations before stragglers are gathered
TOTAL_BUDGET = 60
CHUNK = 4096  # problems an executable takes at once when called on concrete arrays


@proved_by(prove_forces)
class OptimalForces(Answer):
    """Optimal contact forces and their proofs, with the batch axes in front; forces in N, torques in N m.

    status        int32, a ``Status``: OPTIMAL, INFEASIBLE, STALLED or INVALID
    force         (*batch, k n) contact after contact in the chapter's component order: they balance the load, each in
                  its cone; zero where INFEASIBLE. ``jg.force_vectors`` gives them in body or world axes
    lower, upper  the optimal cost lies between them: ``upper`` is the criterion at ``force``, infinite where the forces
                  of a STALLED lane are outside their limits; ``lower`` a proven lower bound of every admissible force's
                  cost; both infinite where INFEASIBLE
    escape_twist  (*batch, m) (velocity; angular velocity), unit norm: the proof of INFEASIBLE; else zero
    load_twist    (*batch, m) derivative of the optimal cost with respect to the wrench: the twist behind ``lower``
    joint_rates   (*batch, q) multipliers of the torque limits; with them the twists prove what they prove
    smooth        bool: forces and multipliers are unique and strictly complementary, so that they have derivatives;
                  elsewhere their derivatives are one finite choice. False where not OPTIMAL
    iterations    int32 interior-point iterations spent
    stop          int32, a ``Status``: why the iteration ended
    smoothing     the barrier parameter that was asked for
    """

    status: Int[Array, "*batch"]
    force: Float[Array, "*batch kn"]
    upper: Float[Array, "*batch"]
    lower: Float[Array, "*batch"]
    escape_twist: Float[Array, "*batch m"]
    load_twist: Float[Array, "*batch m"]
    joint_rates: Float[Array, "*batch q"]
    smooth: Bool[Array, "*batch"]
    iterations: Int[Array, "*batch"]
    stop: Int[Array, "*batch"]
    smoothing: float = eqx.field(static=True, default=0.0)

    SENTENCES: ClassVar[Mapping[Status, str]] = {
        Status.OPTIMAL: "Optimal: the forces balance the load inside every cone, and the bound proves the cost.",
        Status.INFEASIBLE: "Infeasible: no admissible forces balance the load; along the escape twist the load does "
        "work that no force can take up.",
        Status.STALLED: "Stalled: rounding stopped the solver before its gap or a proof of infeasibility; the best "
        "forces and the gap reached are given.",
        Status.INVALID: "Invalid: the numbers are not a grasp with a load, a criterion and limits.",
    }

    @property
    def cost(self) -> Float[Array, "*batch"]:
        """``h(force)``, the criterion at the forces given: ``upper``."""
        return self.upper

    @property
    def gap(self) -> Float[Array, "*batch"]:
        """``upper - lower``: no admissible force is cheaper by more; 0 where INFEASIBLE."""
        return bracket_width(self.lower, self.upper)

    def values(self, index: int | tuple[int, ...] = ()) -> str:
        """The bracket of one lane's cost in words."""
        lower, upper = (np.asarray(x)[index] for x in (self.lower, self.upper))
        return f"Cost between {lower:.6g} and {upper:.6g}." if np.isfinite(upper) else ""


class _Plan(NamedTuple):
    """What is fixed at trace time."""

    components: tuple[Component, ...]
    dimension: int
    width: int
    with_point: bool  # keep the primal-dual point, for derivatives


def _to_lanes(tree: Any) -> Any:
    return jax.tree.map(to_lanes, tree)


def _to_rows(tree: Any) -> Any:
    return jax.tree.map(to_rows, tree)


def _problem(plan: _Plan, rows: Rows) -> ForceProblem:
    contacts, demand = rows
    return force_problem(tile_of(contacts, plan.components, plan.dimension), demand)


class _Progress(NamedTuple):
    """What a sweep over the tiles leaves behind, as rows; the last two only where derivatives may be wanted.

    smooth       whether the optimum moves smoothly with the data
    multipliers  (m,) of A itself, where those of the state belong to its orthonormal rows
    """

    state: ConvexState
    answer: LaneAnswer
    smooth: Array
    scales: Scales | None
    multipliers: Array | None


def _advance(plan: _Plan, rows: Rows, before: ConvexState, sweep: Array, tolerance: Array) -> _Progress:
    """A tile's whole way, from its rows to its answers; one program for first steps and stragglers alike."""
    problem = _problem(plan, rows)
    load = problem.load
    weighted = problem.demand.criterion.barrier_weight is not None
    idle = jnp.zeros_like(load.rest) if weighted else load.rest
    skip = ~problem.valid | load.off | idle
    begin = begin_convex_cone_program(problem.program, starting_point(problem), skip)
    state = jax.tree.map(lambda new, old: jnp.where(sweep == 0, new, old), begin, _to_lanes(before))
    # A robust bound is read off the forces, which doubles what they lack.
    goal = tolerance / 10 if weighted else tolerance
    rounding = 8 * unit_roundoff(tolerance.dtype)
    budget = jnp.where(sweep == 0, jnp.int32(FIRST_BUDGET), jnp.int32(TOTAL_BUDGET - FIRST_BUDGET))
    state = solve_convex_cone_program(problem.program, state, goal, proves, budget, rounding)
    return _to_rows(_progress(plan, problem, state, answer(problem, state, 4 * tolerance)))


def _progress(plan: _Plan, problem: ForceProblem, state: ConvexState, result: LaneAnswer) -> _Progress:
    optimal = (result.status == Status.OPTIMAL.value) & (state.stop != Status.SKIPPED.value)
    smooth = optimal
    if problem.program.smoothing is None:
        smooth = optimal & regular(problem.program, state.point)
    if not plan.with_point:
        return _Progress(state, result, smooth, None, None)
    tile = problem.tile
    scales = Scales(tile.folded.length, problem.load.size, tile.projection.factor, problem.row_norm)
    y = to_twist(tile.projection, state.point.y)
    return _Progress(state, result, smooth, scales, y)


def _solve_rows(plan: _Plan, rows: Rows, count: Array, tolerance: Array) -> Solved:
    """All sweeps over the first ``count`` of (N, ..) rows; N is a multiple of the tile width."""

    def step(rows: Rows, _: None, progress: _Progress, sweep: Array) -> _Progress:
        return _advance(plan, rows, progress.state, sweep, tolerance)

    def unfinished(progress: _Progress) -> Array:
        return progress.state.stop == Status.RUNNING.value

    sweeps = Sweeps(step, unfinished, 2)
    state, answers, smooth, scales, y = in_sweeps(sweeps, rows, None, _shapes(plan, rows), count, plan.width)
    point = None if y is None else state.point._replace(y=y)
    return Solved(answers, smooth, state.iterations, state.stop, point, scales)


def _shapes(plan: _Plan, rows: Rows) -> _Progress:
    """The shapes of what a tile leaves behind."""

    def first(tile: Rows) -> _Progress:
        problem = _problem(plan, tile)
        state = begin_convex_cone_program(problem.program, starting_point(problem), ~problem.valid)
        return _to_rows(_progress(plan, problem, state, answer(problem, state, problem.load.size)))

    return jax.eval_shape(first, rows)


@functools.cache
def _compiled(plan: _Plan) -> Callable[..., Solved]:
    solve = batched(functools.partial(_solve_rows, plan), lambda rows: rows[0].active.shape[:-1], plan.width)
    return jax.jit(differentiable(solve, plan.components, plan.dimension, plan.width))


_solve_chunk = jax.jit(_solve_rows, static_argnames=("plan",))


def _solved(plan: _Plan, rows: Rows, tolerance: Array) -> Solved:
    if is_traced((rows, tolerance)) or jax.default_backend() != "cpu":
        return _compiled(plan._replace(with_point=True))(rows, tolerance)

    def run(part: Rows, count: Array) -> Solved:
        return _solve_chunk(plan, part, count, tolerance)

    return in_chunks(run, rows, rows[0].active.shape[:-1], CHUNK)


# The question --------------------------------------------------------------------------------------------


def _expect(grasp: Grasp, criterion: Criterion, tolerance: float, smoothing: float) -> None:
    """ValueError where an argument of ``optimize_forces`` is of the wrong kind."""
    if not isinstance(grasp, Grasp):
        raise ValueError(f"optimize_forces takes a jaxgrasp.Grasp, got {type(grasp).__name__}")
    if not isinstance(criterion, Criterion):
        raise ValueError(f"criterion must be an object such as jaxgrasp.Gentlest(), got {criterion!r}")
    if isinstance(tolerance, int | float) and not tolerance > 0:
        raise ValueError(f"tolerance must be positive, got {tolerance}")
    if not isinstance(smoothing, int | float) or not smoothing >= 0:
        raise ValueError(f"smoothing must be a number of at least 0, got {smoothing!r}")


def optimize_forces(
    grasp: Grasp,
    wrench: Float[ArrayLike, "*batch m"],
    *,
    criterion: Criterion | None = None,
    max_normal: Float[ArrayLike, "*batch k"] | None = None,
    torque_limits: TorqueLimits
    | tuple[Float[ArrayLike, "*batch kn q"], Float[ArrayLike, "*batch q"]]
    | None = None,
    tolerance: float = 1e-8,
    smoothing: float = 0.0,
) -> OptimalForces:
    """The least costly admissible contact forces that balance a load (section 11.3, Definition 5).

        min h(f)   subject to   f_i in C_i,  G f + wrench = 0,  f_n,i <= max_normal_i,  |J^T f| <= tau_max

    grasp          a ``Grasp`` with any batch axes; works under ``jax.jit`` and ``jax.vmap``
    wrench         (*batch, *loads, m): force in N and torque about the centre of mass in N m that act on the
                   object; (m,) goes to all grasps, axes after the grasp's own are several loads for each grasp
    criterion      ``Gentlest()`` (default), ``Robust(weight)``, ``SmallestSum()``, ``SumOfSquares()`` or
                   ``LeastNorm(length)``
    max_normal     N, a number or one per contact, infinite for none
    torque_limits  (J, tau_max): J (*batch, k n, q) maps joint rates to contact velocities in the contacts' own
                   frames, so ``J^T f`` are the joint torques (N m); |J^T f| <= tau_max, (q) and positive, infinite
                   for none. For J in body or world axes: ``TorqueLimits(J, tau_max, axes="world", orientation=..)``
    tolerance      duality gap to reach, relative to the cost
    smoothing      barrier parameter, in units of the cost, at which to stop (default 0: the optimum itself). The
                   forces are then those of the smooth central path, whose derivatives have no kinks; ``gap`` says
                   what it costs

    ``jax.grad``, ``jvp``, ``vjp`` and ``hessian`` work in every nesting, with respect to all float inputs, for cost,
    bound, force, load_twist and joint_rates. Costs use the envelope theorem, forces the implicit function theorem.
    Where an optimum is degenerate (two active sets meet, or several forces are optimal) the derivative of the force
    is one finite choice, the limit along the central path; ``smoothing`` removes the kink. Lanes that are not OPTIMAL,
    and lanes without a load, have derivative 0.

    Returns ``OptimalForces``. OPTIMAL comes with forces and a proven bound, INFEASIBLE with an escape twist; a lane
    without either is STALLED, one with bad numbers INVALID. Nothing raises inside; wrong shapes raise ValueError.
    Sources: Buss, Hashimoto, Moore 1996; Han, Trinkle, Li 2000; Boyd, Wegbreit 2007.
    """
    criterion = Gentlest() if criterion is None else criterion
    _expect(grasp, criterion, tolerance, smoothing)
    components = grasp.model.components(grasp.dimension)
    loads, shape = spread_loads(grasp, wrench)
    rows = demand_rows(grasp, loads, shape, criterion, max_normal, torque_limits)
    demand = rows[1]
    if smoothing:
        demand = demand._replace(smoothing=jnp.full(shape, smoothing, grasp.dtype))
        rows = (rows[0], demand)
    joints = 0 if demand.jacobian is None else demand.jacobian.shape[-1]
    width = tile_width((wrench_dimension(grasp.dimension) + joints) * grasp.contacts * len(components))
    plan = _Plan(components, grasp.dimension, width, False)
    goal = gap_goal(tolerance, grasp.dtype)
    solved = _solved(plan, rows, goal)
    a = solved.answer
    return OptimalForces(
        a.status, a.force, a.cost, a.bound, a.escape_twist, a.load_twist, a.joint_rates, solved.smooth,
        solved.iterations, solved.stop, float(smoothing),
    )  # fmt: skip
