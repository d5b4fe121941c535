"""How much friction a grasp needs: the factor on all friction coefficients at which it becomes wrench resistant.

    alpha* = inf {alpha > 0 : the grasp with alpha mu_i, gamma_i is wrench resistant}

More friction widens every cone, so the verdicts change once. The margin t*(alpha) crosses zero there: a safeguarded
secant method on log alpha closes a bracket whose two ends carry verdicts of their own. The derivative is that of the
implicit function, d alpha* = -(dt* / dtheta) / (dt* / dalpha) dtheta, and of any order.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.typing import ArrayLike

from ..backend import is_traced, while_loop
from ..contacts import ContactModel, Grasp
from ..core import Answer, Array, Float, Int, Status, nan_where, real_array, wrench_dimension
from ..resistance import WrenchResistance, wrench_resistance

__all__ = ["CriticalFriction", "critical_friction", "friction_sweep", "with_friction_factor"]

LEAST, MOST = 1e-6, 1e6  # factors searched: less counts as 0, more as infinity
HALVED, ROUNDS = 6, 70
SLOPE_TOLERANCE = 1e-12  # of the margin whose derivatives make the factor's: they are good to about its root


class CriticalFriction(Answer):
    """The critical factor of each grasp between two proven ends; no unit.

    status           int32, a ``Status`` of the grasp as it is: RESISTANT (upper <= 1), NOT_RESISTANT (lower >= 1),
                     MARGINAL where 1 lies between, INVALID
    factor           (*batch) alpha*; 0 where any friction will do, infinite where none up to 1e6 does, NaN where
                     INVALID. ``factor * mu`` is the least friction; above 1 the grasp does not hold as it is
    lower, upper     (*batch) not resistant at ``lower``, resistant at ``upper``: verdicts with certificates for
                     ``with_friction_factor(grasp, lower)`` and the same with ``upper``
    """

    status: Int[Array, "*batch"]
    factor: Float[Array, "*batch"]
    lower: Float[Array, "*batch"]
    upper: Float[Array, "*batch"]

    SENTENCES: ClassVar[Mapping[Status, str]] = {
        Status.RESISTANT: "Holds as it is: less friction would do.",
        Status.NOT_RESISTANT: "Does not hold as it is: it needs more friction, or no friction is enough.",
        Status.MARGINAL: "Marginal: the friction it has is what it needs, to within the tolerance.",
    }

    def values(self, index: int | tuple[int, ...] = ()) -> str:
        """The factor of one lane in words."""
        factor = np.asarray(self.factor)[index]
        return "" if np.isnan(factor) else f"It holds from {factor:.6g} times its friction on."


def with_friction_factor(grasp: Grasp, factor: Float[ArrayLike, "*batch"]) -> Grasp:
    """The grasp with ``factor * mu`` for every mu, gamma unchanged; ``factor`` a number or one a grasp."""
    return _rougher(grasp, real_array(factor, "factor").astype(grasp.dtype))


@eqx.filter_jit
def _rougher(grasp: Grasp, factor: Array) -> Grasp:
    scale = jnp.broadcast_to(factor, grasp.batch_shape)[..., None]
    model = grasp.model
    changed = model.with_coefficients(scale * model.friction_coefficient, model.torsion_coefficient)
    return Grasp(grasp.position, grasp.normal, changed, grasp.active)


def friction_sweep(
    grasp: Grasp, factors: Float[ArrayLike, " T"], *, verdict_only: bool = False
) -> WrenchResistance:
    """The verdicts at each of T factors on all mu, in one call: a ``WrenchResistance`` with batch axes (*batch, T)."""
    array = real_array(factors, "factors", "a list of numbers").astype(grasp.dtype)
    if array.ndim != 1:
        raise ValueError(f"factors must be a list of numbers, shape (T,), got {array.shape}")

    axis = len(grasp.batch_shape)
    wide = jax.tree.map(lambda x: jnp.repeat(jnp.expand_dims(x, axis), array.shape[0], axis), grasp)
    return wrench_resistance(with_friction_factor(wide, array), verdict_only=verdict_only)


class _Bracket(NamedTuple):
    """log alpha of both ends, the margins there (the older one damped), and which end moved last."""

    low: Array
    high: Array
    below: Array  # margin at low, < 0
    above: Array  # margin at high, > 0
    moved: Array  # -1 low, 1 high
    round: Array


def _margin(grasp: Grasp, log_factor: Array) -> Array:
    """t* at a factor, at least -1 and not 0; -1 as well where the rank rules resistance out."""
    verdict = wrench_resistance(with_friction_factor(grasp, jnp.exp(log_factor)))
    return _kept(verdict.status, verdict.lower, verdict.rank, wrench_dimension(grasp.dimension))


@functools.partial(jax.jit, static_argnames="full")
def _kept(status: Array, margin: Array, rank: Array, full: int) -> Array:
    margin = jnp.where(status == Status.RESISTANT.value, margin, jnp.minimum(margin, -1e-12))
    return jnp.where((rank >= 0) & (rank < full), -1.0, jnp.maximum(margin, -1.0))


def _width(dtype) -> float:
    return 5e-7 if jnp.dtype(dtype).itemsize == 8 else 1e-3


@functools.partial(jax.jit, static_argnames="width")
def _next(bracket: _Bracket, width: float) -> Array:
    """The middle of the first rounds and of every other one; between them the secant, pushed past the root.

    The push makes the far end follow. Halving alone would need 26 rounds; with it the worst case is twice that.
    """
    span = bracket.high - bracket.low
    share = -bracket.below / jnp.where(bracket.above > bracket.below, bracket.above - bracket.below, 1.0)
    secant = bracket.low + span * jnp.clip(share, 0.0, 1.0)
    push = jnp.where(share > 0.5, -0.4 * width, 0.4 * width)
    inside = jnp.clip(secant + push, bracket.low + 0.3 * width, bracket.high - 0.3 * width)
    middle = bracket.low + span / 2
    bisect = (bracket.round < HALVED) | (bracket.round % 2 == 0)
    return jnp.where(bisect, middle, inside)


@functools.partial(jax.jit, static_argnames="width")
def _advance(bracket: _Bracket, at: Array, value: Array, width: float) -> _Bracket:
    """The bracket with one end at ``at``; the margin of an end that stays a second time is halved (Illinois)."""
    open_ = bracket.high - bracket.low > width
    up = value > 0
    below = jnp.where(up, jnp.where(bracket.moved == 1, bracket.below / 2, bracket.below), value)
    above = jnp.where(up, value, jnp.where(bracket.moved == -1, bracket.above / 2, bracket.above))
    new = _Bracket(
        jnp.where(up, bracket.low, at), jnp.where(up, at, bracket.high), below, above,
        jnp.where(up, jnp.int32(1), jnp.int32(-1)), bracket.round + 1,
    )  # fmt: skip
    return jax.tree.map(lambda a, b: jnp.where(open_, a, b), new, bracket)


def _search(grasp: Grasp, loop: Callable[..., Any]) -> tuple[Array, Array]:
    """log alpha at both ends; (-inf, log LEAST) where any friction will do, (log MOST, inf) where none does.

    NaN where INVALID.
    """
    shape, dtype = grasp.batch_shape, grasp.dtype
    width = _width(dtype)
    low, high = (jnp.asarray(np.full(shape, np.log(x)), dtype) for x in (LEAST, MOST))
    below, above = _margin(grasp, low), _margin(grasp, high)
    start = _begin(low, high, below, above)

    def unfinished(bracket: _Bracket) -> Array:
        return _open(bracket, width)

    def step(bracket: _Bracket) -> _Bracket:
        at = _next(bracket, width)
        return _advance(bracket, at, _margin(grasp, at), width)

    return _ends(loop(unfinished, step, start), below, above)


@jax.jit
def _begin(low: Array, high: Array, below: Array, above: Array) -> _Bracket:
    """Between ``low`` and ``high``; closed at once where even the least friction will do, or the most does not."""
    always, never = below > 0, ~(above > 0)
    zero = jnp.zeros(low.shape, jnp.int32)
    at_low = jnp.where(always | never, high, low)
    return _Bracket(at_low, high, jnp.where(always, -1.0, below), jnp.where(never, 1.0, above), zero, zero)


@functools.partial(jax.jit, static_argnames="width")
def _open(bracket: _Bracket, width: float) -> Array:
    return jnp.any((bracket.high - bracket.low > width) & (bracket.round < ROUNDS))


@jax.jit
def _ends(end: _Bracket, below: Array, above: Array) -> tuple[Array, Array]:
    """Both ends, from the bracket and the margins at the least and the most friction."""
    always, never = below > 0, ~(above > 0)
    nan = nan_where(jnp.isnan(above), jnp.zeros_like(above))
    lower = jnp.where(always, -jnp.inf, jnp.where(never, jnp.log(MOST), end.low))
    upper = jnp.where(always, jnp.log(LEAST), jnp.where(never, jnp.inf, end.high))
    return lower + nan, upper + nan


def _python_loop(unfinished, step, state):
    while bool(unfinished(state)):
        state = step(state)
    return state


class _Data(NamedTuple):
    """What the critical factor is differentiated by."""

    position: Array
    normal: Array
    friction: Array
    torsion: Array


def _data(grasp: Grasp) -> _Data:
    model = grasp.model
    return _Data(grasp.position, grasp.normal, model.friction_coefficient, model.torsion_coefficient)


def _grasp(data: _Data, model: ContactModel, active: Array) -> Grasp:
    return Grasp(data.position, data.normal, model.with_coefficients(data.friction, data.torsion), active)


@jax.custom_jvp
def _critical(data: _Data, model: ContactModel, active: Array) -> tuple[Array, Array, Array]:
    grasp = _grasp(data, model, active)
    traced = is_traced(grasp)
    return _factors(*_search(grasp, while_loop if traced else _python_loop))


@jax.jit
def _factors(low: Array, high: Array) -> tuple[Array, Array, Array]:
    """The factor and its bracket from the logarithms of both ends."""
    lower, upper = jnp.exp(low), jnp.exp(high)
    factor = jnp.exp((low + high) / 2)
    factor = jnp.where(jnp.isneginf(low), 0.0, jnp.where(jnp.isposinf(high), jnp.inf, factor))
    return factor, jnp.where(jnp.isneginf(low), 0.0, lower), upper


@_critical.defjvp
def _critical_jvp(primals, tangents):
    data, model, active = primals
    factor, lower, upper = _critical(data, model, active)
    inside = jnp.isfinite(factor) & (factor > 0)
    at = jnp.where(inside, factor, 1.0)

    def margin(data: _Data, factor: Array) -> Array:
        moved = with_friction_factor(_grasp(data, model, active), factor)
        return wrench_resistance(moved, tolerance=SLOPE_TOLERANCE).margin

    _, by_data = jax.jvp(lambda d: margin(d, at), (data,), (tangents[0],))
    _, by_factor = jax.jvp(lambda a: margin(data, a), (at,), (jnp.ones_like(at),))
    sound = inside & (by_factor > 0)
    change = jnp.where(sound, -by_data / jnp.where(sound, by_factor, 1.0), 0.0)
    still = jnp.zeros_like(lower)
    return (factor, lower, upper), (change, still, still)


def critical_friction(grasp: Grasp) -> CriticalFriction:
    """``alpha* = inf {alpha : resistant with alpha mu}``: how many times its friction a grasp needs, to 1e-6.

    grasp  a ``Grasp`` with any batch axes; works under ``jax.jit`` and ``jax.vmap``. gamma stays as it is

    ``factor`` is differentiable to any order with respect to positions, normals, mu and gamma; its derivative is zero
    where it is 0 or infinite. float32 reaches about 1e-3. Two planar fingers: tan(largest angle between normal and
    joining line) / mu (Nguyen 1988).
    """
    if not isinstance(grasp, Grasp):
        raise ValueError(f"critical_friction takes a jaxgrasp.Grasp, got {type(grasp).__name__}")
    still = jax.tree.map(lax.stop_gradient, grasp)
    return _answer(*_critical(_data(grasp), still.model, grasp.active))


@jax.jit
def _answer(factor: Array, lower: Array, upper: Array) -> CriticalFriction:
    status = jnp.where(upper <= 1, Status.RESISTANT.value, Status.MARGINAL.value)
    status = jnp.where(lower >= 1, Status.NOT_RESISTANT.value, status)
    status = jnp.where(jnp.isnan(factor), Status.INVALID.value, status).astype(jnp.int32)
    return CriticalFriction(status, factor, lower, upper)
