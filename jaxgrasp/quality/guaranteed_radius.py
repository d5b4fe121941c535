"""How far contacts, normals and friction may be off before a verdict can change: a radius no perturbation beats.

    r:  |dp_i| <= r L,  |dn_i| <= r,  |dmu_i| <= r mu_i for all contacts at once  =>  the same verdict

(n_i + dn_i is scaled to unit length again, gamma stays.) The frame of a contact turns by at most asin r: a chord of
c(r) = |R - I|. With w = (F; tau / L), P_i = p_i / L and K_i F = (F; P_i x F):

RESISTANT      The internal forces f of the margin turn with their contacts. What they leave, sum_i e_i with
               e_i = K_i (R_i - I) F_i + (0; dP_i x R_i F_i + (R_i - I) n_i tau_i / L), is made up for by
               -A^+ (1 + E A^+)^-1 e, E the change of A; contact j loses at most
                   sum_i sup_e (|(A^+)_j,t e_i| - (A^+)_j,0 e_i)  +  sqrt(2) |(A^+)_j| |e| q / (1 - q),   q >= |E A^+|
               of its depth s_0 - |s_t| / (1 - r). While q < 1 the rank stays full.
NOT_RESISTANT  The escape twist (v; L omega) still escapes: v_n loses at most c |v_i| + r |omega| of what it had, and
               |(mu v_t, gamma omega_n)| grows by no more, times mu (1 + r).

Both conditions are monotone in r: a bisection finds where they end, and the derivative is that of the implicit
function. Verdicts that rest on rank alone, MARGINAL and UNDECIDED ones have r = 0. The bound adds up worst cases that
seldom meet.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ..backend import fori_loop
from ..conic import pseudo_inverse, singular_values
from ..contacts import Grasp, cleared, length_scale
from ..core import (
    Answer,
    Array,
    Float,
    Int,
    Status,
    least_of,
    nan_where,
    normalize,
    rank_tolerance,
    safe_root,
)
from ..resistance import wrench_resistance
from .unit_wrench_space import effort_map, scaled

__all__ = ["GuaranteedRadius", "guaranteed_radius"]

HALVINGS = 60
LARGEST = 0.5  # beyond it the chord bound is of no use
TOLERANCE = 1e-12  # of the margin; forces and twists, and the derivative with them, are known to its root


class GuaranteedRadius(Answer):
    """``radius``: no change within it changes ``status``.

    status  int32, the ``Status`` of wrench resistance
    radius  (*batch) r, no unit: contacts may move by r * ``length``, normals by r, mu by r mu. 0 where nothing is
            guaranteed, NaN where INVALID
    length  (*batch) L in m, the largest distance of a contact from the centre of mass
    """

    status: Int[Array, "*batch"]
    radius: Float[Array, "*batch"]
    length: Float[Array, "*batch"]

    def values(self, index: int | tuple[int, ...] = ()) -> str:
        """The radius of one lane in words."""
        radius, length = (np.asarray(x)[index] for x in (self.radius, self.length))
        return "" if np.isnan(radius) else f"Contacts may be off by {radius:.4g}, or {radius * length:.4g} m."


class _Data(NamedTuple):
    """One grasp, lengths over L; A (k, m, n) with the normal column first."""

    A: Array
    position: Array  # (k, d)
    normal: Array  # (k, d)
    friction: Array  # (k,)
    torsion: Array  # (k,)
    active: Array  # (k,)
    force: Array  # (k, n) scaled, s
    twist: Array  # (m,) (v; L omega)


def _norm(x: Array, axis: int = -1) -> Array:
    return safe_root(jnp.sum(x * x, axis=axis))


def _spectral(matrix: Array) -> Array:
    """Largest singular value of (.., a, b); 0 for a = 0."""
    if matrix.shape[-2] == 0:
        return jnp.zeros(matrix.shape[:-2], matrix.dtype)
    return singular_values(matrix)[..., 0]


def _chord(r: Array) -> Array:
    """2 sin(asin(r) / 2)."""
    return jnp.sqrt(2 - 2 * jnp.sqrt(1 - r * r))


def _lever(position: Array) -> Array:
    """K_i = (1; P_i x), (k, m, d)."""
    k, d = position.shape
    eye = jnp.broadcast_to(jnp.eye(d, dtype=position.dtype), (k, d, d))
    if d == 2:
        moment = jnp.stack([-position[:, 1], position[:, 0]], axis=-1)[:, None, :]
    else:
        moment = jnp.cross(position[:, None, :], eye, axis=-1)  # rows: P x e_a
        moment = jnp.swapaxes(moment, 1, 2)
    return jnp.concatenate([eye, moment], axis=1)


class _Response(NamedTuple):
    """How far a unit of e_i moves the force of contact j through A^+, whatever the radius."""

    turned_head: Array  # (j, i) |(A^+)_j,0 K_i|
    turned_tail: Array  # (j, i) |(A^+)_j,t K_i|
    head: Array  # (j,) |(A^+)_j,0| on torques
    tail: Array  # (j,)
    own: Array  # (j,) |(A^+)_j|
    smallest: Array  # singular value of A


def _response(data: _Data, resistant: Array) -> _Response:
    A, d = data.A, data.position.shape[-1]
    k, m, n = A.shape
    wide = jnp.moveaxis(A, 0, 1).reshape(m, k * n)
    wide = jnp.where(resistant, wide, jnp.eye(m, k * n, dtype=A.dtype))  # elsewhere the rank may be too low
    inverse = pseudo_inverse(wide, rank_tolerance(A.dtype)).reshape(k, n, m)  # A^+, contact by contact
    turned = jnp.einsum("jnm,imd->jind", inverse, _lever(data.position))
    return _Response(
        _norm(turned[:, :, 0]),
        _spectral(turned[:, :, 1:]),
        _norm(inverse[:, 0, d:]),
        _spectral(inverse[:, 1:, d:]),
        safe_root(jnp.sum(inverse**2, axis=(1, 2))),
        singular_values(wide)[-1],
    )


def _resistant_slack(data: _Data, response: _Response, r: Array) -> Array:
    """The least depth left at radius r; positive: still resistant. Some finite number for grasps that never were."""
    A, active = data.A, data.active
    n, d = A.shape[-1], data.position.shape[-1]
    c = _chord(r)
    s = data.force
    mu, gamma = data.friction, data.torsion
    pull = safe_root(s[:, 0] ** 2 + (mu * _norm(s[:, 1 : min(n, d)])) ** 2)  # |F_i|
    spin = jnp.abs(gamma * s[:, 3]) if n == 4 else jnp.zeros_like(pull)
    moved = r * pull + c * spin  # the torque a displaced, turned contact adds, besides its lever
    # e_i and its size
    sizes = c * pull * jnp.sqrt(1 + jnp.sum(data.position**2, axis=-1)) + moved
    total = jnp.sum(jnp.where(active, sizes, 0.0))
    heads = c * pull * response.turned_head + moved * response.head[:, None]
    tails = c * pull * response.turned_tail + moved * response.tail[:, None]
    loss = jnp.sum(jnp.where(active[None, :], heads + tails, 0.0), axis=1)
    # |E A^+|
    most = jnp.maximum(1.0, mu * (1 + r))
    arm = jnp.sqrt(1 + jnp.sum(data.position**2, axis=-1))
    change = r * most + arm * (c * most + r * mu) + c * gamma
    change = jnp.sqrt(jnp.sum(jnp.where(active, change**2, 0.0)))
    q = change / response.smallest
    second = jnp.sqrt(jnp.asarray(2.0, A.dtype)) * response.own * total * q / jnp.where(q < 1, 1 - q, 1.0)
    depth = s[:, 0] - _norm(s[:, 1:]) / (1 - r) - loss - second
    depth = least_of(jnp.where(active, depth, jnp.inf))
    return jnp.where(q < 1, depth, -1.0)


def _escaping_slack(data: _Data, r: Array) -> Array:
    """The least room of the escape twist at radius r; positive: still not resistant."""
    d = data.position.shape[-1]
    c = _chord(r)
    omega = data.twist[d:]
    K = _lever(data.position)
    velocity = jnp.einsum("kmd,m->kd", K, data.twist)  # v + omega x P
    normal = jnp.sum(velocity * data.normal, axis=-1)
    tangential = _norm(velocity - normal[:, None] * data.normal)
    rate = _norm(omega)
    lost = c * _norm(velocity) + r * rate
    sliding = data.friction * (1 + r) * (tangential + lost)
    if d == 3:
        turning = data.torsion * (jnp.abs(data.normal @ omega) + c * rate)
        sliding = jnp.sqrt(sliding**2 + turning**2 + 1e-300)
    slack = normal - lost - sliding
    return least_of(jnp.where(data.active, slack, jnp.inf))


def _slack(data: _Data, response: _Response, resistant: Array, r: Array) -> Array:
    return jnp.where(resistant, _resistant_slack(data, response, r), _escaping_slack(data, r))


@jax.custom_jvp
def _radius(data: _Data, resistant: Array) -> Array:
    response = _response(data, resistant)

    def halve(_: int, ends: tuple[Array, Array]) -> tuple[Array, Array]:
        low, high = ends
        middle = (low + high) / 2
        good = _slack(data, response, resistant, middle) > 0
        return jnp.where(good, middle, low), jnp.where(good, high, middle)

    zero = jnp.zeros((), data.A.dtype)
    low, _ = fori_loop(0, HALVINGS, halve, (zero, zero + LARGEST), (data, resistant))
    return low


@_radius.defjvp
def _radius_jvp(primals, tangents):
    data, resistant = primals
    r = _radius(data, resistant)
    inside = (r > 0) & (r < 0.999 * LARGEST)
    at = jnp.where(inside, r, 0.25)

    def slack(data: _Data, r: Array) -> Array:
        return _slack(data, _response(data, resistant), resistant, r)

    _, by_data = jax.jvp(lambda x: slack(x, at), (data,), (tangents[0],))
    _, by_r = jax.jvp(lambda x: slack(data, x), (at,), (jnp.ones_like(at),))
    sound = inside & (by_r < 0)
    return r, jnp.where(sound, -by_data / jnp.where(sound, by_r, 1.0), 0.0)


def guaranteed_radius(grasp: Grasp) -> GuaranteedRadius:
    """``r`` such that ``|dp| <= r L, |dn| <= r, |dmu| <= r mu`` at all contacts cannot change the verdict; no unit.

    grasp  a ``Grasp`` with any batch axes; works under ``jax.jit`` and ``jax.vmap``

    A guarantee, not an estimate: the nearest change of verdict that we could find lies a few times further out (a
    median of 3 to 6 times on random grasps). Differentiable with respect to positions, normals, mu and gamma; kinks lie
    where another contact becomes the first to slip.
    """
    if not isinstance(grasp, Grasp):
        raise ValueError(f"guaranteed_radius takes a jaxgrasp.Grasp, got {type(grasp).__name__}")
    verdict = wrench_resistance(grasp, tolerance=TOLERANCE)
    data, kind, length = _problem(
        grasp, verdict.status, verdict.internal_force, verdict.escape_twist, verdict.margin
    )
    return GuaranteedRadius(verdict.status, _radii(data, kind).reshape(grasp.batch_shape), length)


class _Kind(NamedTuple):
    """(N,) bool: which guarantee a grasp gets; neither of the two where it rests on rank alone or is open."""

    valid: Array
    resistant: Array
    escaping: Array


@jax.jit
def _problem(
    grasp: Grasp, status: Array, force: Array, twist: Array, margin: Array
) -> tuple[_Data, _Kind, Array]:
    """The grasps as rows, harmless numbers where nothing is guaranteed; and L with the batch axes in front."""
    d, batch = grasp.dimension, grasp.batch_shape
    length = length_scale(grasp)
    valid = status != Status.INVALID.value
    resistant = status == Status.RESISTANT.value
    escaping = (status == Status.NOT_RESISTANT.value) & jnp.isfinite(margin)
    live = grasp.active & valid[..., None]

    def safe(x: Array, value: float) -> Array:
        return jnp.where(live.reshape(*live.shape, *([1] * (x.ndim - live.ndim))), x, value)

    harmless = cleared(grasp, live)
    over = harmless.position / length[..., None, None]
    normal = safe(normalize(harmless.normal), 0.0)
    s = scaled(grasp, safe(force.reshape(*batch, grasp.contacts, -1), 0.0).reshape(force.shape))
    scaled_twist = jnp.concatenate([twist[..., :d], twist[..., d:] * length[..., None]], axis=-1)
    size = _norm(scaled_twist)[..., None]
    scaled_twist = scaled_twist / jnp.where(size > 0, size, 1.0)
    A = safe(effort_map(grasp, length), 0.0)
    identity = jnp.eye(A.shape[-2], A.shape[-1], dtype=A.dtype)
    known = (resistant | escaping)[..., None, None, None]
    data = _Data(
        jnp.where(known, A, identity),
        over,
        normal,
        harmless.model.friction_coefficient,
        harmless.model.torsion_coefficient / length[..., None],
        live,
        s,
        jnp.where(valid[..., None], scaled_twist, 0.0),
    )
    kind = _Kind(valid, resistant, escaping)
    return *jax.tree.map(lambda x: x.reshape(-1, *x.shape[len(batch) :]), (data, kind)), length


@jax.jit
def _radii(data: _Data, kind: _Kind) -> Array:
    radius = jax.vmap(_radius)(data, kind.resistant)
    return nan_where(~kind.valid, jnp.where(kind.resistant | kind.escaping, radius, 0.0))
