"""Wrench resistance: known answers, bad numbers, bits, transformations."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from grasps import random_active, random_coefficients, random_contacts
from shapes import HARD, PLANAR, SOFT

import jaxgrasp as jg
from jaxgrasp import Status

TIGHT = {"float64": 2e-8, "float32": 5e-3}
F32 = pytest.mark.f32


def unit(v):
    v = np.asarray(v, float)
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def padded(position, normal, k=SOFT):
    """One grasp padded to k contacts with NaN, which must not matter."""
    position, normal = np.asarray(position, float), np.asarray(normal, float)
    fill = np.full((k - len(position), position.shape[1]), np.nan)
    active = np.arange(k) < len(position)
    return np.concatenate([position, fill]), np.concatenate([normal, fill]), active


def grasp_of(cases, friction, torsion, dtype):
    position, normal, active = (np.stack(x) for x in zip(*(padded(p, n) for p, n in cases), strict=True))
    friction = np.broadcast_to(np.asarray(friction, dtype), active.shape)
    if torsion is None:
        model = jg.HardFinger(friction)
    else:
        model = jg.SoftFinger(friction, np.broadcast_to(np.asarray(torsion, dtype), active.shape))
    return jg.Grasp(position.astype(dtype), normal.astype(dtype), model, active)


TETRAHEDRON = unit([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])
EQUATOR = np.array([[np.cos(a), np.sin(a), 0] for a in (0, 2 * np.pi / 3, 4 * np.pi / 3)])
ANTIPODAL = np.array([[1.0, 0, 0], [-1, 0, 0]])


@pytest.fixture(scope="module")
def known(dtype):
    """Soft fingers, so that one compiled shape serves every case; gamma = 0 makes a hard finger."""
    corner = np.array([[-1.0, 0, 0], [0, 0, -1], [0, 0, 1]])
    tilt = [[0.866, 0.5, 0], [-0.866, 0, 0.5]]
    cases = [
        (TETRAHEDRON, -TETRAHEDRON),
        (EQUATOR, -EQUATOR),
        (ANTIPODAL, -ANTIPODAL),
        (ANTIPODAL, -ANTIPODAL),
        (-ANTIPODAL, tilt),
        (-ANTIPODAL, tilt),
        (corner, -corner),
        (corner, -corner),
        (EQUATOR, np.tile([0.0, 0, 1], (3, 1)) + 0.05 * EQUATOR),
        (ANTIPODAL, -ANTIPODAL),
    ]
    friction = np.array([[0.01] * 6] + [[0.5] * 6] * 9)
    friction[6, :3], friction[7, :3] = (0, 1, 1), (1, 1, 1)
    friction[8] = 0.1
    friction[9] = 0.0
    torsion = np.zeros((10, 6))
    torsion[3], torsion[4], torsion[5], torsion[9] = 0.1, 2.0, 0.01, 0.0
    grasp = grasp_of(cases, friction, torsion, dtype)
    return grasp, jg.wrench_resistance(grasp)


@F32
def test_tetrahedron_has_margin_one_at_any_friction(known, dtype):
    _, res = known
    assert res.status[0] == Status.RESISTANT
    assert res.rank[0] == 6
    np.testing.assert_allclose(res.margin[0], 1.0, atol=TIGHT[dtype])


@F32
def test_three_contacts_on_the_equator_resist(known, dtype):
    _, res = known
    assert res.status[1] == Status.RESISTANT
    assert res.rank[1] == 6
    np.testing.assert_allclose(res.margin[1], 1.0, atol=TIGHT[dtype])


@F32
def test_two_hard_fingers_leave_the_rotation_about_their_line(known, dtype):
    _, res = known
    assert res.status[2] == Status.NOT_RESISTANT
    assert res.rank[2] == 5
    np.testing.assert_allclose(res.margin[2], 1.0, atol=TIGHT[dtype])
    twist = np.asarray(res.escape_twist[2])
    np.testing.assert_allclose(np.abs(twist), [0, 0, 0, 1, 0, 0], atol=1e-5 if dtype == "float32" else 1e-12)


@F32
def test_two_soft_fingers_resist(known, dtype):
    _, res = known
    assert res.status[3] == Status.RESISTANT
    np.testing.assert_allclose(res.margin[3], 1.0, atol=TIGHT[dtype])


@F32
def test_soft_fingers_outside_nguyens_condition_may_still_resist(known, dtype):
    """p on the x axis, normals 30 degrees off in different planes, mu = 0.5 < tan 30: gamma decides."""
    _, res = known
    np.testing.assert_allclose(np.asarray(res.margin[4:6]), [0.106, -0.155], atol=6e-4 + TIGHT[dtype])
    assert list(res.status[4:6]) == [Status.RESISTANT, Status.NOT_RESISTANT]


@F32
def test_the_rank_that_counts_is_the_folded_one(known):
    grasp, res = known
    assert res.rank[6] == 5
    assert res.margin[6] > 0.1
    assert res.status[6] == Status.NOT_RESISTANT
    assert np.linalg.matrix_rank(np.asarray(jg.grasp_map(grasp))[6]) == 6
    assert (res.rank[7], res.status[7]) == (6, Status.RESISTANT)


@F32
def test_normals_in_a_half_space_escape_by_a_translation(known):
    _, res = known
    assert res.status[8] == Status.NOT_RESISTANT
    assert res.margin[8] < 0
    v, w = np.asarray(res.escape_twist[8][:3]), np.asarray(res.escape_twist[8][3:])
    assert v[2] > 0.9
    assert np.linalg.norm(w) < 0.35


@F32
def test_frictionless_pair(known):
    _, res = known
    assert res.status[9] == Status.NOT_RESISTANT
    assert res.rank[9] == 1


@F32
def test_every_known_verdict_is_certified(known):
    grasp, res = known
    assert jg.check(grasp, res).all()


def test_internal_force_is_internal_and_scaled(known):
    grasp, res = known
    yes = np.asarray(res.status) == Status.RESISTANT
    force = np.asarray(res.internal_force)
    np.testing.assert_allclose(np.einsum("bij,bj->bi", jg.grasp_map(grasp), force)[yes], 0, atol=1e-12)
    normal = force.reshape(len(force), -1, 4)[..., 2]
    np.testing.assert_allclose(normal.sum(-1)[yes], np.asarray(grasp.active).sum(-1)[yes], rtol=1e-12)
    slack = grasp.model.feasibility_slack(jnp.asarray(force.reshape(len(force), -1, 4)), 3)
    least = np.where(grasp.active, slack, np.inf).min(-1)
    np.testing.assert_allclose(np.asarray(res.margin)[yes], least[yes], atol=1e-9)


def test_escape_twist_is_opposed_by_no_force(known):
    grasp, res = known
    no = np.asarray(res.status) == Status.NOT_RESISTANT
    twist = np.asarray(res.escape_twist)
    np.testing.assert_allclose(np.linalg.norm(twist[no], axis=-1), 1, rtol=1e-12)
    velocity = np.einsum("bij,bi->bj", jg.grasp_map(grasp), twist).reshape(len(twist), -1, 4)
    slack = np.asarray(grasp.model.dual_slack(jnp.asarray(velocity), 3))
    assert np.where(grasp.active, slack, 0)[no].min() > -1e-12
    assert (twist[~no] == 0).all()


@pytest.mark.parametrize("angle", [5.0, 20.0, 35.0])
def test_two_planar_fingers_obey_nguyen(angle):
    """Critical mu = tan of the largest angle between a normal and the joining line."""
    a = np.deg2rad(angle)
    position = np.array([[-1.0, 0], [1, 0], [0, 1]])  # the third is padding
    normal = np.array([[np.cos(a), np.sin(a)], [-1, 0], [0, -1]])
    active = np.array([True, True, False])
    factors = np.array([0.5, 0.99, 0.9999, 1.0001, 1.01, 2.0])
    friction = np.tan(a) * factors[:, None] * np.ones((6, PLANAR))
    grasp = jg.Grasp(
        np.tile(position, (6, 1, 1)),
        np.tile(normal, (6, 1, 1)),
        jg.HardFinger(friction),
        np.tile(active, (6, 1)),
    )
    res = jg.wrench_resistance(grasp)
    assert list(res.status) == [Status.NOT_RESISTANT] * 3 + [Status.RESISTANT] * 3
    assert jg.check(grasp, res).all()
    critical = jg.wrench_resistance(jg.Grasp(position, normal, jg.HardFinger(np.tan(a)), active))
    assert abs(float(critical.margin)) < 1e-8
    assert critical.status in (Status.MARGINAL, Status.NOT_RESISTANT, Status.RESISTANT)


def test_no_internal_force_with_a_normal_part_gives_minus_infinity():
    """Two parallel normals, one plane apart: nothing pushes back."""
    position = np.array([[[-1.0, 0], [1, 0], [0, 0]]])
    normal = np.array([[[0.0, 1], [0, 1], [0, 1]]])
    active = np.array([[True, True, False]])
    grasp = jg.Grasp(position, normal, jg.HardFinger(np.zeros((1, PLANAR))), active)
    res = jg.wrench_resistance(grasp)
    assert res.margin[0] == -np.inf
    assert res.gap[0] == 0
    assert res.status[0] == Status.NOT_RESISTANT
    np.testing.assert_allclose(res.escape_twist[0], [0, 1, 0], atol=1e-12)
    assert jg.check(grasp, res).all()


BAD = {
    "nan position": ("position", np.nan),
    "infinite position": ("position", np.inf),
    "nan normal": ("normal", np.nan),
    "zero normal": ("normal", 0.0),
    "negative friction": ("friction", -0.1),
    "nan friction": ("friction", np.nan),
    "infinite friction": ("friction", np.inf),
    "negative torsion": ("torsion", -0.1),
    "nothing active": ("active", False),
}


@pytest.fixture(scope="module")
def batch(dtype):
    rng = np.random.default_rng(3)
    n, k = 150, SOFT
    position, normal, _ = random_contacts(rng, n, k, 3)
    friction, torsion = random_coefficients(rng, n, k)
    return {
        "position": position.astype(dtype),
        "normal": normal.astype(dtype),
        "friction": friction.astype(dtype),
        "torsion": torsion.astype(dtype),
        "active": random_active(rng, n, k),
    }


@pytest.fixture(scope="module", params=["planar", pytest.param("soft", marks=pytest.mark.slow)])
def batch_of_a_model(request, batch, dtype):
    """Soft fingers in space, or hard ones in the plane: a smaller program where a test compiles several."""
    if request.param == "soft":
        return batch
    rng = np.random.default_rng(3)
    n, k = 150, PLANAR
    position, normal, _ = random_contacts(rng, n, k, 2)
    friction, _ = random_coefficients(rng, n, k)
    return {
        "position": position.astype(dtype),
        "normal": normal.astype(dtype),
        "friction": friction.astype(dtype),
        "active": random_active(rng, n, k),
    }


def build(arrays):
    if "torsion" in arrays:
        model = jg.SoftFinger(arrays["friction"], arrays["torsion"])
    else:
        model = jg.HardFinger(arrays["friction"])
    return jg.Grasp(arrays["position"], arrays["normal"], model, arrays["active"])


def assert_same_bits(a, b):
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        assert np.asarray(x).tobytes() == np.asarray(y).tobytes()


@F32
def test_bad_numbers_make_their_own_lane_invalid_and_touch_no_other(batch):
    clean = jg.wrench_resistance(build(batch))
    dirty = {name: value.copy() for name, value in batch.items()}
    lanes = list(range(5, 5 + 13 * len(BAD), 13))
    for lane, (field, value) in zip(lanes, BAD.values(), strict=True):
        dirty[field][lane, 0 if field != "active" else slice(None)] = value
    grasp = build(dirty)
    res = jg.wrench_resistance(grasp)
    assert (np.asarray(res.status)[lanes] == Status.INVALID).all()
    for name in ("lower", "upper", "margin", "gap"):
        assert np.isnan(np.asarray(getattr(res, name))[lanes]).all(), name
    np.testing.assert_array_equal(np.asarray(res.rank)[lanes], -1)
    others = np.setdiff1d(np.arange(len(res.status)), lanes)
    assert_same_bits(*(jax.tree.map(lambda x: np.asarray(x)[others], r) for r in (clean, res)))
    assert jg.check(grasp, res).all()


@F32
@pytest.mark.parametrize("verdict_only", [False, True])
def test_bits_do_not_depend_on_batch_neighbours_or_position(batch, verdict_only):
    grasp = build(batch)
    whole = jg.wrench_resistance(grasp, verdict_only=verdict_only)
    for count in (1, 2, 63, 64, 65, 149):
        part = jg.wrench_resistance(grasp[np.arange(count)], verdict_only=verdict_only)
        assert_same_bits(jax.tree.map(lambda x, n=count: x[:n], whole), part)
    order = np.random.default_rng(0).permutation(150)
    shuffled = jg.wrench_resistance(grasp[order], verdict_only=verdict_only)
    assert_same_bits(jax.tree.map(lambda x: x[order], whole), shuffled)


def test_bits_do_not_depend_on_the_tile(batch_of_a_model, monkeypatch):
    from jaxgrasp.resistance import solve as resistance

    batch = batch_of_a_model
    whole = jg.wrench_resistance(build(batch))
    for width in (16, 32):
        monkeypatch.setattr(resistance, "tile_width", lambda _, w=width: w)
        assert_same_bits(whole, jg.wrench_resistance(build(batch)))


def test_padding_does_not_change_a_bit(batch_of_a_model):
    few = {name: value[:40] for name, value in batch_of_a_model.items()}
    k = few["active"].shape[1]
    kept = 2 * k // 3
    few["active"] = np.tile(np.arange(k) < kept, (40, 1))
    short = {name: value[:, :kept] for name, value in few.items()}
    long, cut = jg.wrench_resistance(build(few)), jg.wrench_resistance(build(short))
    np.testing.assert_array_equal(long.status, cut.status)
    np.testing.assert_allclose(long.margin, cut.margin, rtol=1e-9, atol=2e-8)
    assert (np.asarray(long.internal_force).reshape(40, k, -1)[:, kept:] == 0).all()


def test_batch_axes_jit_and_vmap_agree_bit_for_bit(batch_of_a_model):
    batch = batch_of_a_model
    grasp = build(batch)
    flat = jg.wrench_resistance(grasp)
    folded = build({name: value.reshape(3, 50, *value.shape[1:]) for name, value in batch.items()})
    expected = jax.tree.map(lambda x: x.reshape(3, 50, *x.shape[1:]), flat)
    assert_same_bits(expected, jg.wrench_resistance(folded))
    assert_same_bits(expected, jax.jit(jg.wrench_resistance)(folded))
    assert_same_bits(flat, jax.vmap(jg.wrench_resistance)(grasp))
    assert_same_bits(expected, jax.vmap(jax.vmap(jg.wrench_resistance))(folded))
    assert_same_bits(jax.tree.map(lambda x: x[7], flat), jg.wrench_resistance(grasp[7]))


@F32
def test_verdict_only_agrees_and_stops_earlier(batch):
    grasp = build(batch)
    full, quick = jg.wrench_resistance(grasp), jg.wrench_resistance(grasp, verdict_only=True)
    decided = (np.asarray(full.status) < Status.MARGINAL) & (np.asarray(quick.status) < Status.MARGINAL)
    assert decided.mean() > 0.97
    np.testing.assert_array_equal(np.asarray(full.status)[decided], np.asarray(quick.status)[decided])
    assert np.asarray(quick.iterations).sum() < 0.5 * np.asarray(full.iterations).sum()
    assert jg.check(grasp, quick).all()


@F32
def test_dtype_is_kept(batch, dtype):
    res = jg.wrench_resistance(build(batch))
    assert res.rank.dtype == res.status.dtype == jnp.int32
    for name in ("lower", "upper", "margin", "gap", "internal_force", "escape_twist"):
        assert getattr(res, name).dtype == dtype
    assert res.status.dtype == res.iterations.dtype == res.stop.dtype == jnp.int32


def test_units_do_not_change_the_verdict(batch):
    base = jg.wrench_resistance(build(batch))
    millimetres = dict(batch, position=batch["position"] * 1e3, torsion=batch["torsion"] * 1e3)
    scaled = jg.wrench_resistance(build(millimetres))
    np.testing.assert_array_equal(base.status, scaled.status)
    np.testing.assert_allclose(base.margin, scaled.margin, rtol=1e-7, atol=2e-8)


def test_wrong_structure_raises_at_trace_time(batch):
    grasp = build(batch)
    with pytest.raises(ValueError, match=r"jaxgrasp\.Grasp"):
        jg.wrench_resistance(np.zeros((3, 3)))
    with pytest.raises(ValueError, match="positive"):
        jg.wrench_resistance(grasp, tolerance=0.0)
    with pytest.raises(ValueError, match="planar soft finger"):
        jg.Grasp(np.zeros((2, 2)), np.ones((2, 2)), jg.SoftFinger())


@pytest.mark.parametrize(("k", "dimension"), [(PLANAR, 2), pytest.param(HARD, 3, marks=pytest.mark.slow)])
def test_one_grasp_under_jit(k, dimension):
    """XLA once dropped the loop over tiles when the batch was a single grasp known at compile time."""
    rng = np.random.default_rng(4)
    normal = rng.normal(size=(1, k, dimension))
    grasp = jg.Grasp(-normal / np.linalg.norm(normal, axis=-1, keepdims=True), normal, jg.HardFinger(0.5))
    eager, jitted = jg.wrench_resistance(grasp), jax.jit(jg.wrench_resistance)(grasp)
    assert int(jitted.status[0]) == int(eager.status[0]) != 0
    np.testing.assert_allclose(jitted.margin, eager.margin, atol=1e-8)


@F32
def test_numbers_that_over_or_underflow_are_invalid_or_solved(dtype):
    """The tetrahedron at mu = 0.5 has margin 1 at every size; squares of sizes beyond 2^+-256 would not hold."""
    tiny, huge = (1e-310, 1e308) if dtype == "float64" else (1e-40, 3e38)
    limit = 2.0**256 if dtype == "float64" else 2.0**32
    sizes = [tiny, 1e-160 if dtype == "float64" else 1e-20, 1.8 / limit, 1.0, limit, 4 * limit, huge]
    position = np.array(sizes)[:, None, None] * TETRAHEDRON
    grasp = jg.Grasp(position.astype(dtype), -TETRAHEDRON.astype(dtype), jg.HardFinger(0.5))
    res = jg.wrench_resistance(grasp)
    assert list(res.status) == [Status.INVALID] * 2 + [Status.RESISTANT] * 3 + [Status.INVALID] * 2
    np.testing.assert_allclose(res.margin[2:5], 1.0, atol=TIGHT[dtype])
    np.testing.assert_array_equal(jg.contacts.is_grasp(grasp), np.asarray(res.status) == Status.RESISTANT)
    lengths = np.array([tiny, 2 * np.finfo(dtype).tiny, 1.0, huge])
    normal = (-lengths[:, None, None] * TETRAHEDRON).astype(dtype)
    res = jg.wrench_resistance(jg.Grasp(TETRAHEDRON.astype(dtype), normal, jg.HardFinger(0.5)))
    assert list(res.status) == [Status.INVALID] + [Status.RESISTANT] * 3
    np.testing.assert_allclose(res.margin[1:], 1.0, atol=TIGHT[dtype])


@pytest.mark.parametrize("dtype", ["float16", "bfloat16"])
def test_half_precision_is_refused_with_what_to_do(dtype):
    half = jnp.asarray(TETRAHEDRON, dtype)
    for position, friction in ((half, 0.5), (TETRAHEDRON, jnp.full(4, 0.5, dtype))):
        with pytest.raises(ValueError, match=f"{dtype}, but proofs need float32 or float64: convert first"):
            jg.Grasp(position, -TETRAHEDRON, jg.HardFinger(friction))
    whole = jg.Grasp(TETRAHEDRON, -TETRAHEDRON, jg.HardFinger(0.5))
    with pytest.raises(ValueError, match=f"{dtype}, but proofs need"):
        jg.wrench_resistance(jax.tree.map(lambda x: x.astype(dtype) if x.dtype != bool else x, whole))


def moved(grasp, twist):
    """Velocities (N, k, 3) of the contacts in metres over L for unit twists (v, L omega), and their normal parts."""
    p, n = np.asarray(grasp.position, np.float64), unit(grasp.normal)
    length = np.linalg.norm(p, axis=-1).max(-1)[:, None]
    v, w = np.asarray(twist, np.float64)[:, :3], np.asarray(twist, np.float64)[:, 3:] * length
    size = np.sqrt((v**2).sum(-1) + (w**2).sum(-1))[:, None]
    v, w = v / size, w / size
    velocity = v[:, None] + np.cross(w[:, None], p / length[..., None])
    return velocity, (velocity * n).sum(-1)


@F32
def test_a_verdict_by_rank_holds_for_numbers_within_rounding(dtype):
    """Contacts on a line, to rounding: each one's velocity is 0 within 64 eps, for any friction and any normals."""
    rng = np.random.default_rng(8)
    line = unit(rng.normal(size=(300, 1, 3)))
    position = rng.uniform(-1, 1, (300, 4, 1)) * line * 10.0 ** rng.uniform(-3, 3, (300, 1, 1))
    normal = rng.normal(size=position.shape) * 10.0 ** rng.uniform(-3, 3, (300, 4, 1))
    friction = 10.0 ** rng.uniform(-4, 1, (300, 4))
    grasp = jg.Grasp(position.astype(dtype), normal.astype(dtype), jg.HardFinger(friction))
    res = jg.wrench_resistance(grasp)
    no = np.asarray(res.status) == Status.NOT_RESISTANT
    assert no.mean() > 0.99 and not (np.asarray(res.status) == Status.RESISTANT).any()
    velocity, _ = moved(grasp, res.escape_twist)
    by_rank = no & (np.asarray(res.lower) > 0)
    assert by_rank.sum() > 30
    assert np.linalg.norm(velocity, axis=-1)[by_rank].max() <= 64 * np.finfo(dtype).eps


