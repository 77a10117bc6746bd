"""The effect library as a whole, and each of its laws: energy, rolling, impulse, sensors."""

import itertools
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

from cg_description.paths import model_path
from cg_dynamics.assemble import assemble, parameter_vector
from cg_dynamics.effects import LIBRARY
from cg_dynamics.errors import ModelError
from cg_dynamics.mechanisms import MECHANISMS
from cg_dynamics.model import Model
from cg_dynamics.plant import Plant
from cg_dynamics.rig import Setup, Spring
from cg_dynamics.rollout.compiled import CompiledModel, compile_model
from cg_dynamics.walking.impact import impact

COMPASS = MECHANISMS['compass_gait']
EVERYWHERE = [(name, site) for name, effect in LIBRARY.items() for site in effect.sites(COMPASS)]
TIME = np.arange(0, 0.4, 0.002)
HALF = 0.5 * (TIME[1] - TIME[0])  # a clock is held from row to row
TORQUE = 6 * np.sin(2 * np.pi * 3 * TIME)
START = np.array([0.05, 0.12, 0.2, -0.3])
SPRING = Spring('inner', point=0.9, anchor=(-0.6, 1.0), stiffness=400.0, free_length=0.3)
SETUPS = [
    Setup(),
    Setup(springs=(SPRING,)),
    Setup(fixture='inner_fixed'),
    Setup(stance='outer', fixture='outer_fixed'),
    Setup(fixture='legs_tied'),
]
STATES = np.random.default_rng(3).uniform(-1, 1, size=(20, 4))

# What each may do to mechanical energy E, in every state and under every torque: nothing beyond
# the work of the hip torque, or only take from it.
CONSERVATIVE = (
    'boom_mass', 'cogging_torque', 'foot_compliance', 'foot_radius', 'ground_slope', 'payload',
    'rotor_inertia', 'spring_nonlinearity',
)  # fmt: skip
DISSIPATIVE = (
    'aerodynamic_drag', 'ankle_friction', 'asymmetric_friction', 'back_emf', 'coulomb_friction',
    'foot_creep', 'friction_drift', 'joint_creep', 'load_dependent_friction',
    'position_dependent_friction',
    'presliding_friction', 'quadratic_friction', 'spring_damping', 'stribeck_friction',
    'viscous_friction',
)  # fmt: skip


@pytest.fixture
def pendulums():
    """Models of other mechanisms, rigid bodies only."""
    found = {}
    for name in ('sydney_pendulum', 'dfki_double_pendulum'):
        model = Model.load(model_path(name))
        for effect in model.effects:
            model = model.without_effect(effect.label)
        found[model.mechanism.name] = model
    return found


def motion_of(setup):
    return START if setup.fixture == 'none' else START[[0, 2]]


def inputs_of(model, setup, torque=TORQUE, time=TIME):
    extra = compile_model(model, setup).input_names[1:]
    columns = [time + HALF if name == 'time' else np.ones(len(time)) for name in extra]
    return np.column_stack([torque, *columns])


def run(model, setup=None, torque=TORQUE, motion=None, time=TIME):
    """States and outputs."""
    setup = setup or Setup()
    compiled, p = compile_model(model, setup), parameter_vector(model, setup)
    u = inputs_of(model, setup, torque, time)
    x0 = compiled.initial_state(motion_of(setup) if motion is None else motion, u[0], p)
    states = compiled.simulate(time, u, x0, p)
    return states, compiled.outputs(time, u, states, p)


def accelerations(model, x, torque, time=0.0, setup=None):
    e = assemble(model, setup or Setup())
    values = {'hip_torque': torque, 'time': time}
    u = [values.get(name, 1.0) for name in e.input_names]
    f = ca.Function('f', [e.x, e.u, e.p], [e.rates])
    return np.asarray(f(x, u, parameter_vector(model, setup or Setup()))).ravel()[2:4]


def power(model, setup, extra_energy=0.0):
    """(x, u) -> dE/dt less the work of the hip torque in W."""
    e = assemble(model, setup)
    energy = e.energy
    if extra_energy:
        energy += extra_energy(e)
    work = e.u[0] * (e.x[2] - e.x[3])
    f = ca.Function('power', [e.x, e.u, e.p], [ca.jtimes(energy, e.x, e.rates) - work])
    p, on = parameter_vector(model, setup), np.ones(e.u.shape[0] - 1)
    return lambda x, u: float(f(x, [u, *on], p))


