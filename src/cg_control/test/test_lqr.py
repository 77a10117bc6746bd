"""Regulators against closed forms and against their own optimality."""

import numpy as np
import pytest
from scipy.linalg import solve_discrete_are

from cg_control.balancing.lqr import LqrError, dlqr, lqr

DOUBLE_INTEGRATOR = (np.array([[0.0, 1.0], [0.0, 0.0]]), np.array([[0.0], [1.0]]))


def test_double_integrator_has_its_closed_form():
    # Textbook: Q = I, R = 1 gives K = (1, sqrt 3), S = [[sqrt 3, 1], [1, sqrt 3]].
    regulator = lqr(*DOUBLE_INTEGRATOR, np.eye(2), np.eye(1))
    root = np.sqrt(3.0)
    np.testing.assert_allclose(regulator.K, [[1.0, root]], rtol=1e-12)
    np.testing.assert_allclose(regulator.S, [[root, 1.0], [1.0, root]], rtol=1e-12)


def test_scalar_sampled_system_has_its_closed_form():
    # x+ = x + u, Q = R = 1: S^2 - S - 1 = 0, the golden ratio; K = S / (1 + S).
    golden = (1 + np.sqrt(5)) / 2
    regulator = dlqr([[1.0]], [[1.0]], [[1.0]], [[1.0]])
    np.testing.assert_allclose(regulator.S, [[golden]], rtol=1e-12)
    np.testing.assert_allclose(regulator.K, [[golden / (1 + golden)]], rtol=1e-12)


def test_cost_to_go_is_the_cost_of_the_closed_loop():
    rng = np.random.default_rng(3)
    A, B = rng.standard_normal((4, 4)) * 0.6, rng.standard_normal((4, 1))
    Q, R = np.diag([1.0, 2.0, 0.5, 0.1]), np.array([[0.3]])
    regulator = dlqr(A, B, Q, R)
    x = x0 = rng.standard_normal(4)
    cost = 0.0
    for _ in range(2000):
        u = -regulator.K @ x
        cost += x @ Q @ x + u @ R @ u
        x = A @ x + B @ u
    assert cost == pytest.approx(x0 @ regulator.S @ x0, rel=1e-9)


@pytest.mark.parametrize('singular', [False, True])
def test_sampled_regulators_are_those_of_scipy(singular):
    rng = np.random.default_rng(7)
    for _ in range(50):
        n = int(rng.integers(1, 7))
        A, B = rng.standard_normal((n, n)), rng.standard_normal((n, 2))
        if singular:  # a state that is a copy of an input: no inverse, other route
            A[-1] = 0.0
        Q, R = np.diag(rng.uniform(0.1, 10.0, n)), np.diag(rng.uniform(0.1, 10.0, 2))
        expected = solve_discrete_are(A, B, Q, R)
        # The residual that is accepted, 1e-9, times the conditioning of such equations.
        np.testing.assert_allclose(dlqr(A, B, Q, R).S, expected, atol=1e-7 * expected.max())


def test_short_samples_lead_to_the_continuous_regulator():
    A, B = np.array([[0.0, 1.0], [10.0, -0.1]]), np.array([[0.0], [2.0]])
    Q, R = np.diag([3.0, 1.0]), np.array([[0.5]])
    T = 1e-5
    sampled = dlqr(np.eye(2) + A * T, B * T, Q * T, R * T)
    # First order in T times the fastest rate, about 10 1/s.
    np.testing.assert_allclose(sampled.K, lqr(A, B, Q, R).K, rtol=1e-3)


@pytest.mark.parametrize('design', [lqr, dlqr])
def test_what_cannot_be_stabilised_is_refused(design):
    A = np.diag([2.0, 3.0])
    with pytest.raises(LqrError):
        design(A, np.array([[0.0], [1.0]]), np.eye(2), np.eye(1))


@pytest.mark.parametrize(
    ('Q', 'R', 'named'),
    [
        (np.diag([1.0, -1.0]), np.eye(1), 'Q must be positive semidefinite'),
        (np.array([[1.0, 0.2], [0.0, 1.0]]), np.eye(1), 'Q must be symmetric'),
        (np.eye(2), np.zeros((1, 1)), 'R must be positive definite'),
        (np.eye(3), np.eye(1), 'Q has shape'),
        (np.eye(2), np.array([[np.nan]]), 'R must be finite'),
    ],
)
def test_weights_that_are_none_are_refused_by_name(Q, R, named):
    with pytest.raises(LqrError, match=named):
        lqr(*DOUBLE_INTEGRATOR, Q, R)