@F32
def test_little_friction_is_not_taken_for_none(dtype):
    """The tetrahedron is resistant at any mu > 0; NOT_RESISTANT only where rounding could make mu 0: up to 64 eps."""
    eps = float(np.finfo(dtype).eps)
    mu = eps * np.array([0.0, 1e-3, 1, 20, 70, 200, 1e3, 1e5])
    shape = (len(mu), 4, 3)
    position = np.broadcast_to(TETRAHEDRON, shape).astype(dtype)
    res = jg.wrench_resistance(jg.Grasp(position, -position, jg.HardFinger(mu[:, None])))
    no = np.asarray(res.status) == Status.NOT_RESISTANT
    assert no[:4].all() and not no[4:].any()
    assert (res.status[6], res.status[7]) == (Status.RESISTANT, Status.RESISTANT)


def test_frictionless_contacts_on_a_line_have_no_full_rank():
    """Singular values of rounding count once, by one rule; what is claimed of the rank is what SVD says."""
    rng = np.random.default_rng(12)
    line = unit(rng.normal(size=(500, 1, 3)))
    position = rng.uniform(-0.2, 0.2, (500, 7, 1)) * line
    grasp = jg.Grasp(position, rng.normal(size=position.shape), jg.Frictionless())
    res = jg.wrench_resistance(grasp)
    values = np.asarray(jg.contacts.grasp_singular_values(grasp))
    eps = np.finfo(np.float64).eps
    least, most = ((values > c * eps * values[:, :1]).sum(-1) for c in (128, 32))
    rank = np.asarray(res.rank)
    assert (least <= rank).all() and (rank <= most).all() and (rank < 6).all()
    assert (np.asarray(res.status) == Status.NOT_RESISTANT).all()


