"""11.1-11.2: is the grasp wrench resistant (force closure), by how much, and why.

One grasp's way: fold mu and gamma into its grasp map (``contacts.fold``); project unit normal forces onto the internal
forces, which decides many grasps at once and starts the rest (``problem.starting_point``); close the bracket around the
margin (``conic``); certify (``verdict.judge``). One program for a tile's whole way, in sweeps: everyone for a few
iterations, then the stragglers; grasps of doubtful rank get their singular values in between.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from typing import ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ..backend import (
    Sweeps,
    batched,
    in_chunks,
    in_sweeps,
    is_traced,
    map_selected,
    tile_width,
    to_lanes,
    to_rows,
)
from ..certificates import prove_resistance, proved_by
from ..conic import (
    LinearConeProgram,
    LinearPoint,
    LinearState,
    begin_linear_cone_program,
    solve_linear_cone_program,
    vector_norm,
)
from ..contacts import Component, Contacts, Folded, Grasp, Tile, contacts_of, fold, tile_of, to_twist
from ..core import (
    Answer,
    Array,
    Float,
    Int,
    Status,
    bracket_width,
    gap_goal,
    rounding_constant,
    unit_roundoff,
    wrench_dimension,
)
from .derivatives import Scales, Solved, differentiable
from .problem import Start, margin_program, starting_point
from .rank import Rank, rank_kernel, unnoticed
from .second_attempt import second_attempt
from .verdict import Verdict, judge

__all__ = ["WrenchResistance", "wrench_resistance"]

TOTAL_BUDGET = 60
BUDGETS = (8, TOTAL_BUDGET - 8)  # iterations before stragglers are gathered: most lanes need 6 to 8 ...
VERDICT_BUDGETS = (0, 2, TOTAL_BUDGET - 2)  # ... and most verdicts none, one or two
CHUNK = 4096  # grasps an executable takes at once when called on concrete arrays


@proved_by(lambda grasp, answer, problem, tolerance: prove_resistance(grasp, answer, tolerance))
class WrenchResistance(Answer):
    """Verdicts and their proofs, with the batch axes of the grasp in front.

    status          int32, a ``Status``: RESISTANT, NOT_RESISTANT, MARGINAL, UNDECIDED or INVALID
    lower, upper    the true margin t* lies between them; t* <= 1, no unit; -inf where no internal force has a normal
                    component; NaN where INVALID
    rank            int32, of the folded grasp map; -1 where INVALID
    internal_force  (*batch, k n) in the chapter's component order, mean normal force 1: the forces behind ``lower``
                    and the proof of RESISTANT; zero where the margin is -inf, NaN where INVALID
    escape_twist    (*batch, m) (velocity; angular velocity), unit norm: the proof of NOT_RESISTANT; zero
                    where RESISTANT
    bound_twist     (*batch, m) (velocity; angular velocity), unit norm: the proof of ``upper``, by the largest multiple
                    of it that the dual admits; no derivative
    iterations      int32 interior-point iterations spent
    stop            int32, a ``Status``: why the iteration ended
    """

    status: Int[Array, "*batch"]
    lower: Float[Array, "*batch"]
    upper: Float[Array, "*batch"]
    rank: Int[Array, "*batch"]
    internal_force: Float[Array, "*batch kn"]
    escape_twist: Float[Array, "*batch m"]
    bound_twist: Float[Array, "*batch m"]
    iterations: Int[Array, "*batch"]
    stop: Int[Array, "*batch"]

    SENTENCES: ClassVar[Mapping[Status, str]] = {
        Status.MARGINAL: "Marginal: the margin is zero to within the tolerance, so any disturbance may break the "
        "grasp.",
        Status.INVALID: "Invalid: the numbers are not a grasp (NaN or infinite entry, zero-length normal, negative "
        "friction, or no active contact).",
    }

    @property
    def margin(self) -> Float[Array, "*batch"]:
        """t* as far as it is proven: ``lower``. Its gradient is that of t*."""
        return self.lower

    @property
    def gap(self) -> Float[Array, "*batch"]:
        """``upper - lower``: how far t* may be above ``margin``; 0 where both are infinite."""
        return bracket_width(self.lower, self.upper)

    def values(self, index: int | tuple[int, ...] = ()) -> str:
        """Margin and rank of one lane in words."""
        lower, upper, rank = (np.asarray(x)[index] for x in (self.lower, self.upper, self.rank))
        return "" if np.isnan(lower) else f"Margin between {lower:.6g} and {upper:.6g}, rank {rank}."


class _Plan(NamedTuple):
    """What is fixed at trace time."""

    components: tuple[Component, ...]
    dimension: int
    verdict_only: bool
    width: int
    with_point: bool  # keep the primal-dual point, for derivatives

    @property
    def budgets(self) -> tuple[int, ...]:
        """Iterations of each sweep."""
        return VERDICT_BUDGETS if self.verdict_only else BUDGETS


def _room_for_rounding(folded: Folded, sigma: Array) -> Array:
    """The margin from which on ``judge`` will certify a yes; infinite where full rank is not proven."""
    unit = rounding_constant() * unit_roundoff(folded.norm.dtype) * folded.norm * folded.count
    return jnp.where(
        sigma > 0, 8 * unit / jnp.where(sigma > 0, sigma, jnp.ones_like(sigma)), jnp.full_like(unit, jnp.inf)
    )


def _decision(folded: Folded, sigma: Array) -> Callable[[LinearConeProgram, LinearPoint], Array]:
    """Whether the bracket proves a yes or a no, with the room for rounding that ``judge`` will ask for."""
    room = _room_for_rounding(folded, sigma)  # for a no, too: the twist L^-T y is at most |y| / sigma long

    def decided(program: LinearConeProgram, point: LinearPoint) -> Array:
        lower = -program.primal_value(point.u)
        upper = -program.dual_value(point.y)
        return (lower > room) | (upper < -room * vector_norm(point.y))

    return decided


class _Progress(NamedTuple):
    """What a sweep over the tiles leaves behind, as rows; the last two only where derivatives may be wanted.

    doubtful     int32, 1 where only singular values, not asked for yet, can tell the rank
    multipliers  (m,) of A itself, where those of the state belong to its orthonormal rows
    """

    state: LinearState
    verdict: Verdict
    doubtful: Array
    scales: Scales | None
    multipliers: Array | None


class _Lanes(NamedTuple):
    """A tile at work: the contacts, where its lanes begin, their program, and their rank as far as it is known."""

    tile: Tile
    start: Start
    program: LinearConeProgram
    rank: Rank

    @classmethod
    def of(cls, plan: _Plan, contacts: Contacts, ranks: Rank) -> _Lanes:
        tile = tile_of(contacts, plan.components, plan.dimension)
        start = starting_point(tile.folded, tile.projection)
        return cls(tile, start, margin_program(tile.projection.basis), jax.tree.map(to_lanes, ranks))

    @property
    def doubtful(self) -> Array:
        """(L,) bool: the rank is not known yet."""
        return (self.tile.projection.sigma <= 0) & (self.rank.count < 0)

    @property
    def deficient(self) -> Array:
        """(L,) bool: some numbers within rounding of the grasp's have not full rank, and nor has A."""
        asked = (self.tile.projection.sigma <= 0) & (self.rank.count >= 0)
        return asked & (self.rank.count < wrench_dimension(self.tile.dimension)) & unnoticed(self.rank)

    @property
    def sigma(self) -> Array:
        """(L,) a lower bound of the smallest singular value of A; 0 where there is none."""
        sigma = self.tile.projection.sigma
        full = ~self.doubtful & (self.rank.count >= wrench_dimension(self.tile.dimension))
        return jnp.where((sigma <= 0) & full, self.rank.smallest, sigma)


