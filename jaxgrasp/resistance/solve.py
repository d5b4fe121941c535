"""11.1-11.2: is the grasp wrench resistant (force closure), by how much, and why.

One grasp's way: fold mu and gamma into its grasp map (``contacts.fold``); project unit normal forces onto the internal
forces, which decides many grasps at once and starts the rest (``problem.starting_point``); close the bracket around the
margin (``conic``); certify (``verdict.judge``). Three sweeps over the tiles: everyone for a few iterations,
then the stragglers, then the answers; grasps of doubtful rank get their singular values in between.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from typing import ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from ..backend import (
    batched,
    in_chunks,
    is_traced,
    kernel,
    map_selected,
    map_tiles,
    tile_width,
    to_lanes,
    to_rows,
)
from ..certificates import check_resistance, checked_by
from ..conic import (
    LinearConeProgram,
    LinearPoint,
    LinearState,
    begin_linear_cone_program,
    cone_max,
    cone_sum,
    row_svd,
    solve_linear_cone_program,
)
from ..contacts import Component, Contacts, Folded, Grasp, contacts_of, fold, project, tile_of, to_twist
from ..core import (
    Answer,
    Array,
    Float,
    Int,
    Status,
    gap_floor,
    rank_tolerance,
    rounding_constant,
    unit_roundoff,
    wrench_dimension,
)
from .derivatives import Scales, Solved, differentiable
from .problem import margin_program, starting_point
from .verdict import Rank, Verdict, judge

__all__ = ["WrenchResistance", "wrench_resistance"]

FIRST_BUDGET = 8  # iterations before stragglers are gathered: most lanes need 6 to 8 ...
VERDICT_BUDGET = 2  # ... and most verdicts none, one or two
TOTAL_BUDGET = 60
CHUNK = 4096  # grasps an executable takes at once when called on concrete arrays


@checked_by(lambda grasp, answer, problem, tolerance: check_resistance(grasp, answer, tolerance))
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
    iterations      int32 interior-point iterations spent
    stop            int32, a ``Status``: why the iteration ended
    """

    status: Int[Array, "*batch"]
    lower: Float[Array, "*batch"]
    upper: Float[Array, "*batch"]
    rank: Int[Array, "*batch"]
    internal_force: Float[Array, "*batch kn"]
    escape_twist: Float[Array, "*batch m"]
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
        same = self.lower == self.upper
        return jnp.where(same, jnp.zeros_like(self.lower), self.upper - self.lower)

    def values(self, index: int | tuple[int, ...] = ()) -> str:
        """Margin and rank of one lane in words."""
        lower, upper, rank = (np.asarray(x)[index] for x in (self.lower, self.upper, self.rank))
        return "" if np.isnan(lower) else f"Margin between {lower:.6g} and {upper:.6g}, rank {rank}."


class _State(NamedTuple):
    """A lane between sweeps, as rows."""

    y: Array
    u: Array
    z: Array
    gap: Array
    iterations: Array
    stalled: Array
    stop: Array

    @classmethod
    def pack(cls, progress: LinearState) -> _State:
        y, u, z = (to_rows(jnp.stack(part)) for part in progress.point)
        return cls(y, u, z, progress.gap, progress.iterations, progress.stalled, progress.stop)

    def unpack(self) -> LinearState:
        parts = [to_lanes(x) for x in (self.y, self.u, self.z)]
        iterate = LinearPoint(*(tuple(x[i] for i in range(x.shape[0])) for x in parts))
        return LinearState(iterate, self.gap, self.iterations, self.stalled, self.stop)


class _Plan(NamedTuple):
    """What is fixed at trace time."""

    components: tuple[Component, ...]
    dimension: int
    verdict_only: bool
    width: int
    with_point: bool  # keep the primal-dual point, for derivatives


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
        square = point.y[0] * point.y[0]
        for v in point.y[1:]:
            square = square + v * v
        return (lower > room) | (upper < -room * jnp.sqrt(square))

    return decided


class _Setup(NamedTuple):
    """What the projection of unit forces shows, as rows."""

    state: _State
    sigma: Array  # proven lower bound of the smallest singular value, or 0
    unbounded: Array  # t* = -inf


def _setup_kernel(plan: _Plan) -> Callable[[Contacts], _Setup]:
    @kernel
    def run(contacts: Contacts) -> _Setup:
        folded = fold(contacts, plan.components)
        projection = project(folded)
        start = starting_point(folded, projection)
        program = margin_program(projection.basis)
        refuted = start.unbounded | (start.escape if plan.verdict_only else jnp.zeros_like(start.escape))
        dual = tuple(jnp.where(refuted, v, jnp.zeros_like(v)) for v in start.point.y)
        state = begin_linear_cone_program(program, start.point._replace(y=dual), ~folded.valid | refuted)
        if plan.verdict_only:
            proven = start.lower > _room_for_rounding(folded, projection.sigma)
            stop = jnp.where(proven, jnp.int32(Status.DECIDED.value), state.stop)
            state = state._replace(stop=jnp.where(state.stop == Status.RUNNING.value, stop, state.stop))
        return _Setup(_State.pack(state), projection.sigma, start.unbounded)

    return run


def _iterate_kernel(plan: _Plan) -> Callable[..., _State]:
    @kernel
    def run(contacts: Contacts, rows: _State, sigma: Array, budget: Array, tolerance: Array) -> _State:
        folded = fold(contacts, plan.components)
        program = margin_program(project(folded).basis)
        decided = _decision(folded, sigma) if plan.verdict_only else None
        return _State.pack(solve_linear_cone_program(program, rows.unpack(), tolerance, budget, decided))

    return run


