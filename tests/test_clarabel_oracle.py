"""The oracle itself, on answers known in closed form."""

import numpy as np
import pytest
from clarabel_oracle import clarabel_margin

HARD, SOFT, PLANAR, NORMAL = ("f_x", "f_y", "f_n"), ("f_x", "f_y", "f_n", "tau_n"), ("f_x", "f_n"), ("f_n",)


def margin(*arguments):
    value, known = clarabel_margin(*arguments)
    assert known
    return value


def test_balanced_normals_have_margin_one():
    p = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]) / np.sqrt(3)
    assert margin(p, -p, 0.1, 0.0, None, HARD) == pytest.approx(1.0, abs=1e-9)
    angle = np.arange(3) * 2 * np.pi / 3
    p = np.stack([np.cos(angle), np.sin(angle), 0 * angle], -1)
    assert margin(p, -p, 0.4, 0.0, None, HARD) == pytest.approx(1.0, abs=1e-9)
    assert margin(p[:, :2], -p[:, :2], 0.4, 0.0, None, PLANAR) == pytest.approx(1.0, abs=1e-9)
    antipodal = np.array([[-1.0, 0, 0], [1, 0, 0]])
    for names in (HARD, SOFT, NORMAL):
        assert margin(antipodal, -antipodal, 0.5, 0.1, None, names) == pytest.approx(1.0, abs=1e-9)


def test_two_planar_fingers_follow_nguyen():
    """Line through both contacts, normals tilted by a to it: t* = 1 - tan(a) / mu for symmetric fingers."""
    a = np.radians(20)
    p = np.array([[-1.0, 0], [1, 0]])
    n = np.array([[np.cos(a), np.sin(a)], [-np.cos(a), np.sin(a)]])
    for mu in (0.2, np.tan(a), 0.8):
        assert margin(p, n, mu, 0.0, None, PLANAR) == pytest.approx(1 - np.tan(a) / mu, abs=1e-8)


def test_two_soft_fingers_of_theory():
    p = np.array([[-1.0, 0, 0], [1, 0, 0]])
    n = np.array([[np.sqrt(3), 1, 0], [-np.sqrt(3), 0, 1]]) / 2
    assert margin(p, n, 0.5, 2.0, None, SOFT) == pytest.approx(0.106, abs=5e-4)
    assert margin(p, n, 0.5, 0.01, None, SOFT) == pytest.approx(-0.155, abs=5e-4)


def test_three_contacts_one_of_them_without_friction():
    p = np.array([[-1.0, 0, 0], [0, 0, -1], [0, 0, 1]])
    value = margin(p, -p, [0.0, 1.0, 1.0], 0.0, None, HARD)
    assert value == pytest.approx(
        0.75, abs=1e-8
    )  # f_n = (0.75, 1.125, 1.125) with 0.375 of tangential force each


def test_inactive_contacts_lengths_and_normals_scale_away():
    rng = np.random.default_rng(0)
    p = rng.normal(size=(5, 3))
    n = -p + 0.3 * rng.normal(size=p.shape)
    active = np.array([True, True, True, True, False])
    base = margin(p[:4], n[:4], 0.5, 0.2, None, SOFT)
    assert margin(1e3 * p, 7.0 * n, 0.5, 200.0, active, SOFT) == pytest.approx(base, abs=1e-8)


def test_no_squeeze_is_minus_infinity():
    p, n = np.array([[1.0, 0, 0], [0, 1, 0]]), np.array([[0.0, 0, 1], [0, 0, 1]])
    assert margin(p, n, 0.0, 0.0, None, HARD) == -np.inf
    assert margin(p, n, 0.0, 0.0, None, NORMAL) == -np.inf
    assert margin(p[:1], n[:1], 0.5, 0.1, None, SOFT) == -np.inf


def test_normals_in_a_half_space_have_negative_margin():
    angle = np.arange(4) * np.pi / 2
    p = np.stack([np.cos(angle), np.sin(angle), 0.2 + 0 * angle], -1)
    n = np.stack([-np.cos(angle), -np.sin(angle), 1 + 0 * angle], -1) / np.sqrt(2)
    assert margin(p, n, 0.1, 0.0, None, HARD) == pytest.approx(1 - 1 / 0.1, abs=1e-7)
