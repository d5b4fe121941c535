"""What no answer may depend on, and what may only grow: hypothesis draws the seeds, each example is a whole batch."""

from decimal import Decimal, localcontext

import jax.numpy as jnp
import numpy as np
import pytest
from grasps import random_active, random_coefficients, random_contacts, random_rotation
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import jaxgrasp as jg
from jaxgrasp import Status
from jaxgrasp.contacts.folded import Contacts, fold
from jaxgrasp.contacts.models import Component

K, COUNT = 6, 128  # one compiled shape: soft fingers, among them hard (gamma = 0) and frictionless ones
SETTINGS = settings(
    deadline=None,
    max_examples=6,
    derandomize=True,
    database=None,
    suppress_health_check=[HealthCheck.too_slow],
)
SEEDS = st.integers(0, 2**32 - 1)
YES, NO = Status.RESISTANT, Status.NOT_RESISTANT


def random_arrays(seed, least_friction=0.0):
    rng = np.random.default_rng(seed)
    position, normal, _ = random_contacts(rng, COUNT, K, 3)
    friction, torsion = random_coefficients(rng, COUNT, K)
    active = random_active(rng, COUNT, K)
    return {
        "position": position,
        "normal": normal,
        "friction": np.maximum(friction, least_friction),
        "torsion": torsion,
        "active": active,
    }


def solved(arrays):
    """The verdicts, after the checker has accepted every one of them."""
    model = jg.SoftFinger(arrays["friction"], arrays["torsion"])
    grasp = jg.Grasp(arrays["position"], arrays["normal"], model, arrays["active"])
    res = jg.wrench_resistance(grasp)
    assert jg.check(grasp, res).all()
    for name in ("margin", "gap", "rank", "internal_force", "escape_twist"):
        assert not np.isnan(getattr(res, name)).any(), name
    return res


def assert_same_answer(a, b):
    """Certified verdicts agree, and so do the brackets; margins to the gap that was asked for where it was reached."""
    status = np.stack([a.status, b.status])
    certain = (status <= NO).all(0)
    assert certain.mean() > 0.9
    np.testing.assert_array_equal(status[0, certain], status[1, certain])
    np.testing.assert_array_equal(np.isneginf(a.margin), np.isneginf(b.margin))
    finite = np.isfinite(np.asarray(a.margin))
    margins, gaps = (np.stack([getattr(r, name) for r in (a, b)])[:, finite] for name in ("margin", "gap"))
    scale = np.maximum(1.0, np.abs(margins[0]))
    assert (margins.max(0) <= (margins + gaps).min(0) + 1e-9 * scale).all()
    closed = gaps.max(0) <= 2e-8 * scale
    assert closed.mean() > 0.9
    assert (np.abs(margins[0] - margins[1]) <= 3e-8 * scale)[closed].all()


@SETTINGS
@given(SEEDS)
def test_rotating_everything_changes_nothing(seed):
    arrays = random_arrays(seed)
    rotation = random_rotation(np.random.default_rng(seed + 1))
    turned = dict(arrays, position=arrays["position"] @ rotation.T, normal=arrays["normal"] @ rotation.T)
    assert_same_answer(solved(arrays), solved(turned))


@SETTINGS
@given(SEEDS, st.permutations(range(K)))
def test_the_order_of_contacts_changes_nothing(seed, order):
    arrays = random_arrays(seed)
    assert_same_answer(solved(arrays), solved({name: value[:, order] for name, value in arrays.items()}))


@SETTINGS
@given(SEEDS, st.floats(-6, 6))
def test_the_unit_of_length_changes_nothing(seed, power):
    arrays = random_arrays(seed)
    scale = 10.0**power
    scaled = dict(arrays, position=scale * arrays["position"], torsion=scale * arrays["torsion"])
    assert_same_answer(solved(arrays), solved(scaled))


def levelled(normal, z, which):
    """Normals in the plane n_z = 0 but for ``z``, at every second contact or at all."""
    normal = normal.copy()
    upright = np.abs(normal[..., :2]).max(-1) == 0
    normal[..., 0] = np.where(upright, 1.0, normal[..., 0])
    normal[:, which, 2] = z
    return normal


