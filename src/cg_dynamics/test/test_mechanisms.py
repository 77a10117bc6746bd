"""Pendulum and double pendulum against their textbook equations."""

import casadi as ca
import numpy as np
import pytest

from cg_description.model_file import ModelFile, Quantity
from cg_dynamics.assemble import assemble, parameter_vector
from cg_dynamics.model import Model
from cg_dynamics.rig import Setup


def make(name, **values):
    from cg_dynamics.mechanisms import mechanism

    units = {p.name: p.unit for p in mechanism(name).parameters}
    quantities = {key: Quantity(value, units[key]) for key, value in values.items()}
    return Model.from_file(ModelFile(name, name, quantities))


@pytest.fixture
def pendulum():
    return make('pendulum', inertia=0.31, gravity_torque=4.2, gravity=9.81)


m1, m2, l1, r1, r2, I1, I2, g = 1.1, 0.7, 0.43, 0.21, 0.27, 0.013, 0.019, 9.7


@pytest.fixture
def double_pendulum():
    return make(
        'double_pendulum',
        upper_inertia=I1 + m1 * r1**2 + m2 * l1**2,
        lower_inertia=I2 + m2 * r2**2,
        coupling=m2 * r2 * l1,
        upper_gravity=(m1 * r1 + m2 * l1) * g,
        upper_length=l1,
        gravity=g,
    )


def right_side(model):
    e = assemble(model, Setup())
    f = ca.Function('f', [e.x, e.u, e.p], [e.rates])
    p = parameter_vector(model, Setup())
    return lambda x, u: np.asarray(f(x, u, p)).ravel()


def test_pendulum_obeys_its_textbook_equation(pendulum):
    x, u = np.array([0.7, -1.1]), 0.9
    expected = (u - 4.2 * np.sin(0.7)) / 0.31
    np.testing.assert_allclose(right_side(pendulum)(x, u), [-1.1, expected], rtol=1e-14)


def test_double_pendulum_has_the_energies_of_two_placed_bodies(double_pendulum, rng):
    q, v = ca.SX.sym('q', 2), ca.SX.sym('v', 2)
    absolute = ca.vertcat(q[0], q[0] + q[1])

    def below(angle, length):
        return ca.vertcat(ca.sin(angle) * length, -ca.cos(angle) * length)

    elbow = below(absolute[0], l1)
    places = [(m1, below(absolute[0], r1)), (m2, elbow + below(absolute[1], r2))]
    kinetic = I1 * v[0] ** 2 / 2 + I2 * (v[0] + v[1]) ** 2 / 2
    kinetic += sum(m * ca.sumsqr(ca.jtimes(r, q, v)) / 2 for m, r in places)
    potential = sum(m * g * r[1] for m, r in places)
    total = ca.Function('E', [q, v], [kinetic + potential])
    e = assemble(double_pendulum, Setup())
    ours = ca.Function('E', [e.x, e.p], [e.energy])
    p = parameter_vector(double_pendulum, Setup())
    for x in rng.uniform(-3, 3, size=(20, 4)):
        np.testing.assert_allclose(float(ours(x, p)), float(total(x[:2], x[2:])), rtol=1e-12)


def test_double_pendulum_torques_act_on_their_own_joints(double_pendulum, rng):
    e = assemble(double_pendulum, Setup())
    power = ca.Function('P', [e.x, e.u, e.p], [ca.jtimes(e.energy, e.x, e.rates)])
    p = parameter_vector(double_pendulum, Setup())
    for x in rng.uniform(-3, 3, size=(10, 4)):
        np.testing.assert_allclose(float(power(x, [2.0, 0.0], p)), 2 * x[2], atol=1e-11)
        np.testing.assert_allclose(float(power(x, [0.0, 3.0], p)), 3 * x[3], atol=1e-11)


def test_payload_on_the_pendulum_adds_its_moment_of_inertia(pendulum):
    loaded = pendulum.with_effect('payload', mass=0.4, distance=0.6)
    lumped = pendulum.with_values(
        {'inertia': 0.31 + 0.4 * 0.6**2, 'gravity_torque': 4.2 + 0.4 * 9.81 * 0.6}
    )
    x = np.array([0.7, -1.1])
    np.testing.assert_allclose(right_side(loaded)(x, 0.3), right_side(lumped)(x, 0.3), rtol=1e-13)


def test_payload_on_the_forearm_changes_all_base_parameters(double_pendulum):
    m, d = 0.3, 0.5
    loaded = double_pendulum.with_effect('payload', at='lower', mass=m, distance=d)
    v = double_pendulum.values
    lumped = double_pendulum.with_values(
        {
            'upper_inertia': v['upper_inertia'] + m * l1**2,
            'lower_inertia': v['lower_inertia'] + m * d**2,
            'coupling': v['coupling'] + m * d * l1,
            'upper_gravity': v['upper_gravity'] + m * l1 * g,
        }
    )
    x, u = np.array([0.7, -1.1, 2.0, 1.0]), [0.2, 0.1]
    np.testing.assert_allclose(right_side(loaded)(x, u), right_side(lumped)(x, u), rtol=1e-12)
