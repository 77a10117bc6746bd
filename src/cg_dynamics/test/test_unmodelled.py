"""Learned terms: their laws, where they act, and that every simulator knows them."""

import casadi as ca
import numpy as np
import pytest

from cg_description.paths import model_path
from cg_dynamics.assemble import assemble, parameter_vector
from cg_dynamics.effects import LIBRARY, UNMODELLED
from cg_dynamics.effects.unmodelled import COSINES
from cg_dynamics.mechanisms import MECHANISMS
from cg_dynamics.model import Model
from cg_dynamics.rig import Setup, Spring
from cg_dynamics.rollout.batch import simulate_batch
from cg_dynamics.rollout.compiled import CompiledModel, compile_model, simulate

COMPASS = MECHANISMS['compass_gait']
EVERYWHERE = [(name, site) for name, cls in UNMODELLED.items() for site in cls.sites(COMPASS)]
# One of each kind of place and each law: compiling all of them takes minutes.
EXAMPLES = (
    'unmodelled_joint_torque_of_torque',
    'unmodelled_joint_friction_of_body_angle',
    'unmodelled_torque_gain_periodic_in_angle',
    'unmodelled_outer_torque_vibrating_in_time',
    'unmodelled_angle_error_of_rate',
)
TIME = np.arange(0, 0.4, 0.002)
TORQUE = 6 * np.sin(2 * np.pi * 3 * TIME)
START = np.array([0.05, 0.12, 0.2, -0.3])
SETUP = Setup(springs=(Spring('inner', 0.9, (-0.6, 1.0), 400.0, 0.3),))


def extended(model, name, site=None, seed=0):
    """A model with a term whose coefficients are all different from zero."""
    cls = UNMODELLED[name]
    size = {'N m': 0.3, '1': 0.1, 'N m s/rad': 0.1, 'rad': 0.01, 'rad/s': 0.02}[cls.unit]
    values = size * np.random.default_rng(seed).standard_normal(len(cls.coefficients))
    return model.with_effect(name, site, **dict(zip(cls.coefficients, values, strict=True)))


def inputs(compiled):
    known = {'hip_torque': TORQUE, 'time': TIME}
    return np.column_stack([known[name] for name in compiled.input_names])


def run(model):
    compiled = compile_model(model, SETUP)
    return simulate(model, SETUP, TIME, inputs(compiled), START)


def law(name, values, s):
    """g(s) by what the class says of it."""
    cls = UNMODELLED[name]
    p = {q.name: ca.SX.sym(q.name) for q in cls.parameters}
    x = ca.SX.sym('s')
    g = ca.Function('g', [x, *p.values()], [cls.law(x, p)])
    return np.array([float(g(v, *(values[key] for key in p))) for v in s])


# --- the laws ---------------------------------------------------------------------------------


def test_smooth_law_is_a_cosine_series_that_stays_where_data_end():
    name, low, high = 'unmodelled_joint_torque_of_angle', -0.4, 0.9
    c = np.random.default_rng(1).standard_normal(COSINES)
    values = {'low': low, 'high': high, **{f'c{k}': v for k, v in enumerate(c)}}
    s = np.linspace(low, high, 50)
    expected = np.cos(np.pi * np.outer((s - low) / (high - low), np.arange(COSINES))) @ c
    # Rounding of 32 Chebyshev recursions.
    np.testing.assert_allclose(law(name, values, s), expected, atol=1e-11)
    outside = law(name, values, [low - 3.0, low, high, high + 50.0])
    np.testing.assert_allclose(outside[[0, 3]], outside[[1, 2]], rtol=1e-12)


@pytest.mark.parametrize('name', [n for n, c in UNMODELLED.items() if c.kind != 'smooth'])
def test_other_laws_repeat(name):
    cls = UNMODELLED[name]
    c = np.random.default_rng(2).standard_normal(len(cls.coefficients))
    values = {'period': 0.23, 'transition_rate': 0.01}
    values |= dict(zip(cls.coefficients, c, strict=True))
    s = np.linspace(-0.3, 0.4, 40)
    once = law(name, values, s)
    np.testing.assert_allclose(law(name, values, s + 0.23), once, atol=1e-11)
    assert np.ptp(once) > 0.1