@SETTINGS
@given(SEEDS)
def test_the_spin_of_the_tangents_changes_nothing(seed):
    """n_z = 0 and n_z = -1e-200 stand on either side of the frame's branch: other tangents, the same grasp."""
    arrays = random_arrays(seed)
    sides = [dict(arrays, normal=levelled(arrays["normal"], z, slice(None, None, 2))) for z in (0.0, -1e-200)]
    models = [jg.SoftFinger(s["friction"], s["torsion"]) for s in sides]
    G = [
        np.asarray(jg.grasp_map(jg.Grasp(s["position"], s["normal"], m)))
        for s, m in zip(sides, models, strict=True)
    ]
    assert np.abs(G[0] - G[1]).max() > 0.1
    assert_same_answer(*(solved(s) for s in sides))


def test_spun_columns_have_the_same_cone_images():
    """Folding with spun tangents is A times a block rotation, which the cones do not notice."""
    arrays = random_arrays(3)
    rows = Contacts(
        *(jnp.asarray(arrays[n]) for n in ("position", "normal", "friction", "torsion", "active"))
    )
    components = (Component.TANGENT_1, Component.TANGENT_2, Component.NORMAL, Component.SPIN)
    level, flipped = (
        rows._replace(normal=jnp.asarray(levelled(arrays["normal"], z, slice(None)))) for z in (0.0, -1e-200)
    )
    a, b = (np.stack(fold(r, components).columns) for r in (level, flipped))  # (4, 6, K, COUNT)
    assert np.abs(a[1:3] - b[1:3]).max() > 0.1
    np.testing.assert_allclose(a[[0, 3]], b[[0, 3]], atol=1e-12)
    gram = [np.einsum("amkl,ankl->mnkl", x[1:3], x[1:3]) for x in (a, b)]
    np.testing.assert_allclose(*gram, atol=1e-12)


@SETTINGS
@given(SEEDS, st.floats(1.0, 3.0), st.floats(0.0, 0.5))
def test_more_friction_never_hurts(seed, factor, extra):
    """The cones grow: the margin too, and a resistant grasp stays one."""
    arrays = random_arrays(seed)
    more = dict(
        arrays,
        friction=factor * arrays["friction"] + extra * (arrays["friction"] > 0),
        torsion=factor * arrays["torsion"],
    )
    a, b = solved(arrays), solved(more)
    assert ((np.asarray(a.status) == YES) & (np.asarray(b.status) == NO)).sum() == 0
    assert (np.asarray(b.rank) >= np.asarray(a.rank)).all()
    finite = np.isfinite(np.asarray(a.margin))
    ceiling = np.asarray(b.margin + b.gap)[finite]
    floor = np.asarray(a.margin)[finite]
    assert (ceiling >= floor - 1e-9 * np.maximum(1.0, np.abs(floor))).all()


@SETTINGS
@given(SEEDS)
def test_another_contact_never_breaks_a_grasp(seed):
    arrays = random_arrays(seed)
    arrays["active"] = arrays["active"].copy()
    arrays["active"][:, -1] = False
    before = solved(arrays)
    arrays["active"] = arrays["active"].copy()
    arrays["active"][:, -1] = True
    after = solved(arrays)
    assert (np.asarray(before.status) == YES).sum() > 10
    assert ((np.asarray(before.status) == YES) & (np.asarray(after.status) == NO)).sum() == 0
    assert (np.asarray(after.rank) >= np.asarray(before.rank)).all()


@SETTINGS
@given(SEEDS, st.integers(1, K - 1))
def test_a_duplicate_contact_changes_no_verdict(seed, which):
    """Two equal cones add up to the same cone: neither the rank nor the verdict moves."""
    arrays = random_arrays(seed)
    for value in arrays.values():
        value[:, which] = value[:, 0]
    without = dict(arrays, active=arrays["active"].copy())
    without["active"][:, which] = False
    a, b = solved(without), solved(dict(arrays, active=arrays["active"] | (np.arange(K) == which)))
    certain = (np.asarray(a.status) <= NO) & (np.asarray(b.status) <= NO)
    assert certain.mean() > 0.9
    np.testing.assert_array_equal(np.asarray(a.status)[certain], np.asarray(b.status)[certain])
    np.testing.assert_array_equal(a.rank, b.rank)


