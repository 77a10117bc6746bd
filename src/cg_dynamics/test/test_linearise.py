"""Linearisation: known eigenvalues, differences, and Eq. 4.8 where it holds."""

import casadi as ca
import numpy as np
import pytest

from cg_dynamics.assemble import assemble, parameter_vector
from cg_dynamics.effects import LIBRARY
from cg_dynamics.linearise import linearise
from cg_dynamics.mechanisms import MECHANISMS
from cg_dynamics.rig import Setup
from cg_dynamics.rollout.compiled import compile_model


def test_upright_stance_has_the_known_eigenvalues(robot):
    """SysID column of Table 4.1 without friction: +-3.18 and +-2.92i 1/s."""
    model = robot.without_effect('viscous_friction').without_effect('coulomb_friction')
    A = linearise(model, Setup(), np.zeros(4), np.zeros(1)).A
    found = np.sort_complex(np.linalg.eigvals(A))
    np.testing.assert_allclose(found, [-3.1831, -2.9240j, 2.9240j, 3.1831], atol=5e-5)


def test_smoothed_dry_friction_locks_the_hip_at_standstill(robot):
    """Its slope is torque / transition rate: the legs then fall as one inverted pendulum."""
    rates = linearise(robot, Setup(), np.zeros(4), np.zeros(1))
    tied = linearise(robot, Setup(fixture='legs_tied'), np.zeros(2), np.zeros(1))
    fastest = np.linalg.eigvals(rates.A).real.max()
    assert fastest == pytest.approx(np.linalg.eigvals(tied.A).real.max(), rel=5e-3)


@pytest.mark.parametrize(
    'name', [n for n, e in LIBRARY.items() if e.sites(MECHANISMS['compass_gait'])]
)
def test_jacobians_agree_with_differences_under_every_effect(bare, name):
    model = bare.with_effect(name)
    compiled = compile_model(model, Setup())
    p = parameter_vector(model, Setup())
    u = np.array([2.0, 0.7, 1.1])[: compiled.nu]
    x = np.concatenate([[0.1, -0.2, 0.3, 0.35], np.zeros(compiled.nx - 4)])
    x[4:] = compiled.initial_state(x[:4], u, p)[4:]
    found = linearise(model, Setup(), x, u)
    h = 1e-6
    for function, by_x, by_u in ((compiled.f, found.A, found.B), (compiled.h, found.C, found.D)):
        for j in range(compiled.nx):
            d = np.zeros(compiled.nx)
            d[j] = h
            slope = np.asarray(function(x + d, u, p) - function(x - d, u, p)) / (2 * h)
            np.testing.assert_allclose(by_x[:, j], slope.ravel(), rtol=1e-5, atol=1e-6)
        for j, d in enumerate(h * np.eye(compiled.nu)):
            slope = np.asarray(function(x, u + d, p) - function(x, u - d, p)) / (2 * h)
            np.testing.assert_allclose(by_u[:, j], slope.ravel(), rtol=1e-5, atol=1e-7)


def test_eq_4_8_and_4_9_hold_at_the_upright_equilibrium(bare):
    """A = [0 I; -H^-1 dG/dq, -H^-1 C], C = 0 at rest; B = [0; H^-1 B]."""
    e = assemble(bare, Setup())
    q, v = e.x[:2], e.x[2:]
    G = ca.substitute(-ca.mtimes(e.mass_matrix, e.rates[2:]), ca.vertcat(v, e.u), ca.DM.zeros(3))
    parts = ca.Function('parts', [q, e.p], [e.mass_matrix, ca.jacobian(G, q)])
    p = parameter_vector(bare, Setup())
    H, dG = (np.asarray(part) for part in parts(np.zeros(2), p))
    A = np.block([[np.zeros((2, 2)), np.eye(2)], [-np.linalg.solve(H, dG), np.zeros((2, 2))]])
    B = np.concatenate([np.zeros(2), np.linalg.solve(H, [1.0, -1.0])])
    found = linearise(bare, Setup(), np.zeros(4), np.zeros(1))
    np.testing.assert_allclose(found.A, A, atol=1e-11)
    np.testing.assert_allclose(found.B.ravel(), B, atol=1e-13)
    np.testing.assert_allclose(found.rates, 0, atol=1e-14)


def test_sensors_are_linear_in_the_state(robot, setup):
    nx = compile_model(robot, setup).nx
    found = linearise(robot, setup, np.full(nx, 0.1), np.zeros(1))
    np.testing.assert_allclose(found.C @ np.full(nx, 0.1), found.outputs, atol=1e-14)
