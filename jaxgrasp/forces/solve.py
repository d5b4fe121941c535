"""11.3: with which contact forces, and at what least cost, does a grasp balance a load?

One lane's way: fold and orthonormalise as for wrench resistance; scale the load (``balance.balance``); iterate to the
optimum or to a proof that there is none (``solver.primal_dual``); read the answer off and bound it
(``optimum.answer``). Everyone for a few iterations, then the stragglers, then the answers.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.core import Tracer

from ..backend import batched, in_chunks, in_sweeps, kernel, tile_width, to_lanes, to_rows
from ..conic import (
    ConvexState,
    Stop,
    as_vector,
    begin_convex_cone_program,
    regular,
    solve_convex_cone_program,
)
from ..contacts import Component, Contacts, Grasp, contacts_of, tile_of, to_twist
from ..core import Array, Bool, Float, Int, Status, gap_floor, real_array, unit_roundoff, wrench_dimension
from .answer import Answer, answer
from .criteria import Criterion, Gentlest
from .derivatives import Rows, Scales, Solved, differentiable
from .infeasibility import proves
from .problem import Demand, ForceProblem, force_problem
from .starting_point import starting_point

__all__ = ["ForceOptimum", "optimize_forces"]

FIRST_BUDGET = 12  # iterations before stragglers are gathered
TOTAL_BUDGET = 60
CHUNK = 4096  # problems an executable takes at once when called on concrete arrays


class ForceOptimum(eqx.Module):
    """Optimal contact forces and their proofs, with the batch axes in front; forces in N, torques in N m.

    status        int32, a ``Status``: OPTIMAL, INFEASIBLE, STALLED or INVALID
    force         (*batch, k n) contact after contact in the chapter's component order: they balance the load, each in
                  its cone; zero where INFEASIBLE
    cost, bound   the criterion at ``force``, and a proven lower bound of every admissible force's cost; both
                  infinite where INFEASIBLE
    escape_twist  (*batch, m) (velocity; angular velocity), unit norm: the proof of INFEASIBLE; else zero
    load_twist    (*batch, m) derivative of the optimal cost with respect to the wrench: the twist behind ``bound``
    joint_rates   (*batch, q) multipliers of the torque limits; with them the twists prove what they prove
    smooth        bool: forces and multipliers are unique and strictly complementary, so that they have derivatives;
                  elsewhere their derivatives are one finite choice. False where not OPTIMAL
    iterations    int32 interior-point iterations spent
    stop          int32, a ``solver.Stop``: why the iteration ended
    wrench, criterion, max_normal, torque_limits, smoothing  the problem, as it was asked
    """

    status: Int[Array, "*batch"]
    force: Float[Array, "*batch kn"]
    cost: Float[Array, "*batch"]
    bound: Float[Array, "*batch"]
    escape_twist: Float[Array, "*batch m"]
    load_twist: Float[Array, "*batch m"]
    joint_rates: Float[Array, "*batch q"]
    smooth: Bool[Array, "*batch"]
    iterations: Int[Array, "*batch"]
    stop: Int[Array, "*batch"]
    wrench: Float[Array, "*batch m"]
    criterion: Criterion
    max_normal: Float[Array, "*batch k"] | None
    torque_limits: tuple[Array, Array] | None
    smoothing: float = eqx.field(static=True, default=0.0)

    @property
    def gap(self) -> Float[Array, "*batch"]:
        """``cost - bound``: no admissible force is cheaper by more; 0 where INFEASIBLE."""
        same = self.cost == self.bound  # both may be infinite
        return jnp.where(same, jnp.zeros_like(self.cost), self.cost - self.bound)


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
    answer: Answer
    smooth: Array
    scales: Scales | None
    multipliers: Array | None


def _tile_kernel(plan: _Plan) -> Callable[..., _Progress]:
    """A tile's whole way. One kernel for first steps and stragglers alike: it is what takes long to compile."""

    @kernel
    def run(rows: Rows, state: ConvexState, fresh: Array, budget: Array, tolerance: Array) -> _Progress:
        problem = _problem(plan, rows)
        load = problem.load
        weighted = problem.demand.criterion.barrier_weight is not None
        idle = jnp.zeros_like(load.rest) if weighted else load.rest
        skip = ~problem.valid | load.off | idle
        start = begin_convex_cone_program(problem.program, starting_point(problem), skip)
        state = jax.tree.map(lambda new, old: jnp.where(fresh, new, old), start, _to_lanes(state))
        # A robust bound is read off the forces, which doubles what they lack.
        goal = tolerance / 10 if weighted else tolerance
        rounding = 8 * unit_roundoff(tolerance.dtype)
        state = solve_convex_cone_program(problem.program, state, goal, proves, budget, rounding)
        return _to_rows(_progress(plan, problem, state, answer(problem, state, 4 * tolerance)))

    return run