def nearly(seed, kind, epsilon):
    """Grasps an epsilon away from a degenerate one (``kind``), and the degenerate one."""
    rng = np.random.default_rng(seed)
    arrays = random_arrays(seed, least_friction=0.05)
    noise = epsilon * rng.normal(size=arrays["position"].shape)
    position, normal = arrays["position"].copy(), arrays["normal"].copy()
    if kind == "coincident":
        position[:, 1:3] = position[:, :1]
        moved = position + noise, normal
    elif kind == "collinear":
        position = position[:, :1] * rng.uniform(-1, 1, (COUNT, K, 1))
        moved = position + noise, normal
    elif kind == "parallel":
        normal = normal[:, :1] * rng.choice([-1.0, 1.0], (COUNT, K, 1))
        moved = position, normal + noise
    elif kind == "coincident and parallel":
        position, normal = np.repeat(position[:, :1], K, 1), np.repeat(normal[:, :1], K, 1)
        moved = position + noise, normal + noise
    else:  # antipodal pairs on one line through the centre
        side = np.where(np.arange(K) % 2 == 0, 1.0, -1.0)[None, :, None]
        position = side * position[:, :1]
        normal = -position
        moved = position + noise, normal + noise
    return dict(arrays, position=moved[0], normal=moved[1])


def exact_depth(arrays, lane, twist) -> Decimal:
    """``min_i x_n - |(mu x_x, mu x_y, gamma x_tau)|`` of the twist in 60-digit arithmetic on the given floats."""

    def exact(values):
        return [Decimal(float(v)) for v in values]

    def dot(a, b):
        return sum((x * y for x, y in zip(a, b, strict=True)), Decimal(0))

    with localcontext() as context:
        context.prec = 60
        xi, depths = exact(twist), []
        for c in np.flatnonzero(arrays["active"][lane]):
            p, n = exact(arrays["position"][lane, c]), exact(arrays["normal"][lane, c])
            length = dot(n, n).sqrt()
            n = [x / length for x in n]
            v, w = xi[:3], xi[3:]
            at = [v[j] + w[(j + 1) % 3] * p[(j + 2) % 3] - w[(j + 2) % 3] * p[(j + 1) % 3] for j in range(3)]
            along, spin = dot(at, n), dot(w, n)
            mu, gamma = exact([arrays["friction"][lane, c], arrays["torsion"][lane, c]])
            across = dot(at, at) - along * along
            depths.append(along - (mu * mu * max(across, Decimal(0)) + gamma * gamma * spin * spin).sqrt())
        return min(depths)


@pytest.mark.parametrize(
    "kind", ["coincident", "collinear", "parallel", "coincident and parallel", "antipodal"]
)
@settings(SETTINGS, max_examples=5)
@given(seed=SEEDS, power=st.floats(-12, -6))
def test_near_degenerate_grasps_are_never_certified_wrongly(kind, seed, power):
    """The checker accepts all, nothing is NaN, and the exact rank and Clarabel contradict no proof."""
    from clarabel_oracle import clarabel_margin

    arrays = nearly(seed, kind, 10.0**power)
    res = solved(arrays)
    status = np.asarray(res.status)
    for i in range(0, COUNT, 2):
        t, known = clarabel_margin(
            arrays["position"][i],
            arrays["normal"][i],
            arrays["friction"][i],
            arrays["torsion"][i],
            arrays["active"][i],
            ("f_x", "f_y", "f_n", "tau_n"),
        )
        if known and status[i] == YES:
            assert t > -1e-8
        if known and status[i] == NO and res.rank[i] == 6 and t >= 1e-8:
            # Clarabel's own tolerance hides singular values of 1e-11; sixty digits decide who is right.
            assert exact_depth(arrays, i, np.asarray(res.escape_twist)[i]) > 0
    assert (np.asarray(res.rank)[status == YES] == 6).all()
    assert (np.asarray(res.rank)[status == Status.MARGINAL] == 6).all()


def test_a_nearly_singular_square_map_still_has_no_internal_force():
    """Three frictionless soft contacts, six columns, least singular value 3e-8: Null(A) = 0, so t* = -inf."""
    arrays = random_arrays(4957087)
    res = solved(dict(arrays, normal=levelled(arrays["normal"], 0.0, slice(None, None, 2))))
    assert arrays["active"][31].sum() == 3
    assert (res.rank[31], res.status[31]) == (6, NO)
    assert res.margin[31] == -np.inf
