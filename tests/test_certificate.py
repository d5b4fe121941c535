"""The checker accepts proofs and nothing else: every tampering is refused."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from grasps import random_coefficients, random_contacts

import jaxgrasp as jg
from jaxgrasp import Status


@pytest.fixture(scope="module")
def solved():
    rng = np.random.default_rng(11)
    position, normal, _ = random_contacts(rng, 300, 6, 3)
    friction, torsion = random_coefficients(rng, 300, 6)
    grasp = jg.Grasp(position, normal, jg.SoftFinger(friction, torsion))
    return grasp, jg.wrench_resistance(grasp)


def replaced(res, **fields):
    names = list(fields)
    return eqx.tree_at(lambda r: [getattr(r, n) for n in names], res, [jnp.asarray(fields[n]) for n in names])


def test_accepts_the_solver(solved):
    grasp, res = solved
    assert set(np.unique(res.status)) >= {Status.RESISTANT, Status.NOT_RESISTANT}
    assert jg.check(grasp, res).all()


def test_refuses_the_opposite_verdict(solved):
    grasp, res = solved
    yes, no = np.asarray(res.status) == Status.RESISTANT, np.asarray(res.status) == Status.NOT_RESISTANT
    flipped = replaced(res, status=np.where(yes, 2, np.where(no, 1, res.status)).astype(np.int32))
    assert not jg.check(grasp, flipped)[yes | no].any()
    same_twist_for_all = replaced(flipped, escape_twist=np.tile(np.eye(6)[2], (300, 1)))
    assert not jg.check(grasp, same_twist_for_all)[yes].any()


def test_refuses_a_disturbed_force(solved):
    grasp, res = solved
    yes = np.asarray(res.status) == Status.RESISTANT
    force = np.asarray(res.internal_force)
    rng = np.random.default_rng(0)
    noisy = replaced(res, internal_force=force + 10 * rng.normal(size=force.shape))
    assert not jg.check(grasp, noisy)[yes].any()
    assert not jg.check(grasp, replaced(res, internal_force=-force))[yes].any()
    assert not jg.check(grasp, replaced(res, internal_force=force * np.nan))[yes].any()


def test_refuses_a_reversed_or_missing_twist(solved):
    grasp, res = solved
    strict = (np.asarray(res.status) == Status.NOT_RESISTANT) & (np.asarray(res.rank) == 6)
    twist = np.asarray(res.escape_twist)
    assert strict.sum() > 50
    assert not jg.check(grasp, replaced(res, escape_twist=-twist))[strict].any()
    assert not jg.check(grasp, replaced(res, escape_twist=0 * twist))[strict].any()


def test_refuses_invalid_claims_about_sound_grasps(solved):
    grasp, res = solved
    claim = replaced(res, status=np.full(300, Status.INVALID, np.int32))
    assert not jg.check(grasp, claim).any()
    claim = replaced(res, status=np.full(300, 17, np.int32))
    assert not jg.check(grasp, claim).any()


def test_refuses_marginal_claims_about_clear_grasps(solved):
    grasp, res = solved
    clear = np.abs(np.asarray(res.margin)) > 1e-3
    claim = replaced(res, status=np.full(300, Status.MARGINAL, np.int32))
    assert not jg.check(grasp, claim)[clear].any()


def test_a_rank_claim_needs_a_rank_deficient_map(solved):
    """A twist that most contacts do not notice is no proof for a grasp of full rank."""
    grasp, res = solved
    yes = np.asarray(res.status) == Status.RESISTANT
    G = np.asarray(jg.contacts.folded_grasp_map(grasp))
    weakest = np.linalg.svd(G)[0][..., -1]
    claim = replaced(res, status=np.full(300, Status.NOT_RESISTANT, np.int32), escape_twist=weakest)
    assert not jg.check(grasp, claim)[yes].any()


def test_scale_and_batch_of_the_proof_do_not_matter(solved):
    grasp, res = solved
    scaled = replaced(
        res,
        internal_force=1e3 * np.asarray(res.internal_force),
        escape_twist=1e-3 * np.asarray(res.escape_twist),
    )
    assert jg.check(grasp, scaled).all()
    one = jg.check(grasp[4], jg.wrench_resistance(grasp[4]))
    assert one.shape == ()
    assert one