# --- where they act -----------------------------------------------------------------------------


def test_they_are_no_candidates_of_the_library():
    assert not set(UNMODELLED) & set(LIBRARY)
    assert all(name.startswith('unmodelled_') for name in UNMODELLED)


def equations(model):
    """(state, reported torque, time) -> rates and outputs."""
    e = assemble(model, Setup())
    f = ca.Function('f', [e.x, e.u, e.p], [ca.vertcat(e.rates, e.outputs), e.mass_matrix])

    def evaluate(x, torque, time):
        known = {'hip_torque': torque, 'time': time}
        u = [known[channel] for channel in e.input_names]
        return tuple(np.asarray(part) for part in f(x, u, parameter_vector(model, Setup())))

    return evaluate


@pytest.mark.parametrize(('name', 'site'), EVERYWHERE)
def test_zero_function_changes_nothing_and_any_other_does(bare, name, site):
    at = (np.array([0.1, -0.2, 0.4, 1.0]), 0.35, 0.7)
    plain = equations(bare)(*at)[0]
    np.testing.assert_allclose(equations(bare.with_effect(name, site))(*at)[0], plain, atol=1e-12)
    assert np.abs(equations(extended(bare, name, site))(*at)[0] - plain).max() > 1e-4


@pytest.mark.parametrize(
    ('name', 'site', 'added'),
    [
        ('unmodelled_joint_torque_of_angle', 'hip', lambda g, u: (g(0.3), -g(0.3))),
        ('unmodelled_joint_torque_of_rate', 'hip', lambda g, u: (g(-0.6), -g(-0.6))),
        ('unmodelled_joint_torque_of_torque', 'hip', lambda g, u: (g(u), -g(u))),
        ('unmodelled_joint_torque_of_time', 'hip', lambda g, u: (g(0.7), -g(0.7))),
        ('unmodelled_joint_torque_of_body_angle', 'hip:q_outer', lambda g, u: (g(-0.2), -g(-0.2))),
        ('unmodelled_joint_friction_of_angle', 'hip', lambda g, u: (g(0.3), -g(0.3))),
        ('unmodelled_joint_friction_of_body_angle', 'hip:q_inner',
         lambda g, u: (g(0.1), -g(0.1))),
        ('unmodelled_joint_damping_of_angle', 'hip', lambda g, u: (0.6 * g(0.3), -0.6 * g(0.3))),
        ('unmodelled_torque_gain_of_angle', 'hip', lambda g, u: (g(0.3) * u, -g(0.3) * u)),
        ('unmodelled_outer_torque_of_angle', 'outer', lambda g, u: (0.0, g(-0.2))),
        ('unmodelled_outer_torque_of_rate', 'stance', lambda g, u: (g(0.4), 0.0)),
    ],
)  # fmt: skip
def test_term_is_that_much_generalised_force(bare, name, site, added):
    """At angles (0.1, -0.2) and rates (0.4, 1.0): M dv/dt changes by what was added."""
    x, torque = np.array([0.1, -0.2, 0.4, 1.0]), 0.35
    model = extended(bare, name, site)

    def force(model):
        found, mass_matrix = equations(model)(x, torque, 0.7)
        return mass_matrix @ found.ravel()[2:4]

    label = model.effects[-1].label
    values = {q.name: model.values[f'{label}.{q.name}'] for q in UNMODELLED[name].parameters}
    expected = added(lambda s: law(name, values, [s])[0], torque)
    # Rounding of torques of some 10 N m.
    np.testing.assert_allclose(force(model) - force(bare), expected, atol=1e-12)