# --- the whole library ------------------------------------------------------------------------


@pytest.mark.parametrize(('name', 'site'), EVERYWHERE)
def test_every_start_and_both_ends_of_the_first_range_can_be_simulated(bare, name, site):
    first, *others = LIBRARY[name].parameters
    grids = [[(p.name, s) for s in (p.starts if p.free else p.starts[:1])] for p in others]
    values = (*first.starts, first.lower, first.upper)
    points = [{first.name: v} for v in values]
    points += [{first.name: first.starts[0], **dict(point)} for point in itertools.product(*grids)]
    for point in points:
        model = bare.with_effect(name, at=site, **point)
        states, outputs = run(model, Setup(springs=(SPRING,)))
        assert np.isfinite(states).all(), point
        assert np.isfinite(outputs).all(), point


@pytest.mark.parametrize('mechanism', ['pendulum', 'double_pendulum'])
@pytest.mark.parametrize('name', LIBRARY)
def test_equations_are_finite_on_other_mechanisms(name, mechanism, pendulums):
    model = pendulums[mechanism]
    for site in LIBRARY[name].sites(model.mechanism):
        e = assemble(model.with_effect(name, at=site), Setup())
        results = [e.rates, e.outputs, e.initial, ca.jacobian(e.rates, ca.vertcat(e.x, e.p))]
        f = ca.Function('f', [e.x, e.u, e.p], results)
        at_rest = np.zeros(e.x.shape[0])
        p = parameter_vector(model.with_effect(name, at=site), Setup())
        for x in (at_rest, at_rest + 0.3):
            assert all(
                np.isfinite(np.asarray(part)).all() for part in f(x, np.ones(e.u.shape[0]), p)
            )


@pytest.mark.parametrize('name', [n for n, e in LIBRARY.items() if e.sites(COMPASS)])
def test_effect_that_does_not_apply_to_a_setup_changes_nothing_there(bare, name):
    model = bare.with_effect(name)
    assert LIBRARY[name].applies(SETUPS)
    for setup in SETUPS:
        if not LIBRARY[name].applies([setup]):
            np.testing.assert_array_equal(run(model, setup)[1], run(bare, setup)[1])


@pytest.mark.parametrize(
    ('name', 'values'),
    [
        ('cogging_torque', {'amplitude': 0.8, 'cycles': 23.0, 'phase': 0.7}),
        ('external_push', {'impulse': 1.5, 'instant': 0.2, 'duration': 0.05}),
        ('friction_drift', {'excess': 1.0, 'time_constant': 0.3, 'transition_rate': 0.2}),
        ('imu_drift', {'rate': 0.02}),
        ('imu_mount_flexibility', {'compliance': 1e-3, 'frequency': 60.0, 'damping_ratio': 0.1}),
        ('position_dependent_friction', {'torque': 1.0, 'tightest': 1.0, 'transition_rate': 0.2}),
        ('presliding_friction', {'torque': 1.0, 'deflection': 0.03, 'damping': 2.0}),
        ('torque_saturation', {'limit': 4.0}),
    ],
)
@pytest.mark.parametrize('backend', ['compiled', 'interpreted'])
def test_sensitivities_as_time_goes_on(bare, name, values, backend):
    model = bare.with_effect(name, **values)
    own = [f'{name}.{key}' for key in values if key != 'transition_rate']
    compiled = compile_model(model, Setup())
    if backend == 'interpreted':
        compiled = CompiledModel(compiled.equations, compiled.free, native=False)
    u, p = inputs_of(model, Setup()), parameter_vector(model, Setup())
    # Nearly at rest, so that the joint turns back and bristles bend the other way.
    motion = np.array([0.05, 0.12, 0.02, 0.0])
    x0, _, by_free = compiled.initial_sensitivity(motion, u[0], p)
    places = [compiled.free.index(parameter) for parameter in own]
    column = np.full(len(compiled.free), -1)
    column[places] = np.arange(len(own))
    J = compiled.normal(
        TIME, u, x0, by_free[:, places], p, column, np.zeros((len(TIME), 3)), np.ones(3), keep=True
    )[2]
    for j, parameter in enumerate(own):
        h = 1e-5 * model.values[parameter]
        ahead, behind = (
            run(model.with_values({parameter: model.values[parameter] + s * h}), motion=motion)[1]
            for s in (1, -1)
        )
        difference = (ahead - behind) / (2 * h)
        scale = np.abs(difference).max()
        assert scale > 1e-6
        np.testing.assert_allclose(J[:, :, j], difference, atol=2e-4 * scale)


