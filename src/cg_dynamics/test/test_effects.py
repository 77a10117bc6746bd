"""Every effect of the library: it vanishes at its neutral value and does what it says."""

import casadi as ca
import numpy as np
import pytest

from cg_description.robot_description import parse
from cg_dynamics.assemble import assemble, parameter_vector
from cg_dynamics.effects import LIBRARY, UNMODELLED, make_effect
from cg_dynamics.effects.unmodelled import LearnedEffect
from cg_dynamics.mechanisms import MECHANISMS
from cg_dynamics.mechanisms.urdf import Urdf
from cg_dynamics.rig import Setup
from cg_dynamics.rollout.compiled import compile_model, simulate
from cg_dynamics.walking.contact import contact_law

COMPASS = MECHANISMS['compass_gait']
SLIDER = Urdf(
    parse(
        '<robot name="slider"><link name="base"/><link name="cart"><inertial><mass value="1"/>'
        '<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>'
        '<joint name="rail" type="prismatic"><parent link="base"/><child link="cart"/>'
        '<axis xyz="1 0 0"/></joint></robot>'
    )
)
EVERYWHERE = [(name, site) for name, effect in LIBRARY.items() for site in effect.sites(COMPASS)]
TIME = np.arange(0, 0.6, 0.002)
TORQUE = (6 * np.sin(2 * np.pi * 3 * TIME))[:, None]
START = np.array([0.05, 0.1, 0.2, -0.3])


def torque_of(model, torque=TORQUE):
    """Inputs of a model: torque, and its extra ones: the time, or a switch that is on."""
    extra = compile_model(model, Setup()).input_names[1:]
    columns = [TIME if name == 'time' else np.ones(len(TIME)) for name in extra]
    return np.column_stack([torque, *columns])


def right_side(model, setup=None):
    setup = setup or Setup()
    e = assemble(model, setup)
    f = ca.Function('f', [e.x, e.u, e.p], [e.rates, e.outputs])
    p = parameter_vector(model, setup)
    on = np.ones(e.u.shape[0] - 1)
    return lambda x, u: [np.asarray(result).ravel() for result in f(x, [u, *on], p)]


@pytest.mark.parametrize('name', LIBRARY)
def test_effect_is_declared_completely(name):
    effect = LIBRARY[name]
    assert effect.name == name
    assert effect.summary.endswith('.') or '(Eq.' in effect.summary
    assert effect.parameters[0].neutral is not None
    assert any(effect.sites(mechanism) for mechanism in (*MECHANISMS.values(), SLIDER))
    for p in effect.parameters:
        assert p.lower < p.upper
        assert all(p.lower <= start <= p.upper for start in p.starts), p.name
        p.default  # noqa: B018 - raises where there is none


@pytest.mark.parametrize(('name', 'site'), EVERYWHERE)
def test_effect_at_its_neutral_value_is_not_there(bare, name, site):
    first = LIBRARY[name].parameters[0]
    neutral = bare.with_effect(name, at=site, **{first.name: first.neutral})
    states, outputs = simulate(neutral, Setup(), TIME, torque_of(neutral), START)
    plain_states, plain_outputs = simulate(bare, Setup(), TIME, TORQUE, START)
    np.testing.assert_array_equal(states, plain_states)
    np.testing.assert_array_equal(outputs, plain_outputs)


@pytest.mark.parametrize(('name', 'site'), [
    (name, site) for name, site in EVERYWHERE
    # Extra states degenerate in the limit, and nothing is a limit where only ratios count.
    if not LIBRARY[name].states
    and not (LIBRARY[name].parameters[0].logarithmic and LIBRARY[name].parameters[0].neutral == 0)
])  # fmt: skip
def test_formula_of_the_effect_vanishes_at_the_neutral_value(bare, name, site, monkeypatch):
    """The same with the effect left in the equations, where its formula is finite there."""
    effect, first = LIBRARY[name], LIBRARY[name].parameters[0]
    monkeypatch.setattr(effect, 'acts', lambda self, values: True)
    neutral = bare.with_effect(name, at=site, **{first.name: first.neutral})
    for x in np.random.default_rng(1).uniform(-1, 1, size=(5, 4)):
        for found, expected in zip(
            right_side(neutral)(x, 3.0), right_side(bare)(x, 3.0), strict=True
        ):
            np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize(('name', 'site'), EVERYWHERE)