def _stopped(state: LinearState, decided: Array) -> LinearState:
    """DECIDED instead of RUNNING in the lanes of ``decided``."""
    running = state.stop == Status.RUNNING.value
    return state._replace(stop=jnp.where(running & decided, jnp.int32(Status.DECIDED.value), state.stop))


def _begin(plan: _Plan, lanes: _Lanes) -> LinearState:
    """The state before the first step; what the projection of unit forces decides needs none."""
    folded, start = lanes.tile.folded, lanes.start
    refuted = start.unbounded | (start.escape if plan.verdict_only else jnp.zeros_like(start.escape))
    dual = jnp.where(refuted, start.point.y, jnp.zeros_like(start.point.y))
    state = begin_linear_cone_program(lanes.program, start.point._replace(y=dual), ~folded.valid | refuted)
    if not plan.verdict_only:
        return state
    return _stopped(state, start.lower > _room_for_rounding(folded, lanes.tile.projection.sigma))


def _progress(plan: _Plan, lanes: _Lanes, state: LinearState, tolerance: Array) -> _Progress:
    """The answers at ``state``."""
    tile, point = lanes.tile, state.point
    verdict = judge(tile, lanes.rank, point.u, point.y, lanes.start.unbounded, tolerance)
    scales = multipliers = None
    if plan.with_point:
        scales = Scales(tile.folded.length, tile.projection.factor)
        multipliers = to_twist(tile.projection, point.y)
    doubtful = lanes.doubtful.astype(jnp.int32)
    return jax.tree.map(to_rows, _Progress(state, verdict, doubtful, scales, multipliers))