# --- energy -----------------------------------------------------------------------------------


@pytest.mark.parametrize('name', CONSERVATIVE)
def test_conservative_effect_leaves_energy_alone(bare, name):
    setup = Setup(springs=(SPRING,))

    def stored(e):
        if name != 'cogging_torque':
            return 0.0
        p = dict(zip(e.parameter_names, ca.vertsplit(e.p), strict=True))
        cycles, phase = p['cogging_torque.cycles'], p['cogging_torque.phase']
        ripple = ca.cos(cycles * (e.x[0] - e.x[1]) + phase)
        return p['cogging_torque.amplitude'] / cycles * ripple

    gained = power(bare.with_effect(name), setup, stored)
    for x in STATES:
        # Rounding of powers of some 100 W.
        assert abs(gained(x, 4.0)) < 1e-10


@pytest.mark.parametrize('name', DISSIPATIVE)
def test_friction_never_adds_energy(bare, name):
    setup = Setup(springs=(SPRING,))
    model = bare.with_effect(name)

    def stored(e):
        p = dict(zip(e.parameter_names, ca.vertsplit(e.p), strict=True))
        wound = {'foot_creep': e.x[0], 'joint_creep': e.x[0] - e.x[1]}
        if name in wound:
            return p[f'{name}.stiffness'] * (wound[name] - e.x[4]) ** 2 / 2
        if name != 'presliding_friction':
            return 0.0
        level, deflection = p[f'{name}.torque'], p[f'{name}.deflection']
        return level * deflection * e.x[4] ** 2 / 2

    gained = power(model, setup, stored)
    extra = 1 if LIBRARY[name].states else 0
    values = [gained([*x, *[0.4] * extra], torque) for x in STATES for torque in (0.0, -5.0, 5.0)]
    assert max(values) < 1e-10
    assert min(values) < -1e-6


@pytest.mark.parametrize('fixture', ['none', 'legs_tied'])
def test_rolling_robot_keeps_its_energy_over_time(bare, fixture):
    setup = Setup(fixture=fixture)
    model = bare.with_effect('foot_radius', radius=0.15)
    states, _ = run(model, setup, torque=np.zeros(len(TIME)))
    e = assemble(model, setup)
    energy = ca.Function('E', [e.x, e.p], [e.energy])
    values = np.asarray(energy(states.T, parameter_vector(model, setup))).ravel()
    # Runge-Kutta over 0.4 s, of some 150 J.
    np.testing.assert_allclose(values, values[0], rtol=1e-9)


# --- the foot -------------------------------------------------------------------------------


@pytest.mark.parametrize('stance', ['inner', 'outer'])
def test_sole_touches_the_ground_below_its_centre_and_does_not_slip(bare, stance):
    """Facts of a wheel: its centre is at radius q, and its lowest material point is at rest."""
    radius, x = 0.13, np.array([0.31, -0.22, 0.7, 0.4])
    lean, rate = (x[0], x[2]) if stance == 'inner' else (x[1], x[3])
    effect = LIBRARY['foot_radius'](COMPASS)
    q = ca.SX.sym('q', 2)

    class Legs:
        stance = 0

    Legs.q, Legs.stance = q, 0 if stance == 'inner' else 1
    foot = effect.foot(Legs, {'radius': ca.SX(radius)})
    end, slope = (
        np.asarray(part).ravel()
        for part in ca.Function('f', [q], [foot, ca.jtimes(foot, q, ca.DM([1, 1]))])(x[:2])
    )
    centre = end + radius * np.array([np.sin(lean), np.cos(lean)])
    np.testing.assert_allclose(centre, [radius * lean, radius], atol=1e-14)
    # Velocity of the lowest point: that of the leg's end, and the turning about it. A positive
    # rate leans forward, so a point (dx, dz) away moves by rate (dz, -dx).
    dx, dz = np.array([radius * lean, 0.0]) - end
    np.testing.assert_allclose(slope * rate + rate * np.array([dz, -dx]), 0, atol=1e-14)