def test_effect_at_its_default_changes_something(bare, springs, name, site):
    model, setup = bare.with_effect(name, at=site), Setup(springs=springs)
    if LIBRARY[name].place == 'impact':
        assert contact_law(model) != contact_law(bare)  # what it does: test_contact.py
        return
    changed = simulate(model, setup, TIME, torque_of(model), START)[1]
    plain = simulate(bare, setup, TIME, TORQUE, START)[1]
    assert np.abs(changed - plain).max() > 1e-7


@pytest.mark.parametrize(
    ('name', 'values', 'expected'),
    [
        ('viscous_friction', {'coefficient': 0.4}, lambda w: -0.4 * w),
        ('coulomb_friction', {'torque': 1.5}, lambda w: -1.5 * np.tanh(w / 0.01)),
        (
            'coulomb_friction',
            {'torque': 1.5, 'transition_rate': 3e-3, 'slow_share': 0.3, 'slow_rate': 0.02},
            lambda w: -1.05 * np.tanh(w / 3e-3) - 0.45 * w / np.hypot(w, 0.02),
        ),
        (
            'coulomb_friction',
            {'torque': 1.5, 'slow_share': 1.0, 'slow_rate': 0.02, 'slow_tails': 1.0},
            lambda w: -3.0 / np.pi * np.arctan(np.pi * w / 0.04),
        ),
        (
            'coulomb_friction',
            {'torque': 1.5, 'slow_share': 0.8, 'slow_rate': 0.02, 'slow_tails': 0.25},
            lambda w: (
                -0.3 * np.tanh(w / 0.01)
                - 0.9 * w / np.hypot(w, 0.02)
                - 0.6 / np.pi * np.arctan(np.pi * w / 0.04)
            ),
        ),
        ('quadratic_friction', {'coefficient': 0.3}, lambda w: -0.3 * w * abs(w)),
        (
            'quadratic_friction',
            {'coefficient': 0.3, 'cubic_share': 0.4},
            lambda w: -0.18 * w * abs(w) - 0.12 * w**3,
        ),
        (
            'stribeck_friction',
            {'torque': 1.2, 'stribeck_rate': 0.8},
            lambda w: -1.2 * np.exp(-((w / 0.8) ** 2)) * np.tanh(w / 0.01),
        ),
        (
            'stribeck_friction',
            {'torque': 1.2, 'stribeck_rate': 0.8, 'exponent': 1.0},
            lambda w: -1.2 * np.exp(-abs(w) / 0.8) * np.tanh(w / 0.01),
        ),
    ],
)
@pytest.mark.parametrize('rate', [-2.0, -0.004, 0.004, 0.5])
def test_friction_equals_that_much_hip_torque(bare, name, values, expected, rate):
    x = np.array([0.1, -0.2, 0.3, 0.3 - rate])
    rubbed = right_side(bare.with_effect(name, **values))(x, 2.0)[0]
    pushed = right_side(bare)(x, 2.0 + expected(rate))[0]
    np.testing.assert_allclose(rubbed, pushed, rtol=1e-12)


@pytest.mark.parametrize('torque', [-9.0, -2.1, -0.5, 0.3, 1.9, 2.0, 40.0])
@pytest.mark.parametrize(
    ('roundness', 'expected', 'within'),
    [
        (0.0, lambda x: np.clip(x, -1, 1), 1e-7),
        (1.5, np.tanh, 0.02),  # the nearest of these curves to it, limits left alone
        (10.0, lambda x: x / np.sqrt(1 + x**2), 0.02),
    ],
)
def test_saturated_torque_clips_or_bends(bare, torque, roundness, expected, within):
    x = np.array([0.1, -0.2, 0.3, 0.4])
    limited = bare.with_effect('torque_saturation', limit=2.0, roundness=roundness)
    found, other = right_side(limited)(x, torque)[0], right_side(bare)(x, 0.0)[0]
    per_torque = right_side(bare)(x, 1.0)[0][3] - other[3]
    delivered = (found[3] - other[3]) / per_torque
    assert delivered == pytest.approx(2 * expected(torque / 2), abs=2 * within)


