"""The second attempt in pairs of floats: its arithmetic, what it decides, and that what it reports is true.

Truth is rational arithmetic on the stored numbers: squares only, so that no root is taken.
"""

from fractions import Fraction

import jax
import numpy as np
import pytest
from shapes import HARD

import jaxgrasp as jg
from jaxgrasp import Status
from jaxgrasp.conic import pair, pair_sqrt, pair_sum

F32 = pytest.mark.f32
BITS = {"float64": 98, "float32": 42}


def exact(x):
    return Fraction(float(x))


def value(x, i):
    return exact(x.hi[i]) + exact(x.lo[i])


@F32
def test_pairs_keep_twice_the_bits(dtype):
    rng = np.random.default_rng(0)
    x, y, z = (rng.normal(size=(3, 300)) * 10.0 ** rng.integers(-3, 4, (3, 300))).astype(dtype)

    @jax.jit
    def run(x, y, z):
        product = pair(x) * y + z
        ratio = product / (pair(y) - x)
        return product, ratio, pair_sqrt(ratio * ratio), pair_sum(pair(x) * y, 0)

    product, ratio, root, total = run(x, y, z)
    bound = Fraction(1, 2 ** BITS[dtype])
    for i in range(300):
        a, b, c = exact(x[i]), exact(y[i]), exact(z[i])
        size = max(abs(a * b), abs(c))  # the sum cancels
        assert abs(value(product, i) - (a * b + c)) <= bound * size
        quotient = value(product, i) / (b - a)
        assert abs(value(ratio, i) - quotient) <= 8 * bound * abs(quotient)
        assert abs(value(root, i) - abs(value(ratio, i))) <= 8 * bound * abs(quotient)
    terms = [exact(a) * exact(b) for a, b in zip(x, y, strict=True)]
    assert abs(exact(total.hi) + exact(total.lo) - sum(terms)) <= 8 * bound * sum(map(abs, terms))


def near_critical(dtype):
    """A planar pinch whose fingers press in part along the line between them: mu* = tan(angle), mu a little off it."""
    off = np.array([1e-3, -1e-3, 1e-4, -1e-4, 1e-5, -1e-5, 3e-6, -3e-6])
    angle = 0.3
    position = np.broadcast_to(np.array([[-1.0, 0], [1, 0]], dtype), (len(off), 2, 2))
    normal = np.array([[np.cos(angle), np.sin(angle)], [-np.cos(angle), np.sin(angle)]], dtype)
    friction = (np.tan(angle) * (1 + off)).astype(dtype)
    return jg.Grasp(position, np.broadcast_to(normal, position.shape), jg.HardFinger(friction[:, None])), off


@F32
def test_verdicts_next_to_critical_friction(dtype):
    grasp, off = near_critical(dtype)
    found = jg.wrench_resistance(grasp)
    expected = np.where(off > 0, Status.RESISTANT, Status.NOT_RESISTANT)
    # Below the resolution of the dtype, about 2e-5 in float32, a bracket around 0 is an answer, too.
    close = (np.abs(off) < (1e-9 if dtype == "float64" else 2e-5)) & (
        np.asarray(found.status) == Status.MARGINAL
    )
    np.testing.assert_array_equal(np.where(close, expected, found.status), expected)
    n = np.asarray(grasp.normal, np.float64)
    ratio = np.asarray(grasp.model.friction_coefficient, np.float64)[:, 0] * np.abs(n[:, 0, 0] / n[:, 0, 1])
    # Along the line the tangential part is tan(angle) times the normal one: t* = 1 - tan(angle) / mu.
    np.testing.assert_array_less(np.asarray(found.lower, np.float64), 1 - 1 / ratio + 1e-12)
    np.testing.assert_array_less(1 - 1 / ratio - 1e-12, np.asarray(found.upper, np.float64))
    assert jg.check(grasp, found).all()


def rotated_pair():
    """Four fingers of which two all but coincide: singular values down to 1e-9 of the largest."""
    rng = np.random.default_rng(5)
    position = rng.normal(size=(60, HARD, 3))
    position /= np.linalg.norm(position, axis=-1, keepdims=True)
    normal = -position.copy()
    apart = 10.0 ** rng.uniform(-10, -6, (60, 1))
    position[:, 1:] = position[:, :1] + apart[:, None] * rng.normal(size=(60, HARD - 1, 3))
    normal[:, 2:] = normal[:, :1] + apart[:, None] * rng.normal(size=(60, HARD - 2, 3))
    normal[:, 1] = -normal[:, 0]
    return jg.Grasp(position, normal, jg.HardFinger(rng.uniform(0.2, 1.0, (60, 1))))


def solve(M, rhs):
    """Gauss in rationals."""
    n = len(M)
    rows = [[*row, b] for row, b in zip(M, rhs, strict=True)]
    for i in range(n):
        p = next(j for j in range(i, n) if rows[j][i] != 0)
        rows[i], rows[p] = rows[p], rows[i]
        rows[i] = [x / rows[i][i] for x in rows[i]]
        for j in range(n):
            if j != i and rows[j][i] != 0:
                rows[j] = [a - rows[j][i] * b for a, b in zip(rows[j], rows[i], strict=True)]
    return [row[-1] for row in rows]


