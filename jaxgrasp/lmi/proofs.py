"""What rounding cannot turn about an LMI: that a point is feasible, what it costs, what nothing costs less than, a ray.

All bounds of rounding hold for every order of summation. ``u = eps / 2``; a sum of n products of numbers is off by at
most ``(n + 1) u`` times the sum of their sizes, and half of eps is left for the bound's own rounding. Underflow is not
counted.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from ..core import Array, unit_roundoff
from .combined import Combined, orthonormal_columns

__all__ = ["combination", "find_ray", "is_ray", "lower_bound", "surely_positive", "upper_bound"]


def _sum_error(terms: Array, sizes: Array, dtype) -> Array:
    """Of a sum of ``terms`` products whose sizes add up to ``sizes``."""
    return (terms.astype(dtype) + 2.0) * unit_roundoff(dtype) * sizes


def combination(x: Array, matrices: Array) -> tuple[Array, Array]:
    """``sum_i x_i Q_i`` and how far each entry may be off. Whole multiples of one step are summed exactly."""
    entries = jnp.concatenate([matrices.reshape(len(x), -1), jnp.zeros((len(x), 1), x.dtype)], axis=1)
    sizes = jnp.abs(x) @ jnp.abs(entries)
    terms = jnp.sum((x[:, None] != 0) & (entries != 0), axis=0)
    error = _sum_error(terms, sizes, x.dtype)
    fine = _grid(x) * _grid(entries)
    exact = jnp.max(sizes) < fine / unit_roundoff(x.dtype)
    error = jnp.where(exact, 0.0, error)[:-1]
    return jnp.einsum("i,iab->ab", x, matrices), error.reshape(matrices.shape[1:])


GRID = 12  # bits that a ray's entries are rounded to, and that matrices of small whole numbers need


def _step(values: Array) -> Array:
    """The power of two that is GRID bits below the largest entry."""
    _, exponent = jnp.frexp(jnp.max(jnp.abs(values)))
    return jnp.ldexp(jnp.ones((), values.dtype), exponent - GRID)


def _grid(values: Array) -> Array:
    """The step of which all values are whole multiples; 0 if they are not."""
    step = _step(values)
    return jnp.where(jnp.all(jnp.round(values / step) * step == values), step, 0.0)


def surely_positive(matrix: Array, error: Array, allow_zero: bool = False) -> Array:
    """Whether every symmetric matrix within ``error`` of ``matrix``, entry by entry, is positive definite.

    Cholesky's method ends with ``L L^T = M + E``, ``|E_ab| <= (q + 1) u sqrt(M_aa M_bb)``: over unit diagonals
    ``|E| <= q (q + 1) u``. So it must succeed with that share of the diagonal, and the rows' own errors, taken away
    (Rump, BIT 46 (2006)). ``allow_zero``: rows that are surely zero do not count, so that M >= 0 is what is shown.
    """
    q, dtype = matrix.shape[0], matrix.dtype
    diagonal = jnp.diagonal(matrix)
    root = jnp.sqrt(jnp.where(diagonal > 0, diagonal, 1.0))
    shift = (q + 1) * (q + 2) * unit_roundoff(dtype) / 2 * diagonal + root * (error @ (1 / root)) * 2
    shifted = matrix - jnp.diag(shift)
    positive = jnp.diagonal(shifted) > 0
    if allow_zero:
        zero = jnp.all((matrix == 0) & (error == 0), axis=1)
        shifted, positive = shifted + jnp.diag(zero.astype(dtype)), positive | zero
    hopeful = jnp.all(positive)
    factor = jnp.linalg.cholesky(jnp.where(hopeful, shifted, jnp.eye(q, dtype=dtype)))
    return hopeful & jnp.all(jnp.isfinite(factor))


# Points ------------------------------------------------------------------------------------------------


def upper_bound(problem: Combined, x: Array) -> Array:
    """The cost at x, rounded up; infinite where S(x) > 0 is not sure. H counts as F^T F."""
    dtype, eps = x.dtype, unit_roundoff(x.dtype)
    matrices = jnp.concatenate([problem.matrices, problem.constant[None]])
    S, error = combination(jnp.append(x, 1.0), matrices)
    image = problem.root @ x
    value = problem.cost @ x + jnp.sum(image**2) / 2
    sizes = jnp.abs(problem.cost) @ jnp.abs(x) + jnp.sum((jnp.abs(problem.root) @ jnp.abs(x)) ** 2)
    terms = jnp.asarray(len(x) + 2 * len(image), dtype)
    feasible = surely_positive(S, error)
    B, error = S[problem.term, problem.term], error[problem.term, problem.term]
    if len(B):
        values = jnp.linalg.eigvalsh(jnp.where(feasible, B, jnp.eye(len(B), dtype=dtype)))
        least = values - jnp.max(jnp.sum(error, axis=1)) - 4 * len(B) * eps * jnp.max(jnp.abs(values))
        counts = problem.weight > 0
        feasible = feasible & (~counts | jnp.all(least > 0))
        logs = problem.weight * jnp.log(jnp.where(counts & (least > 0), least, 1.0))
        value, sizes, terms = value - jnp.sum(logs), sizes + 4 * jnp.sum(jnp.abs(logs)), terms + len(B)
    return jnp.where(feasible, value + _sum_error(terms, sizes, dtype), jnp.inf)


# Multipliers -------------------------------------------------------------------------------------------


def lower_bound(problem: Combined, Z: Array, v: Array) -> tuple[Array, Array]:
    """``h(x) >= -<S_0, Z> - |v|^2 / 2 + w (r + log det(Y / w))`` at every feasible x, and Z; -infinite: no proof.

    Z >= 0 with its block Y for B(x), and v, meet ``<S_i, Z> + F_i.v = c_i`` up to what rounding left. Multipliers that
    meet the equations exactly exist within rho: with G the Gram matrix of the orthonormal columns and r what the
    equations miss, the shortest change has length ``(r'^T G^-1 r')^(1/2) <= 2 |r'|``, ``r' = T^T r``. So Z must stay
    positive semidefinite when rho is taken off, and the bound gives way by what rho can change (Jansson, Chaykin,
    Keil, SIAM J. Numer. Anal. 46 (2007)). The length is taken twice, as things are and in units, powers of two, in
    which the diagonal of Z is about 1: the better bound counts. Matrices that are dependent within
    ``rank_tolerance`` count as dependent, and H as F^T F.
    """
    diagonal = jnp.diagonal(Z)
    _, exponent = jnp.frexp(diagonal)
    units = jnp.ldexp(jnp.ones_like(diagonal), jnp.where(diagonal > 0, exponent // 2, 0))
    both = jnp.stack([jnp.ones_like(units), units])
    bounds, multipliers = jax.lax.map(lambda units: _lower_bound(problem, Z, v, units), both)
    best = jnp.argmax(bounds)
    return bounds[best], multipliers[best]


def _lower_bound(problem: Combined, Z: Array, v: Array, units: Array) -> tuple[Array, Array]:
    dtype, q, N = Z.dtype, len(Z), len(problem.cost)
    eps = unit_roundoff(dtype)
    Z = Z / units / units[:, None]
    constant = problem.constant * units * units[:, None]
    matrices = problem.matrices * units * units[:, None]
    columns = jnp.concatenate([matrices.reshape(N, -1), problem.root.T], axis=1)
    T, _, held, proved = orthonormal_columns(columns, problem.cost)
    flat = jnp.append(Z.reshape(-1), v)
    flat = flat + (T.T @ (problem.cost - columns @ flat)) @ (T.T @ columns)
    Z, v = flat[: q * q].reshape(q, q), flat[q * q :]
    Z = (Z + Z.T) / 2

    flat = jnp.append(Z.reshape(-1), v)
    rest = problem.cost - columns @ flat
    sizes = jnp.abs(problem.cost) + jnp.abs(columns) @ jnp.abs(flat)
    error = _sum_error(jnp.sum(columns != 0, axis=1), sizes, dtype) + N * eps * jnp.abs(rest)
    rho = 2 * jnp.linalg.norm(jnp.abs(T.T @ rest) + jnp.abs(T.T) @ error)
    proved = proved & held
    proved = proved & surely_positive(
        Z - rho * jnp.eye(q, dtype=dtype), eps * jnp.diag(jnp.diagonal(Z) + rho)
    )

    products = jnp.append((constant * Z).reshape(-1), v**2 / 2)
    value, sizes = -jnp.sum(products), jnp.sum(jnp.abs(products))
    terms = jnp.sum(products != 0) + 1
    Y, w = Z[problem.term, problem.term], problem.weight
    if len(Y):
        values = jnp.linalg.eigvalsh(jnp.where(proved, Y, jnp.eye(len(Y), dtype=dtype)))
        least = values - rho - 4 * len(Y) * eps * jnp.max(jnp.abs(values))
        counts = w > 0
        proved = proved & (~counts | jnp.all(least > 0))
        weight = jnp.where(counts, w, 1.0)
        logs = jnp.log(jnp.where(counts & proved, least, weight) / weight) + 2 * jnp.log(units[problem.term])
        value = value + jnp.where(counts, w * (len(Y) + jnp.sum(logs)), 0.0)
        sizes = sizes + w * (len(Y) + 4 * jnp.sum(jnp.abs(logs)))
        terms = terms + 2 * len(Y)
    change = rho * (jnp.linalg.norm(constant) + jnp.linalg.norm(v) + rho) * (1 + q * q * eps)
    value = value - _sum_error(terms, sizes, dtype) - change
    return jnp.where(proved & jnp.isfinite(value), value, -jnp.inf), Z * units * units[:, None]


# Rays --------------------------------------------------------------------------------------------------


def is_ray(problem: Combined, ray: Array) -> Array:
    """``sum_i d_i S_i >= 0, F d = 0, c.d < 0``: from any feasible point the cost falls for ever."""
    gain, error = combination(ray, problem.cost[:, None, None])
    falls = jnp.all(gain + error < 0) & jnp.all(jnp.isfinite(ray))
    falls = falls & jnp.all(jnp.abs(problem.root) @ jnp.abs(ray) == 0)
    ray = jnp.where(falls, ray, 0.0)
    return falls & surely_positive(*combination(ray, problem.matrices), allow_zero=True)


def find_ray(problem: Combined, candidates: Array) -> Array:
    """The first of the candidates (rows), each rounded to a few bits and as it is, that is a ray; 0: none.

    Rounded, because rays on an edge of their cone are often small whole numbers: others no rounding leaves on it.
    """
    candidates = jnp.where(jnp.isfinite(candidates), candidates, 0.0)
    size = jnp.max(jnp.abs(candidates), axis=1, keepdims=True)
    unit = candidates / jnp.where(size > 0, size, 1.0)
    step = jnp.asarray(2.0**-GRID, unit.dtype)
    rows = jnp.concatenate([jnp.round(unit / step) * step, unit])
    good = jax.lax.map(lambda ray: is_ray(problem, ray), rows)
    return jnp.where(jnp.any(good), rows[jnp.argmax(good)], 0.0)