def _progress(plan: _Plan, problem: ForceProblem, state: ConvexState, result: Answer) -> _Progress:
    optimal = (result.status == Status.OPTIMAL.value) & (state.stop != Stop.SKIPPED.value)
    smooth = optimal
    if problem.program.smoothing is None:
        smooth = optimal & regular(problem.program, state.point)
    if not plan.with_point:
        return _Progress(state, result, smooth, None, None)
    tile = problem.tile
    scales = Scales(tile.folded.length, problem.load.size, tile.projection.factor, problem.row_norm)
    y = to_twist(tile.projection, as_vector(state.point.y))
    return _Progress(state, result, smooth, scales, jnp.stack(y))


def _solve_rows(plan: _Plan, rows: Rows, count: Array, tolerance: Array) -> Solved:
    """All sweeps over the first ``count`` of (N, ..) rows; N is a multiple of the tile width."""
    run = _tile_kernel(plan)

    def advance(rows: Rows, progress: _Progress, sweep: Array) -> _Progress:
        fresh = sweep == 0
        budget = jnp.where(fresh, jnp.int32(FIRST_BUDGET), jnp.int32(TOTAL_BUDGET - FIRST_BUDGET))
        return run(rows, progress.state, fresh, budget, tolerance)

    def unfinished(progress: _Progress) -> Array:
        return progress.state.stop == Stop.RUNNING.value

    shapes = _shapes(plan, rows)
    state, answers, smooth, scales, y = in_sweeps(advance, rows, shapes, unfinished, count, 2, plan.width)
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
    leaves = jax.tree.leaves((rows, tolerance))
    if any(isinstance(x, Tracer) for x in leaves) or jax.default_backend() != "cpu":
        return _compiled(plan._replace(with_point=True))(rows, tolerance)

    def run(part: Rows, count: Array) -> Solved:
        return _solve_chunk(plan, part, count, tolerance)

    return in_chunks(run, rows, rows[0].active.shape[:-1], CHUNK)


# The question --------------------------------------------------------------------------------------------


def spread_loads(grasp: Grasp, wrench: Any) -> tuple[Array, tuple[int, ...]]:
    """The wrench with all batch axes, and those axes: the grasp's, then any load axes."""
    m, batch = wrench_dimension(grasp.dimension), grasp.batch_shape
    array = real_array(wrench, "wrench").astype(grasp.dtype)
    if array.ndim < 1 or array.shape[-1] != m:
        raise ValueError(
            f"wrench must have shape (*batch, *loads, {m}): (force; torque about the centre of mass), got {array.shape}"
        )
    lead = array.shape[:-1]
    if not lead:
        return jnp.broadcast_to(array, (*batch, m)), batch
    if len(lead) < len(batch) or any(a not in (1, b) for a, b in zip(lead, batch, strict=False)):
        raise ValueError(
            f"the leading axes of wrench {array.shape} must start with the grasp's batch axes {batch} "
            "(further axes are several loads for each grasp)"
        )
    shape = (*batch, *lead[len(batch) :])
    return jnp.broadcast_to(array, (*shape, m)), shape


def _spread(
    value: Array, own: tuple[int, ...], batch: tuple[int, ...], shape: tuple[int, ...], name: str
) -> Array:
    """``value`` with trailing axes ``own`` broadcast over ``batch``, then over the load axes."""
    loads = len(shape) - len(batch)
    try:
        full = jnp.broadcast_to(value, (*batch, *own))
    except ValueError as error:
        raise ValueError(f"{name} must broadcast to shape {(*batch, *own)}, got {value.shape}") from error
    return jnp.broadcast_to(full.reshape(*batch, *([1] * loads), *own), (*shape, *own))


def _weight(value: Array, batch: tuple[int, ...], shape: tuple[int, ...]) -> Array:
    """One per problem: from one for all, one per grasp, or one per load."""
    if value.ndim == len(shape) > len(batch):
        return jnp.broadcast_to(value, shape)
    return _spread(value, (), batch, shape, "the criterion's weight")


def _demand(
    grasp: Grasp,
    wrench: Array,
    shape: tuple[int, ...],
    criterion: Criterion,
    max_normal: Any,
    torque_limits: Any,
) -> tuple[Contacts, Demand]:
    batch, k, dtype = grasp.batch_shape, grasp.contacts, grasp.dtype
    n = grasp.model.force_size(grasp.dimension)
    contacts = contacts_of(grasp)
    spread = Contacts(*(_spread(x, x.shape[len(batch) :], batch, shape, "grasp") for x in contacts))
    criterion = jax.tree.map(lambda x: _weight(x.astype(dtype), batch, shape), criterion)
    log_det = None
    if criterion.barrier_weight is not None:
        terms = grasp.model.log_det_terms(grasp.dimension)
        a, b, c = (_spread(x.astype(dtype), (k,), batch, shape, "grasp") for x in terms)
        log_det = (a, b, c)
    cap = None
    if max_normal is not None:
        cap = _spread(real_array(max_normal, "max_normal").astype(dtype), (k,), batch, shape, "max_normal")
    jacobian = torque = None
    if torque_limits is not None:
        try:
            jacobian, torque = torque_limits
        except (TypeError, ValueError) as error:
            raise ValueError(
                f"torque_limits must be a pair (J, tau_max): J of shape (*batch, {k * n}, q) and tau_max (q)"
            ) from error
        jacobian = real_array(jacobian, "the hand Jacobian J").astype(dtype)
        if jacobian.ndim < 2 or jacobian.shape[-2] != k * n:
            raise ValueError(
                f"the hand Jacobian J must have shape (*batch, {k * n}, q): one row for each force component "
                f"({k} contacts of {n}), one column for each joint, got {jacobian.shape}"
            )
        joints = jacobian.shape[-1]
        jacobian = _spread(jacobian, (k * n, joints), batch, shape, "the hand Jacobian J")
        torque = _spread(real_array(torque, "tau_max").astype(dtype), (joints,), batch, shape, "tau_max")
    return spread, Demand(wrench, criterion, log_det, cap, jacobian, torque)