def exact_force(grasp, found, i):
    """The exact internal force (n_1, t_1, n_2, t_2) next to the stored one, for unit normals in rationals."""
    p = [[exact(x) for x in row] for row in np.asarray(grasp.position)[i]]
    n = [(Fraction(3, 5), Fraction(4, 5)), (Fraction(-3, 5), Fraction(4, 5))]
    mu = [exact(x) for x in np.asarray(grasp.model.friction_coefficient)[i]]
    force = np.asarray(found.internal_force)[i].reshape(len(p), 2)
    columns, s = [], []
    for q, d, m, f in zip(p, n, mu, force, strict=True):
        for direction, factor, part in ((d, 1, f[1]), ((d[1], -d[0]), m, f[0])):
            x, y = (factor * v for v in direction)
            columns.append([x, y, q[0] * y - q[1] * x])
            s.append(exact(part) / factor)
    gram = [[sum(c[a] * c[b] for c in columns) for b in range(3)] for a in range(3)]
    y = solve(gram, [sum(c[a] * v for c, v in zip(columns, s, strict=True)) for a in range(3)])
    return [v - sum(c[a] * y[a] for a in range(3)) for c, v in zip(columns, s, strict=True)]


def test_resistant_is_true_of_the_stored_numbers():
    """Normals of unit length in rationals (3/5, 4/5), mu next to the critical 4/3: the slack's sign is exact."""
    off = np.array([1e-4, 1e-6, 1e-8, 1e-10])
    position = np.broadcast_to([[-1.0, 0], [1, 0]], (4, 2, 2))
    length = 2.0 ** np.array([[0, 1], [-1000, 1000], [900, 0], [3, -900]])  # of normals: any will do
    normal = np.array([[3.0, 4.0], [-3.0, 4.0]]) * length[..., None]
    grasp = jg.Grasp(position, normal, jg.HardFinger((4 / 3 * (1 + off))[:, None] * np.ones((4, 2))))
    found = jg.wrench_resistance(grasp)
    for i in range(4):
        s = exact_force(grasp, found, i)
        mean = (s[0] + s[2]) / 2
        slack = min(s[0] - abs(s[1]), s[2] - abs(s[3])) / mean
        assert Fraction(float(found.lower[i])) <= slack <= Fraction(float(found.upper[i]))
        if found.status[i] == Status.RESISTANT:
            assert slack > 0
    assert list(found.status[:3]) == [Status.RESISTANT] * 3


def test_jit_vmap_and_eager_agree():
    grasp = rotated_pair()
    eager = jg.wrench_resistance(grasp)
    jitted = jax.jit(jg.wrench_resistance)(grasp)
    mapped = jax.vmap(jg.wrench_resistance)(grasp)
    for other in (jitted, mapped):
        np.testing.assert_array_equal(eager.status, other.status)
        np.testing.assert_allclose(eager.lower, other.lower, rtol=1e-9, atol=1e-9)
    assert (np.asarray(eager.status) == Status.UNDECIDED).sum() <= 1


@pytest.mark.parametrize("model", ["frictionless", "hard"])
def test_contacts_that_nearly_coincide(model):
    """Rank and margin turn on the last bits: whatever is said is proved."""
    rng = np.random.default_rng(12)
    angle = rng.uniform(0, 2 * np.pi, (1500, 4))
    position = 10.0 ** rng.uniform(-6, 6, (1500, 1, 1)) * np.stack([np.cos(angle), np.sin(angle)], -1)
    normal = -position / np.linalg.norm(position, axis=-1, keepdims=True)
    apart = 10.0 ** rng.uniform(-16, -12, (1500, 1))
    size = np.linalg.norm(position[:, 0], axis=-1, keepdims=True)
    position[:, 1] = position[:, 0] + apart * size * rng.normal(size=(1500, 2))
    normal[:, 1] = normal[:, 0] + apart * rng.normal(size=(1500, 2))
    friction = 0.0 if model == "frictionless" else rng.choice([0.0, 1e-5, 0.5], (1500, 4))
    grasp = jg.Grasp(position, normal, jg.HardFinger(friction))
    answer = jg.wrench_resistance(grasp)
    assert len(np.unique(answer.status)) > 1
    assert np.all(jg.check(grasp, answer))


def test_a_lost_rank_without_compiling():
    """Operation by operation, also where lanes are picked for their singular values."""
    position = np.array([[-1.0, 0.0], [1.0, 0.0]])
    grasp = jg.Grasp(position, -position, jg.HardFinger(0.0))
    with jax.disable_jit():
        answer = jg.wrench_resistance(grasp)
    assert int(answer.status) == Status.NOT_RESISTANT and int(answer.rank) == 1