def test_coulomb_friction_is_the_sigmoid_of_eq_4_12(bare):
    """2/(1 + exp(-200 w)) - 1 = tanh(100 w), so the transition rate is 0.01 rad/s."""
    w = 0.0037
    sigmoid = 2 / (1 + np.exp(-200 * w)) - 1
    x = np.array([0.1, -0.2, w, 0.0])
    rubbed = right_side(bare.with_effect('coulomb_friction', torque=1.84))(x, 0.0)[0]
    np.testing.assert_allclose(rubbed, right_side(bare)(x, -1.84 * sigmoid)[0], rtol=1e-12)


def test_torque_constant_and_bias_compose_in_the_order_of_the_model(bare):
    x = np.array([0.1, -0.2, 0.3, 0.4])
    scaled = bare.with_effect('torque_constant', error=0.1)
    both = scaled.with_effect('torque_bias', bias=0.5)
    np.testing.assert_allclose(
        right_side(both)(x, 4.0)[0], right_side(bare)(x, 1.1 * 4 + 0.5)[0], rtol=1e-13
    )


def test_payload_at_the_hip_adds_mass_and_dilutes_all_lumps(bare):
    """A point mass at the hip leaves the legs as they were: c mt l^2 stays, mt grows."""
    v, m = bare.values, 2.3
    ratio = v['total_mass'] / (v['total_mass'] + m)
    lumped = bare.with_values(
        {'total_mass': v['total_mass'] + m} | {f'c{i}': ratio * v[f'c{i}'] for i in range(1, 7)}
    )
    for leg in ('inner', 'outer'):
        loaded = bare.with_effect('payload', at=leg, mass=m, distance=v['leg_length'])
        for stance in ('inner', 'outer'):
            x, setup = np.array([0.1, -0.2, 0.3, 0.4]), Setup(stance=stance)
            np.testing.assert_allclose(
                right_side(loaded, setup)(x, 2.0)[0], right_side(lumped, setup)(x, 2.0)[0],
                rtol=1e-11,
            )  # fmt: skip


@pytest.mark.parametrize(('leg', 'inertia', 'moment'), [('inner', 1, 4), ('outer', 2, 5)])
@pytest.mark.parametrize('stance', ['inner', 'outer'])
def test_payload_on_a_leg_equals_a_change_of_that_legs_lumps(bare, leg, inertia, moment, stance):
    v, m, distance = bare.values, 1.4, 0.35
    l, mt = v['leg_length'], v['total_mass']
    total = mt + m
    below = l - distance
    lumps = {f'c{i}': v[f'c{i}'] * mt / total for i in range(1, 7)}
    lumps[f'c{inertia}'] += m * below**2 / (total * l**2)
    lumps[f'c{moment}'] += m * below / (total * l)
    lumped = bare.with_values({'total_mass': total, **lumps})
    loaded = bare.with_effect('payload', at=leg, mass=m, distance=distance)
    x, setup = np.array([0.1, -0.2, 0.3, 0.4]), Setup(stance=stance)
    np.testing.assert_allclose(
        right_side(loaded, setup)(x, 2.0)[0], right_side(lumped, setup)(x, 2.0)[0], rtol=1e-11
    )


def test_slope_turns_gravity_as_if_all_angles_were_turned(bare):
    """On ground that falls ahead by a, a robot at angle q to the ground leans by q + a."""
    a, x = 0.08, np.array([0.1, -0.2, 0.3, 0.4])
    tilted = right_side(bare.with_effect('ground_slope', angle=a))(x, 2.0)[0]
    level = right_side(bare)(x + np.array([a, a, 0, 0]), 2.0)[0]
    np.testing.assert_allclose(tilted, level, rtol=1e-12)