def test_rolling_foot_lifts_all_weight(bare):
    """All masses ride on the leg's end, which rises by radius (1 - cos q)."""
    radius, x = 0.1, np.array([0.3, -0.2, 0.0, 0.0])
    v = bare.values

    def energy(model):
        e = assemble(model, Setup())
        return float(ca.Function('E', [e.x, e.p], [e.energy])(x, parameter_vector(model, Setup())))

    risen = energy(bare.with_effect('foot_radius', radius=radius)) - energy(bare)
    expected = v['total_mass'] * v['gravity'] * radius * (1 - np.cos(0.3))
    np.testing.assert_allclose(risen, expected, rtol=1e-12)


def test_impacts_of_rolling_feet_are_refused(bare):
    with pytest.raises(ModelError, match='point feet only, not foot_radius'):
        impact(bare.with_effect('foot_radius', radius=0.1), 'inner', np.array([0.2, -0.2, 1.0, 1]))


def test_tether_works_by_force_times_speed_of_the_hip(bare):
    gained = power(bare.with_effect('tether_force', force=3.0), Setup())
    for x in STATES:
        hip_speed = bare.values['leg_length'] * np.cos(x[0]) * x[2]
        np.testing.assert_allclose(gained(x, 2.0), 3.0 * hip_speed, atol=1e-10)


def test_push_gives_its_impulse_to_the_robot(bare):
    """Without gravity, a short push at the upright robot turns it about the foot."""
    impulse = 0.5
    push = {'impulse': impulse, 'instant': 0.2, 'duration': 0.012}
    model = bare.with_values({'gravity': 0.0}).with_effect('external_push', **push)
    states, _ = run(model, torque=np.zeros(len(TIME)), motion=np.zeros(4))
    e = assemble(model, Setup())
    momentum = ca.Function('L', [e.x, e.p], [ca.sum1(ca.mtimes(e.mass_matrix, e.x[2:]))])
    before, after = (
        float(momentum(states[row], parameter_vector(model, Setup()))) for row in (0, -1)
    )
    # The hip moves on by some mm during the push.
    np.testing.assert_allclose(after - before, impulse * bare.values['leg_length'], rtol=1e-4)


# --- the torque path ----------------------------------------------------------------------


@pytest.mark.parametrize(
    ('name', 'values', 'added'),
    [
        ('asymmetric_friction', {'excess': 0.8}, lambda a, w, u, t: -0.8 if w > 0 else 0.0),
        ('load_dependent_friction', {'coefficient': 0.1},
         lambda a, w, u, t: -0.1 * abs(u) * np.sign(w)),
        ('position_dependent_friction', {'torque': 1.4, 'tightest': 0.5},
         lambda a, w, u, t: -0.7 * (1 + np.cos(a - 0.5)) * np.sign(w)),
        ('friction_drift', {'excess': 0.9, 'time_constant': 4.0},
         lambda a, w, u, t: -0.9 * np.exp(-t / 4) * np.sign(w)),
        ('cogging_torque', {'amplitude': 0.3, 'cycles': 20.0, 'phase': 0.4},
         lambda a, w, u, t: 0.3 * np.sin(20 * a + 0.4)),
    ],
)  # fmt: skip
@pytest.mark.parametrize('rate', [-2.0, 0.5])
def test_effect_equals_that_much_hip_torque(bare, name, values, added, rate):
    x, torque, time = np.array([0.1, -0.2, 0.3, 0.3 - rate]), -3.0, 2.5
    found = accelerations(bare.with_effect(name, **values), x, torque, time)
    expected = accelerations(bare, x, torque + added(0.3, rate, torque, time))
    np.testing.assert_allclose(found, expected, rtol=1e-12)


def test_saturated_torque(bare):
    model, x = bare.with_effect('torque_saturation', limit=5.0), STATES[0]
    for torque, delivered in ((1.0, 1.0), (5.1, 5.0), (50.0, 5.0), (-50.0, -5.0)):
        np.testing.assert_allclose(
            accelerations(model, x, torque), accelerations(bare, x, delivered), rtol=1e-5
        )


def test_bristles_that_bend_are_damped(bare):
    """LuGre's friction against its textbook form, sigma_0 z + sigma_1 dz/dt."""
    level, stiffness, damping = 1.2, 60.0, 3.0  # N m, N m/rad, N m s/rad
    deflection = level / stiffness
    model = bare.with_effect('presliding_friction', torque=level, deflection=deflection,
                             damping=damping)  # fmt: skip
    for rate, z in ((0.5, 0.01), (-0.2, 0.015), (0.05, -0.02)):
        bending = rate - stiffness * abs(rate) / level * z
        torque = -stiffness * z - damping * bending
        x = np.array([0.1, -0.2, 0.3, 0.3 - rate])
        np.testing.assert_allclose(
            accelerations(model, [*x, z / deflection], 0.0), accelerations(bare, x, torque),
            rtol=1e-10,
        )  # fmt: skip