def test_minus_infinity_is_no_rounding_of_a_dependent_row():
    """Two fingers with the line between them at 1e-3 to the first axis: rank 5, and a squeeze of finite margin."""
    rng = np.random.default_rng(3)
    far = unit(np.concatenate([np.ones((400, 1)), 1e-3 * rng.normal(size=(400, 2))], -1))
    position = np.stack([far, -far], 1)
    normal = -position + 0.2 * rng.normal(size=position.shape)
    res = jg.wrench_resistance(jg.Grasp(position, normal, jg.HardFinger(0.5)))
    assert (np.asarray(res.rank) == 5).all()
    assert np.isfinite(np.asarray(res.lower)).all() and (np.asarray(res.gap) < 1e-6).mean() > 0.9


def test_brackets_of_ill_conditioned_grasps_hold():
    """Two contacts 1e-7 apart turn the margin hugely negative: lower <= upper, by independent longdouble arithmetic."""
    rng = np.random.default_rng(4)
    position = unit(rng.normal(size=(200, 7, 3)))
    normal = -position + 0.3 * rng.normal(size=position.shape)
    position[:, 1] = position[:, 0] + 1e-7 * rng.normal(size=(200, 3))
    normal[:, 1] = normal[:, 0] + 1e-7 * rng.normal(size=(200, 3))
    grasp = jg.Grasp(position, normal, jg.Frictionless())
    res = jg.wrench_resistance(grasp)
    wide = np.longdouble
    n = np.asarray(normal, wide)
    n /= np.sqrt((n * n).sum(-1, keepdims=True))
    p = np.asarray(position, wide)
    p /= np.sqrt((p * p).sum(-1).max(-1))[:, None, None]
    A = np.swapaxes(np.concatenate([n, np.cross(p, n)], -1), 1, 2)  # (N, 6, 7): one null vector
    null = np.linalg.svd(np.asarray(A, np.float64))[2][:, -1].astype(wide)
    pinv = np.linalg.pinv(np.asarray(A, np.float64)).astype(wide)
    for _ in range(4):
        null = null - np.einsum("nij,nj->ni", pinv, np.einsum("nij,nj->ni", A, null))
    true = null * (7 / null.sum(-1, keepdims=True))
    true = true.min(-1)
    error = 1e-15 * true**2  # of longdouble: the sum of the null vector cancels
    assert (np.asarray(res.lower, wide) <= true + error).all()
    assert (np.asarray(res.upper, wide) >= true - error).all()
    assert (true < -1e3).sum() > 50