def _rank_kernel(plan: _Plan) -> Callable[[Contacts], Rank]:
    @kernel
    def run(contacts: Contacts) -> Rank:
        folded = fold(contacts, plan.components)
        A = jnp.concatenate(folded.columns, axis=1)
        svd = row_svd(A)
        smallest, null = svd.smallest()
        largest = cone_max(svd.values)
        count = cone_sum((svd.values > rank_tolerance(A.dtype) * largest).astype(A.dtype))
        return Rank(count, smallest, to_rows(null))

    return run


class _Reading(NamedTuple):
    """A lane's answer, as rows; the last two only where derivatives may be wanted."""

    verdict: Verdict
    scales: Scales | None
    multipliers: Array | None


def _answer_kernel(plan: _Plan) -> Callable[..., _Reading]:
    @kernel
    def run(
        contacts: Contacts, rows: _State, unbounded: Array, rank_rows: Rank, tolerance: Array
    ) -> _Reading:
        tile = tile_of(contacts, plan.components, plan.dimension)
        point = rows.unpack().point
        rank = rank_rows._replace(null_twist=to_lanes(rank_rows.null_twist))
        verdict = judge(tile, rank, point.u, point.y, unbounded, tolerance)
        scales = multipliers = None
        if plan.with_point:
            scales = Scales(tile.folded.length, tile.projection.factor)
            multipliers = jnp.stack(to_twist(tile.projection, point.y))
        return jax.tree.map(to_rows, _Reading(verdict, scales, multipliers))

    return run


def _solve_rows(plan: _Plan, contacts: Contacts, count: Array, tolerance: Array) -> Solved:
    """All sweeps over the first ``count`` of (N, ..) rows; N is a multiple of the tile width."""
    m = wrench_dimension(plan.dimension)
    n, dtype, width = contacts.position.shape[0], contacts.position.dtype, plan.width
    setup = map_tiles(_setup_kernel(plan), contacts, count, width)

    exists = jnp.arange(n, dtype=jnp.int32) < count

    doubtful = exists & (setup.sigma <= 0)
    ranks = Rank(jnp.full(n, m, dtype), setup.sigma, jnp.zeros((n, m), dtype))
    ranks = map_selected(_rank_kernel(plan), doubtful, contacts, ranks, width)
    full_rank = ranks.count >= m
    sigma = jnp.where(doubtful & full_rank, ranks.smallest, setup.sigma)

    iterate = _iterate_kernel(plan)
    first = VERDICT_BUDGET if plan.verdict_only else FIRST_BUDGET
    budgets = jnp.array([first, TOTAL_BUDGET - first], jnp.int32)

    def one_round(i: Array, state: _State) -> _State:
        # A rank-deficient grasp has its verdict; only its margin is left to find.
        unfinished = exists & (state.stop == Status.RUNNING.value)
        if plan.verdict_only:
            unfinished = unfinished & full_rank
        budget = budgets[i]
        return map_selected(
            lambda tile: iterate(*tile, budget, tolerance), unfinished, (contacts, state, sigma), state, width
        )

    state = lax.fori_loop(0, len(budgets), one_round, setup.state)
    answer = _answer_kernel(plan)
    rows = (contacts, state, setup.unbounded, ranks)
    read = map_tiles(lambda tile: answer(*tile, tolerance), rows, count, width)
    point = None if read.multipliers is None else (read.multipliers, state.u, state.z)
    return Solved(read.verdict, state.iterations, state.stop, point, read.scales)


def _answer(solved: Solved) -> WrenchResistance:
    found = solved.verdict
    rank = jnp.where(jnp.isnan(found.rank), -1, found.rank).astype(jnp.int32)
    return WrenchResistance(
        found.status,
        found.margin,
        found.margin + found.gap,
        rank,
        found.internal_force,
        found.escape_twist,
        solved.iterations,
        solved.stop,
    )


@functools.cache
def _compiled(plan: _Plan) -> Callable[..., WrenchResistance]:
    solve = batched(functools.partial(_solve_rows, plan), lambda rows: rows.active.shape[:-1], plan.width)
    run = differentiable(solve, plan.components, not plan.verdict_only, plan.width)

    def result(contacts: Contacts, tolerance: Array) -> WrenchResistance:
        solved = run(contacts, tolerance)
        return _answer(solved)

    return jax.jit(result)


@functools.partial(jax.jit, static_argnames=("plan",))
def _solve_chunk(plan: _Plan, contacts: Contacts, count: Array, tolerance: Array) -> WrenchResistance:
    return _answer(_solve_rows(plan, contacts, count, tolerance))


def _solve_on_host(plan: _Plan, contacts: Contacts, tolerance: Array) -> WrenchResistance:
    def solve(rows: Contacts, count: Array) -> WrenchResistance:
        return _solve_chunk(plan, rows, count, tolerance)

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
    components = grasp.model.components(grasp.dimension)
    width = tile_width(wrench_dimension(grasp.dimension) * grasp.contacts * len(components))
    plan = _Plan(components, grasp.dimension, bool(verdict_only), width, False)
    floor = gap_floor(grasp.dtype)
    goal = jnp.maximum(jnp.asarray(tolerance, grasp.dtype), jnp.asarray(floor, grasp.dtype))
    contacts = contacts_of(grasp)
    traced = is_traced((contacts, goal))
    if traced or jax.default_backend() != "cpu":
        return _compiled(plan._replace(with_point=not verdict_only))(contacts, goal)
    return _solve_on_host(plan, contacts, goal)