def optimize_forces(
    grasp: Grasp,
    wrench: Float[Array, "*batch m"],
    criterion: Criterion | None = None,
    max_normal: Any = None,
    torque_limits: tuple[Any, Any] | None = None,
    tolerance: float = 1e-8,
    smoothing: float = 0.0,
) -> ForceOptimum:
    """The least costly admissible contact forces that balance a load (section 11.3, Definition 5).

        min h(f)   subject to   f_i in C_i,  G f + wrench = 0,  f_n,i <= max_normal_i,  |J^T f| <= tau_max

    grasp          a ``Grasp`` with any batch axes; works under ``jax.jit`` and ``jax.vmap``
    wrench         (*batch, *loads, m): force in N and torque about the centre of mass in N m that act on the
                   object; (m,) goes to all grasps, axes after the grasp's own are several loads for each grasp
    criterion      ``Gentlest()`` (default), ``Robust(weight)``, ``SmallestSum()``, ``SumOfSquares()`` or
                   ``LeastNorm(length)``
    max_normal     N, a number or one per contact, infinite for none
    torque_limits  (J, tau_max): J (*batch, k n, q) maps joint rates to contact velocities in the contacts' own
                   frames, so ``J^T f`` are the joint torques (N m); |J^T f| <= tau_max, (q) and positive
    tolerance      duality gap to reach, relative to the cost
    smoothing      barrier parameter, in units of the cost, at which to stop (default 0: the optimum itself). The
                   forces are then those of the smooth central path, whose derivatives have no kinks; ``gap`` says
                   what it costs

    ``jax.grad``, ``jvp``, ``vjp`` and ``hessian`` work in every nesting, with respect to all float inputs, for cost,
    bound, force, load_twist and joint_rates. Costs use the envelope theorem, forces the implicit function theorem.
    Where an optimum is degenerate (two active sets meet, or several forces are optimal) the derivative of the force
    is one finite choice, the limit along the central path; ``smoothing`` removes the kink. Lanes that are not OPTIMAL,
    and lanes without a load, have derivative 0.

    Returns a ``ForceOptimum``. OPTIMAL comes with forces and a proven bound, INFEASIBLE with an escape twist; a lane
    without either is STALLED, one with bad numbers INVALID. Nothing raises inside; wrong shapes raise ValueError.
    Sources: Buss, Hashimoto, Moore 1996; Han, Trinkle, Li 2000; Boyd, Wegbreit 2007.
    """
    if not isinstance(grasp, Grasp):
        raise ValueError(f"optimize_forces takes a jaxgrasp.Grasp, got {type(grasp).__name__}")
    criterion = Gentlest() if criterion is None else criterion
    if not isinstance(criterion, Criterion):
        raise ValueError(f"criterion must be an object such as jaxgrasp.Gentlest(), got {criterion!r}")
    if isinstance(tolerance, int | float) and not tolerance > 0:
        raise ValueError(f"tolerance must be positive, got {tolerance}")
    if not isinstance(smoothing, int | float) or not smoothing >= 0:
        raise ValueError(f"smoothing must be a number of at least 0, got {smoothing!r}")
    components = grasp.model.components(grasp.dimension)
    loads, shape = spread_loads(grasp, wrench)
    rows = _demand(grasp, loads, shape, criterion, max_normal, torque_limits)
    demand = rows[1]
    if smoothing:
        demand = demand._replace(smoothing=jnp.full(shape, smoothing, grasp.dtype))
        rows = (rows[0], demand)
    joints = 0 if demand.jacobian is None else demand.jacobian.shape[-1]
    width = tile_width((wrench_dimension(grasp.dimension) + joints) * grasp.contacts * len(components))
    plan = _Plan(components, grasp.dimension, width, False)
    floor = gap_floor(grasp.dtype)
    goal = jnp.maximum(jnp.asarray(tolerance, grasp.dtype), jnp.asarray(floor, grasp.dtype))
    solved = _solved(plan, rows, goal)
    a = solved.answer
    limits = None if demand.jacobian is None or demand.torque is None else (demand.jacobian, demand.torque)
    return ForceOptimum(
        a.status, a.force, a.cost, a.bound, a.escape_twist, a.load_twist, a.joint_rates, solved.smooth,
        solved.iterations, solved.stop, loads, demand.criterion, demand.cap, limits, float(smoothing),
    )  # fmt: skip