@pytest.mark.parametrize(
    ('name', 'site', 'channel', 's'),
    [
        ('unmodelled_angle_error_of_angle', 'imu_angle', 0, lambda x: x[:, 0]),
        ('unmodelled_angle_error_of_angle', 'hip_angle:imu_angle', 2, lambda x: x[:, 0]),
        ('unmodelled_angle_error_of_rate', 'hip_angle', 2, lambda x: x[:, 2] - x[:, 3]),
        ('unmodelled_angle_error_of_torque', 'imu_angle:hip_torque', 0, lambda x: TORQUE),
        ('unmodelled_rate_error_of_rate', 'imu_rate', 1, lambda x: x[:, 2]),
        ('unmodelled_rate_error_of_angle', 'imu_rate:hip_angle', 1, lambda x: x[:, 0] - x[:, 1]),
        ('unmodelled_rate_error_of_time', 'imu_rate', 1, lambda x: TIME),
    ],
)
def test_sensor_term_changes_its_channel_alone(bare, name, site, channel, s):
    model = extended(bare, name, site)
    states, wrong = run(model)
    label = model.effects[-1].label
    values = {q.name: model.values[f'{label}.{q.name}'] for q in UNMODELLED[name].parameters}
    right = run(bare)[1]
    right[:, channel] += law(name, values, s(states))
    np.testing.assert_allclose(wrong, right, atol=1e-12)


# --- simulators and files ------------------------------------------------------------------------


@pytest.mark.parametrize('name', EXAMPLES)
@pytest.mark.parametrize('backend', ['compiled', 'interpreted'])
def test_sensitivities_are_derivatives(bare, name, backend):
    model = extended(bare, name)
    label = model.effects[-1].label
    own = [f'{label}.{q.name}' for q in UNMODELLED[name].parameters if q.free][-3:]
    compiled = compile_model(model, SETUP)
    if backend == 'interpreted':
        compiled = CompiledModel(compiled.equations, compiled.free, native=False)
    u, p = inputs(compiled), parameter_vector(model, SETUP)
    column = np.full(len(compiled.free), -1)
    places = [compiled.free.index(parameter) for parameter in own]
    column[places] = np.arange(len(own))
    J = compiled.normal(
        TIME, u, START, np.zeros((4, len(own))), p, column, np.zeros((len(TIME), 3)), np.ones(3),
        keep=True,
    )[2]  # fmt: skip
    for j, parameter in enumerate(own):
        h = 1e-5 * max(abs(model.values[parameter]), 0.1)
        ahead, behind = (
            run(model.with_values({parameter: model.values[parameter] + s * h}))[1]
            for s in (1, -1)
        )
        difference = (ahead - behind) / (2 * h)
        scale = np.abs(difference).max()
        assert scale > 1e-9
        np.testing.assert_allclose(J[:, :, j], difference, atol=2e-4 * scale)


@pytest.mark.parametrize('name', EXAMPLES)
def test_batch_rollouts_are_the_same(bare, name):
    model = extended(bare, name)
    compiled, p = compile_model(model, SETUP), parameter_vector(model, SETUP)
    starts = np.random.default_rng(4).uniform(-1, 1, (9, 4)) * [0.3, 0.3, 1.0, 1.0]
    u = inputs(compiled)
    found = simulate_batch(model, SETUP, TIME, u, starts, p, trajectories=True)
    one_by_one = [compiled.simulate(TIME, u, x0, p) for x0 in starts]
    np.testing.assert_allclose(found, one_by_one, rtol=0, atol=1e-10)


@pytest.mark.parametrize('file', ['sydney_pendulum', 'dfki_double_pendulum'])
def test_terms_of_other_mechanisms_are_finite(file):
    model = Model.load(model_path(file))
    for name, cls in UNMODELLED.items():
        for site in cls.sites(model.mechanism):
            made = extended(model, name, site)
            e = assemble(made, Setup())
            f = ca.Function('f', [e.x, e.u, e.p], [e.rates, e.outputs])
            at_rest = np.zeros(e.x.shape[0])
            results = f(at_rest, np.ones(e.u.shape[0]), parameter_vector(made, Setup()))
            assert all(np.isfinite(np.asarray(part)).all() for part in results), (name, site)


def test_model_file_brings_the_function_back(robot):
    model = extended(robot, 'unmodelled_joint_torque_of_body_angle', 'hip:q_outer')
    again = Model.from_text(model.text())
    assert again.text() == model.text()
    np.testing.assert_array_equal(run(again)[1], run(model)[1])