def test_presliding_joint_yields_like_a_spring_and_then_slides(bare):
    """At constant speed the bristles bend to 1 - exp(-angle / deflection) of the full level."""
    model = bare.with_effect('presliding_friction', torque=1.0, deflection=0.02)
    e = assemble(model, Setup())
    bend = ca.Function('b', [e.x, e.u, e.p], [e.rates[4]])
    p, rate, b, h = parameter_vector(model, Setup()), 0.5, 0.0, 1e-5
    for _ in range(4000):
        b += h * float(bend([0, 0, rate, 0, b], 0.0, p))
    # Euler's rule, 1 % of the deflection a step of 40.
    np.testing.assert_allclose(b, 1 - np.exp(-rate * 4000 * h / 0.02), rtol=1e-3)


# --- sensors ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ('name', 'values', 'channel', 'expected'),
    [
        ('encoder_scale', {'error': 0.03}, 2, lambda y: 1.03 * y),
        ('imu_scale', {'error': -0.04}, 0, lambda y: 0.96 * y),
        ('gyro_scale', {'error': 0.05}, 1, lambda y: 1.05 * y),
        ('imu_drift', {'rate': 0.01}, 0, lambda y: y + 0.01 * (TIME + HALF)),
        ('encoder_eccentricity', {'amplitude': 0.02, 'phase': 0.3}, 2,
         lambda y: y + 0.02 * np.sin(y + 0.3)),
    ],
)  # fmt: skip
def test_sensor_error_changes_its_channel_alone(bare, name, values, channel, expected):
    wrong, plain = run(bare.with_effect(name, **values))[1], run(bare)[1]
    right = plain.copy()
    right[:, channel] = expected(plain[:, channel])
    np.testing.assert_allclose(wrong, right, atol=1e-14)


def test_lagging_imu_settles_behind_by_its_time_constant(bare):
    T = 0.01
    slow, plain = run(bare.with_effect('imu_lag', time_constant=T))[1], run(bare)[1]
    # The same motion, but for half the step of integration.
    np.testing.assert_allclose(slow[:, 2], plain[:, 2], atol=1e-10)
    for channel in (0, 1):
        # T dy/dt + y = value by central differences.
        y = slow[:, channel]
        back = y[1:-1] + T * (y[2:] - y[:-2]) / 0.004
        scale = np.abs(y).max()
        np.testing.assert_allclose(back, plain[1:-1, channel], atol=2e-3 * scale)
    assert abs(slow[0, 0] - (plain[0, 0] - T * plain[0, 1])) < 1e-12


def test_mount_bends_with_a_steady_torque(bare):
    values = {'compliance': 1e-3, 'frequency': 100.0, 'damping_ratio': 1.0}
    model = bare.with_effect('imu_mount_flexibility', **values)
    steps = np.where(TIME < 0.1, 0.0, 5.0)
    bent, plain = run(model, torque=steps)[1], run(bare, torque=steps)[1]
    # The step of integration is half as long; after 0.3 s the mount has settled for 30 periods
    # of its decay.
    np.testing.assert_allclose(bent[:40] - plain[:40], 0, atol=1e-10)
    np.testing.assert_allclose(bent[-1] - plain[-1], [5e-3, 0, 0], atol=1e-9)


# --- the time of the record -----------------------------------------------------------------


@pytest.mark.parametrize('late', [False, True])
def test_plant_and_rollout_agree_on_the_time(bare, late):
    """A delay of the torque delays the torque, not the clock."""
    model = bare.with_effect('external_push', impulse=2.0, instant=0.15, duration=0.03)
    model = model.with_effect('imu_drift', rate=0.05)
    if late:
        model = model.with_effect('actuator_delay', delay=0.1)
    plant, outputs = Plant(replace(model, sensors={}), Setup(), START), []
    for torque in TORQUE:
        plant.latch(np.array([torque]))
        outputs.append(list(plant.measure().outputs.values()))
        plant.advance()
    # Before the first row the rollout holds its torque, the machine none; it is 0 in both.
    np.testing.assert_allclose(outputs, run(model)[1], atol=1e-7)