def _advance(
    plan: _Plan, contacts: Contacts, ranks: Rank, before: LinearState, sweep: Array, tolerance: Array
) -> _Progress:
    """A tile's whole way, from its contacts to its answers; one program for first steps and stragglers alike."""
    lanes = _Lanes.of(plan, contacts, ranks)
    state = jax.tree.map(
        lambda new, old: jnp.where(sweep == 0, new, to_lanes(old)), _begin(plan, lanes), before
    )
    decided = None
    if plan.verdict_only:
        # A rank-deficient grasp has its verdict; only its margin is left to find.
        state = _stopped(state, lanes.deficient)
        decided = _decision(lanes.tile.folded, lanes.sigma)
    budget = jnp.asarray(plan.budgets, jnp.int32)[sweep]
    state = solve_linear_cone_program(lanes.program, state, tolerance, budget, decided)
    return _progress(plan, lanes, state, tolerance)


def _solve_rows(plan: _Plan, contacts: Contacts, count: Array, tolerance: Array) -> Solved:
    """All sweeps over the first ``count`` of (N, ..) rows; N is a multiple of the tile width."""
    n, m, dtype = contacts.position.shape[0], wrench_dimension(plan.dimension), contacts.position.dtype
    unknown = Rank(jnp.full(n, -1, dtype), jnp.zeros(n, dtype), jnp.zeros((n, m), dtype), jnp.ones(n, dtype))
    rank_of = rank_kernel(plan.components)

    def step(contacts: Contacts, ranks: Rank, progress: _Progress, sweep: Array) -> _Progress:
        return _advance(plan, contacts, ranks, progress.state, sweep, tolerance)

    def unfinished(progress: _Progress) -> Array:
        return (progress.state.stop == Status.RUNNING.value) | (progress.doubtful > 0)

    def between(ranks: Rank, progress: _Progress) -> Rank:
        return map_selected(rank_of, progress.doubtful > 0, contacts, ranks, plan.width)

    def first(contacts: Contacts, ranks: Rank) -> _Progress:
        lanes = _Lanes.of(plan, contacts, ranks)
        return _progress(plan, lanes, _begin(plan, lanes), tolerance)

    sweeps = Sweeps(step, unfinished, len(plan.budgets), between)
    shapes = jax.eval_shape(first, contacts, unknown)
    state, verdict, _, scales, y = in_sweeps(sweeps, contacts, unknown, shapes, count, plan.width)
    point = None
    if y is not None:
        point = (y, jnp.stack(state.point.u, 1), jnp.stack(state.point.z, 1))
    return Solved(verdict, state.iterations, state.stop, point, scales)


def _second_rows(plan: _Plan, contacts: Contacts, first: Verdict, tolerance: Array) -> Verdict:
    """``first`` with a second attempt at the rows it leaves undecided.

    No kernel: the sums of pairs are reductions, which a kernel cannot hold, and few rows come here.
    """

    def run(rows: tuple[Contacts, Verdict]) -> Verdict:
        contacts, first = rows[0], jax.tree.map(to_lanes, rows[1])
        length = fold(contacts, plan.components).length
        found = second_attempt(plan.components, plan.dimension, contacts, length, first, tolerance)
        return jax.tree.map(to_rows, found)

    undecided = first.status == Status.UNDECIDED.value
    return map_selected(run, undecided, (contacts, first), first, plan.width)