@pytest.mark.parametrize('delay', [0.002, 0.004, 0.01])
def test_actuator_delay_of_whole_samples_equals_shifted_inputs(bare, delay):
    rows = round(delay / 0.002)
    shifted = np.vstack([np.repeat(TORQUE[:1], rows, axis=0), TORQUE[:-rows]])
    late = simulate(bare.with_effect('actuator_delay', delay=delay), Setup(), TIME, TORQUE, START)
    plain = simulate(bare, Setup(), TIME, shifted, START)
    np.testing.assert_allclose(late[0], plain[0], atol=1e-12)


@pytest.mark.parametrize('site', [None, 'imu', 'encoder'])
def test_sensor_delay_of_whole_samples_equals_shifted_outputs(bare, site):
    late = simulate(
        bare.with_effect('sensor_delay', at=site, delay=0.006), Setup(), TIME, TORQUE, START
    )[1]
    plain = simulate(bare, Setup(), TIME, TORQUE, START)[1]
    delayed = {None: (0, 1, 2), 'imu': (0, 1), 'encoder': (2,)}[site]
    for channel in range(3):
        expected = plain[:-3, channel] if channel in delayed else plain[3:, channel]
        np.testing.assert_allclose(late[3:, channel], expected, atol=1e-12)


def test_lag_settles_exponentially(bare):
    model = bare.with_effect('actuator_lag', time_constant=0.02)
    torque = np.full((len(TIME), 1), 4.0)
    compiled, p = compile_model(model, Setup()), parameter_vector(model, Setup())
    x0 = compiled.initial_state(START, np.zeros(1), p)
    states = compiled.simulate(TIME, torque, x0, p)
    # Runge-Kutta on a step of 2 ms against a time constant of 20 ms: (h/T)^5/120 of 4 N m a step,
    # over some T/h steps.
    np.testing.assert_allclose(states[:, 4], 4 * (1 - np.exp(-TIME / 0.02)), atol=4e-6)


def test_stiff_joint_moves_like_a_rotor_bolted_on(bare):
    """With k -> large, the rotor's inertia adds to the hip coordinate alone."""
    J = 0.1
    stiff = bare.with_effect('joint_flexibility', stiffness=1e5, rotor_inertia=J, damping=20.0)
    flexible = simulate(stiff, Setup(), TIME, TORQUE, START)[0][:, :4]
    e = assemble(bare, Setup())
    row = ca.DM([1, -1])
    M = e.mass_matrix + J * ca.mtimes(row, row.T)
    force = ca.mtimes(e.mass_matrix, e.rates[2:])
    f = ca.Function('f', [e.x, e.u, e.p], [ca.vertcat(e.x[2:], ca.solve(M, force))])
    p, x = parameter_vector(bare, Setup()), START.copy()
    rigid = [x]
    for u in TORQUE[:-1]:
        h = 0.002
        k1 = np.asarray(f(x, u, p)).ravel()
        k2 = np.asarray(f(x + h / 2 * k1, u, p)).ravel()
        k3 = np.asarray(f(x + h / 2 * k2, u, p)).ravel()
        k4 = np.asarray(f(x + h * k3, u, p)).ravel()
        x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        rigid.append(x)
    # The wind-up is torque / k, some 1e-4 rad.
    np.testing.assert_allclose(flexible[:, :2], np.array(rigid)[:, :2], atol=2e-4)


