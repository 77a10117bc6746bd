"""Impact: laws that the formula was not derived from."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

from cg_dynamics.assemble import parameter_vector
from cg_dynamics.errors import ModelError
from cg_dynamics.mechanisms import mechanism
from cg_dynamics.rig import STANCES, Setup
from cg_dynamics.rollout.compiled import compile_model
from cg_dynamics.walking.impact import impact, impact_function, other
from cg_dynamics.walking.unpinned import ground_reaction, unpinned

STATES = np.random.default_rng(seed=2).uniform(-1, 1, size=(8, 4)) * [0.5, 0.5, 2.0, 2.0]
PAYLOAD = {'mass': 1.9, 'distance': 0.33}


@pytest.fixture(params=['bare', 'inner payload', 'outer payload'])
def model(request, bare):
    if request.param == 'bare':
        return bare
    return bare.with_effect('payload', at=request.param.split()[0], **PAYLOAD)


class PointBodies:
    """The robot as separate bodies: (mass, place, velocity, inertia, angular rate) of each.

    Places are from the hip; leg masses are any that have the lumps.
    """

    def __init__(self, model, q, v, hip_velocity):
        p = model.values
        l, mt = p['leg_length'], p['total_mass']
        m3 = 0.1 * mt
        d3 = 4 * p['c6'] * mt * l / m3
        I3 = 4 * p['c3'] * mt * l**2 - m3 * d3**2
        self.bodies = []
        total = m3
        for leg, (c, moment) in enumerate([('c1', 'c4'), ('c2', 'c5')]):
            m = 0.35 * mt
            total += m
            d = p[moment] * mt * l / m
            inertia = (p[c] - p['c3']) * mt * l**2 - m * d**2
            self.add(m, -d, inertia, q[leg], v[leg], hip_velocity)
        self.add(m3, d3, I3, q.mean(), v.mean(), hip_velocity)
        self.add(mt - total, 0.0, 0.0, 0.0, 0.0, hip_velocity)
        for effect in model.effects:
            leg = 0 if effect.site == 'inner' else 1
            self.add(PAYLOAD['mass'], PAYLOAD['distance'] - l, 0.0, q[leg], v[leg], hip_velocity)

    def add(self, m, along, inertia, angle, rate, hip_velocity):
        place = along * np.array([np.sin(angle), np.cos(angle)])
        velocity = hip_velocity + along * rate * np.array([np.cos(angle), -np.sin(angle)])
        self.bodies.append((m, place, velocity, inertia, rate))

    def angular_momentum(self, about, only=None):
        """About a point, about +y (forward pitch): z v_x - x v_z."""
        total = 0.0
        for i, (m, place, velocity, inertia, rate) in enumerate(self.bodies):
            if only is None or i in only:
                x, z = place - about
                total += m * (z * velocity[0] - x * velocity[1]) + inertia * rate
        return total

    def linear_momentum(self):
        return sum(m * velocity for m, _, velocity, _, _ in self.bodies)

    def kinetic_energy(self):
        return sum(m * v @ v / 2 + i * w**2 / 2 for m, _, v, i, w in self.bodies)


def before_and_after(model, stance, x):
    l = model.values['leg_length']
    q, v = x[:2], x[2:]
    result = impact(model, stance, x)
    standing, landing = STANCES.index(stance), STANCES.index(other(stance))

    def foot(leg):
        return -l * np.array([np.sin(q[leg]), np.cos(q[leg])])

    def hip_velocity(leg, rates):
        return l * rates[leg] * np.array([np.cos(q[leg]), -np.sin(q[leg])])

    v_plus = result.x_plus[2:]
    minus = PointBodies(model, q, v, hip_velocity(standing, v))
    plus = PointBodies(model, q, v_plus, hip_velocity(landing, v_plus))
    return result, minus, plus, foot(landing), standing


@pytest.mark.parametrize('stance', STANCES)
@pytest.mark.parametrize('x', STATES)
def test_angular_momentum_about_the_landing_foot_is_conserved(model, stance, x):
    _, minus, plus, new_foot, _ = before_and_after(model, stance, x)
    np.testing.assert_allclose(
        plus.angular_momentum(new_foot), minus.angular_momentum(new_foot), atol=1e-12
    )


@pytest.mark.parametrize('stance', STANCES)
@pytest.mark.parametrize('x', STATES)
def test_angular_momentum_of_the_trailing_leg_about_the_hip_is_conserved(bare, stance, x):
    # The hip body is tied to both legs, so the law holds of a leg alone only without it.
    model = bare.with_values({'c3': 1e-7, 'c6': 0.0})
    _, minus, plus, _, standing = before_and_after(model, stance, x)
    np.testing.assert_allclose(
        plus.angular_momentum(np.zeros(2), only=[standing]),
        minus.angular_momentum(np.zeros(2), only=[standing]),
        atol=1e-5,  # c3 = 1e-7 of m_t l^2 = 17 kg m^2, times rates of a few rad/s
    )


@pytest.mark.parametrize('stance', STANCES)
@pytest.mark.parametrize('x', STATES)
def test_impulse_is_the_change_of_momentum_and_energy_is_lost(model, stance, x):
    result, minus, plus, _, _ = before_and_after(model, stance, x)
    np.testing.assert_allclose(
        result.impulse, plus.linear_momentum() - minus.linear_momentum(), atol=1e-11
    )
    lost = minus.kinetic_energy() - plus.kinetic_energy()
    np.testing.assert_allclose(result.energy_lost, lost, atol=1e-11)
    assert lost >= 0


@pytest.mark.parametrize('stance', STANCES)
def test_a_foot_that_lands_at_rest_changes_nothing(bare, stance):
    """Both legs in line and turning alike: the landing foot has no velocity (it is the pivot)."""
    x = np.array([0.3, 0.3, 1.1, 1.1])
    result = impact(bare, stance, x)
    np.testing.assert_allclose(result.x_plus, x, atol=1e-13)
    np.testing.assert_allclose(result.impulse, 0, atol=1e-12)


@pytest.mark.parametrize('stance', STANCES)
def test_second_impact_at_once_does_nothing_more_to_the_landed_foot(bare, stance):
    """The map is a projection: with the old foot ignored, what stuck stays stuck."""
    x = np.array([0.2, -0.25, 1.0, 0.4])
    once = impact(bare, stance, x)
    assert once.energy_lost > 0.1
    e = unpinned(bare, other(stance))
    assert once.stance == other(stance)
    kinetic = ca.Function('T', [e.q, e.v, e.p], [e.kinetic])
    p = parameter_vector(bare, Setup())
    start = unpinned(bare, stance)
    before = ca.Function('T', [start.q, start.v, start.p], [start.kinetic])
    left = float(kinetic([*x[:2], 0, 0], [*once.x_plus[2:], 0, 0], p))
    had = float(before([*x[:2], 0, 0], [*x[2:], 0, 0], p))
    np.testing.assert_allclose(had - left, once.energy_lost, rtol=1e-12)


def test_extra_states_pass_through(bare):
    model = bare.with_effect('joint_flexibility')
    x = np.array([0.2, -0.2, 1.0, 0.5, 0.41, 0.55])
    np.testing.assert_array_equal(impact(model, 'inner', x).x_plus[[0, 1, 4, 5]], x[[0, 1, 4, 5]])


def test_collision_gradient_is_eq_4_10_times_the_leg_length(bare):
    e = unpinned(bare, 'inner')
    A = ca.Function('A', [e.q, e.p], [ca.jacobian(e.swing_foot, e.q)])
    q = np.array([0.31, -0.17, 0.5, 0.1])
    found = np.asarray(A(q, parameter_vector(bare, Setup())))
    l = bare.values['leg_length']
    # The text looks at the plane from behind: x points backward there.
    printed = np.array(
        [
            [-np.cos(0.31), -np.sin(0.31)],
            [np.cos(-0.17), np.sin(-0.17)],
            [1, 0],
            [0, 1],
        ]
    ).T
    flip = np.diag([-1.0, 1.0])
    ours_in_text = flip @ found @ np.diag([1 / l, 1 / l, -1, 1])
    np.testing.assert_allclose(ours_in_text, printed, atol=1e-14)


def test_derivative_of_the_map_agrees_with_differences(bare):
    f = impact_function(bare, 'inner')
    q, v, p = (ca.MX.sym(n, k) for n, k in (('q', 2), ('v', 2), ('p', f.size1_in(2))))
    jacobian = ca.Function('J', [q, v, p], [ca.jacobian(f(q, v, p)[0], ca.vertcat(q, v))])
    x, p0 = np.array([0.2, -0.25, 1.0, 0.4]), parameter_vector(bare, Setup())
    J = np.asarray(jacobian(x[:2], x[2:], p0))
    for j in range(4):
        d = np.zeros(4)
        d[j] = 1e-6
        ahead, behind = (impact(bare, 'inner', x + s * d).x_plus[2:] for s in (1, -1))
        np.testing.assert_allclose(J[:, j], (ahead - behind) / 2e-6, atol=1e-7)


def test_other_mechanisms_have_no_impact(bare):
    model = replace(bare, mechanism=mechanism('pendulum'))
    with pytest.raises(ModelError, match='not of a pendulum'):
        unpinned(model, 'inner')


@pytest.mark.parametrize('stance', STANCES)
@pytest.mark.parametrize('x', STATES[:4])
def test_pinned_motion_is_unpinned_motion_held_by_the_ground(model, stance, x):
    """The angle rows of (UNP) with the foot at rest are the pinned equations."""
    setup = Setup(stance=stance)
    p = parameter_vector(model, setup)
    dv = np.asarray(compile_model(model, setup).f(x, 3.0, p)).ravel()[2:]
    e = unpinned(model, stance)
    residual = ca.Function('r', [e.q, e.v, e.p], [e.mass_matrix, e.bias])
    M, b = (np.asarray(a) for a in residual([*x[:2], 0, 0], [*x[2:], 0, 0], p))
    force = M @ [*dv, 0, 0] + b.ravel()
    np.testing.assert_allclose(force[:2], [3.0, -3.0], atol=1e-11)
    found = ground_reaction(model, stance, x[None], np.array([[3.0]]))[0]
    np.testing.assert_allclose(found, force[2:], atol=1e-11)


def test_ground_carries_the_weight_of_a_robot_at_rest(bare):
    """Upright and still: an equilibrium, so the ground carries weight and nothing else."""
    found = ground_reaction(bare, 'inner', np.zeros((1, 4)), np.zeros((1, 1)))
    v = bare.values
    np.testing.assert_allclose(found, [[0, v['total_mass'] * v['gravity']]], atol=1e-11)