def _answer(solved: Solved) -> WrenchResistance:
    found = solved.verdict
    rank = jnp.where(jnp.isnan(found.rank), -1, found.rank).astype(jnp.int32)
    return WrenchResistance(
        found.status,
        found.margin,
        found.upper,
        rank,
        found.internal_force,
        found.escape_twist,
        found.bound_twist,
        solved.iterations,
        solved.stop,
    )


@functools.cache
def _compiled(plan: _Plan) -> Callable[..., WrenchResistance]:
    def rows(contacts: Contacts, count: Array, tolerance: Array) -> Solved:
        solved = _solve_rows(plan, contacts, count, tolerance)
        return solved._replace(verdict=_second_rows(plan, contacts, solved.verdict, tolerance))

    solve = batched(rows, lambda rows: rows.active.shape[:-1], plan.width)
    run = differentiable(solve, plan.components, not plan.verdict_only, plan.width)

    def result(contacts: Contacts, tolerance: Array) -> WrenchResistance:
        solved = run(contacts, tolerance)
        return _answer(solved)

    return jax.jit(result)


@functools.partial(jax.jit, static_argnames=("plan",))
def _solve_chunk(plan: _Plan, contacts: Contacts, count: Array, tolerance: Array) -> Solved:
    return _solve_rows(plan, contacts, count, tolerance)


@functools.partial(jax.jit, static_argnames=("plan",))
def _second_chunk(plan: _Plan, contacts: Contacts, first: Verdict, tolerance: Array) -> Verdict:
    return _second_rows(plan, contacts, first, tolerance)


def _solve_on_host(plan: _Plan, contacts: Contacts, tolerance: Array) -> WrenchResistance:
    """The same programs one after the other, so that the second is compiled only where a lane needs it."""

    def solve(rows: Contacts, count: Array) -> WrenchResistance:
        solved = _solve_chunk(plan, rows, count, tolerance)
        if np.any(np.asarray(solved.verdict.status) == Status.UNDECIDED.value):
            solved = solved._replace(verdict=_second_chunk(plan, rows, solved.verdict, tolerance))
        return _answer(solved)

    return in_chunks(solve, contacts, contacts.active.shape[:-1], CHUNK)


def wrench_resistance(
    grasp: Grasp, *, tolerance: float = 1e-8, verdict_only: bool = False
) -> WrenchResistance:
    """Wrench resistance (force closure) of a batch of grasps, with margin and proof (Theorem 1, Prop. 11.2.2).

        t* = max t   subject to   G f = 0,   f_n,i - psi_i(f_i) >= t for all i,   sum_i f_n,i = k

    A grasp is resistant iff its folded grasp map has rank m and t* > 0.

    grasp         a ``Grasp`` with any batch axes; works under ``jax.jit`` and ``jax.vmap``
    tolerance     width of the bracket [lower, upper] to reach, relative to max(1, |t*|); float32 usually
                  closes it to about 1e-3. Enable 64-bit JAX (``jax_enable_x64``) for float64.
    verdict_only  stop each grasp as soon as a certificate exists: faster, with a wider bracket

    Returns a ``WrenchResistance``. Bad numbers make their own lane INVALID; nothing raises inside. Wrong types raise
    ValueError. Sources: theory of the chapter, Han, Trinkle, Li 2000 (LMI), Boyd, Wegbreit 2007 (certificates).
    """
    if not isinstance(grasp, Grasp):
        raise ValueError(f"wrench_resistance takes a jaxgrasp.Grasp, got {type(grasp).__name__}")
    if isinstance(tolerance, int | float) and not tolerance > 0:
        raise ValueError(f"tolerance must be positive, got {tolerance}")
    contacts = contacts_of(grasp)
    components = grasp.model.components(grasp.dimension)
    width = tile_width(wrench_dimension(grasp.dimension) * grasp.contacts * len(components))
    plan = _Plan(components, grasp.dimension, bool(verdict_only), width, False)
    goal = gap_goal(tolerance, grasp.dtype)
    traced = is_traced((contacts, goal))
    if traced or jax.default_backend() != "cpu":
        return _compiled(plan._replace(with_point=not verdict_only))(contacts, goal)
    return _solve_on_host(plan, contacts, goal)
