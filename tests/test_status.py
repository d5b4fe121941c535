"""Statuses: one number a word for ever, one sentence each; what every answer does with them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from shapes import SOFT

import jaxgrasp as jg
from jaxgrasp import Status

# The numbers are part of the file formats: none may change, new ones come at the end.
NUMBERS = {
    "RUNNING": 0,
    "RESISTANT": 1,
    "NOT_RESISTANT": 2,
    "MARGINAL": 3,
    "UNDECIDED": 4,
    "INVALID": 5,
    "OPTIMAL": 6,
    "INFEASIBLE": 7,
    "STALLED": 8,
    "CONVERGED": 9,
    "DECIDED": 10,
    "BREAKDOWN": 11,
    "SKIPPED": 12,
    "NON_MARGINAL": 13,
    "NO_EQUILIBRIUM": 14,
    "NOT_BALANCED": 15,
    "CONTROLLABLE": 16,
    "NOT_CONTROLLABLE": 17,
    "COMMANDED": 18,
    "PROJECTED": 19,
    "UNREGULATED": 20,
    "FEASIBLE": 21,
    "UNBOUNDED": 22,
    "PROVED_EXACTLY": 23,
    "PROVED_TO_ROUNDING": 24,
    "REFUSED": 25,
}


def test_numbers_and_sentences_are_fixed():
    assert {s.name: s.value for s in Status} == NUMBERS
    assert all(s.sentence.endswith(".") and s.sentence[0].isupper() for s in Status)
    assert len({s.sentence for s in Status}) == len(Status)


def test_members_are_found_by_entries_of_arrays_and_by_nothing_else():
    for member in Status:
        for array in (np.array([member.value], np.int32), jnp.array([member.value], jnp.int32)):
            assert Status(array[0]) is member
    for wrong in (99, 1.5, "RESISTANT", None):
        with pytest.raises(ValueError, match="not a valid"):
            Status(wrong)


@pytest.fixture(scope="module")
def answers(dtype):
    """Wrench resistance of a pinch that holds, one that does not, and one that is no grasp."""
    position = np.array([[[-1, 0, 0], [1, 0, 0]]] * 3, dtype)
    normal = np.array([[[1, 0, 0], [-1, 0, 0]], [[1, 0, 0], [1, 0, 0]], [[0, 0, 0], [0, 0, 0]]], dtype)
    position, normal = (np.pad(x, [(0, 0), (0, SOFT - 2), (0, 0)]) for x in (position, normal))
    return jg.wrench_resistance(jg.Grasp(position, normal, jg.SoftFinger(0.5, 0.1), np.arange(SOFT) < 2))


def test_an_answer_is_indexed_like_an_array(answers):
    one, some = answers[0], answers[answers.status != Status.INVALID]
    assert one.status.shape == () and one.batch_shape == ()
    assert some.batch_shape == (2,) and some.internal_force.shape == (2, 4 * SOFT)
    np.testing.assert_array_equal(some.lower, answers.lower[:2])
    with pytest.raises(IndexError, match="single answer"):
        one[0]


def test_an_answer_speaks_in_words(answers):
    assert answers.sentence(0) == Status.RESISTANT.sentence
    assert answers.sentence(2) == jg.WrenchResistance.SENTENCES[Status.INVALID]
    assert str(answers[0]).startswith("Wrench resistant (force closure)") and "rank 6" in str(answers[0])
    lines = str(answers).splitlines()
    assert lines[0] == "WrenchResistance of 3 lanes, shape (3,)"
    assert len(lines) == 4 and all("33.3%" in line for line in lines[1:])
    seen = []
    jax.jit(lambda answer: (seen.append(str(answer)), answer.lower)[1])(answers)
    assert seen == ["WrenchResistance of shape (3,), being traced"]


def test_a_bracket_is_lower_and_upper(answers):
    assert np.all(np.asarray(answers.lower)[:2] <= np.asarray(answers.upper)[:2])
    np.testing.assert_array_equal(answers.margin, answers.lower)
    np.testing.assert_array_equal(answers.gap[0], answers.upper[0] - answers.lower[0])
    assert np.isneginf(answers.upper[1]) and answers.gap[1] == 0