@pytest.mark.parametrize('rounding', [0.005, 2.5e-4])
def test_teeth_that_begin_sharply_touch_where_the_gap_ends(rounding):
    # Between teeth without any rounding, torque is k times what is beyond the gap, and d times the
    # relative rate only there. A ramp rounded over r is off by r/2 at its corner. At a distance x
    # from it, it is off by r^2/4x, and its slope by r^2/4x^2, to first order.
    effect = make_effect('backlash', COMPASS)
    half, k, d = 0.009, 7300.0, 18.0
    beyond, r = 4e-4, rounding * half
    p = {'gap': 2 * half, 'rotor_inertia': 0.12, 'stiffness': k, 'damping': d}
    wind_up = np.array([-half - beyond, -half, -0.4 * half, 0.7 * half, half + beyond])
    told = [
        float(effect.transmit(0.0, 0.1, 0.3, [0.1 + e, 0.5], p | {'rounding': rounding})[0])
        for e in wind_up
    ]
    inside = np.clip(wind_up, -half, half)
    sharp = k * (wind_up - inside) + d * (0.5 - 0.3) * (np.abs(wind_up) > half)
    away = [0, 2, 3, 4]
    off = 1.1 * (k * r**2 / (4 * beyond) + d * 0.2 * r**2 / (4 * beyond**2))
    assert told[1] == pytest.approx(d * 0.2 / 2 - k * r / 2, rel=1e-3)
    assert np.array(told)[away] == pytest.approx(sharp[away], abs=off)


def test_backlash_lets_the_joint_go_inside_the_gap(bare):
    """In the middle of the gap no torque passes; at its edge the tooth presses."""
    model = bare.with_effect('backlash', gap=0.02, rotor_inertia=0.1)
    x = np.array([0.1, -0.2, 0.3, 0.3])
    free = right_side(model)(np.array([*x, 0.3, 0.0]), 5.0)[0]
    # 1 % of the width of the smoothed corner leaks through: stiffness * width^2 / (2 gap).
    np.testing.assert_allclose(free[:4], right_side(bare)(x, 0.0)[0], atol=0.1)
    np.testing.assert_allclose(free[5], 5.0 / 0.1, rtol=0.02)
    pressed = right_side(model)(np.array([*x, 0.3 + 0.01 + 0.001, 0.0]), 0.0)[0]
    assert pressed[2] > free[2]
    assert pressed[5] < 0


@pytest.mark.parametrize(
    ('name', 'value', 'channel'),
    [('imu_offset', 'offset', 0), ('gyro_bias', 'bias', 1), ('encoder_offset', 'offset', 2)],
)
def test_sensor_errors_shift_their_channel_alone(bare, name, value, channel):
    shifted = simulate(bare.with_effect(name, **{value: 0.03}), Setup(), TIME, TORQUE, START)[1]
    plain = simulate(bare, Setup(), TIME, TORQUE, START)[1]
    expected = np.zeros(3)
    expected[channel] = 0.03
    np.testing.assert_allclose(shifted - plain, np.tile(expected, (len(TIME), 1)), atol=1e-15)


@pytest.mark.parametrize(
    'name', [n for n, e in (LIBRARY | UNMODELLED).items() if 'hip' in e.sites(COMPASS)]
)
def test_what_always_opposes_the_rate_is_declared_as_friction(name):
    """Controllers ask the class: dry if it is as strong when slow, viscous if it fades."""
    effect = make_effect(name, COMPASS)
    p = {q.name: ca.SX(q.default) for q in effect.parameters}
    p |= dict.fromkeys(effect.extra_inputs, ca.SX(1.0))
    if isinstance(effect, LearnedEffect):
        p |= {c: ca.SX(0.0) for c in effect.coefficients}
        p[effect.coefficients[0]] = ca.SX(1.0)  # a constant, where there is one
    x = ca.SX.sym('x', 3)
    z = [ca.tanh(x[1] / 0.01)] * len(effect.states)  # bristles bent by a motion that lasts
    torque, _ = effect.joint_torque(x[0], x[1], x[2], z, p)
    law = ca.Function('law', [x], [torque])
    rates = np.array([-2.0, -0.2, 0.2, 2.0])
    power = np.array([
        [float(law([angle, rate, load])) * rate for rate in rates]
        for angle in (-0.7, 0.1, 0.4) for load in (-3.0, 3.0)
    ])  # fmt: skip
    opposes = (power <= 1e-12).all() and (power < -1e-12).any()
    assert bool(effect.friction) == opposes
    if opposes:
        level = np.abs(power / rates).max(axis=0)
        fast, slow = max(level[0], level[3]), max(level[1], level[2])
        assert effect.friction == ('viscous' if slow < 0.5 * fast else 'dry')
