"""The compass gait against the thesis, term by term, and against laws of mechanics."""

import casadi as ca
import numpy as np
import pytest

from cg_dynamics.assemble import assemble, parameter_vector
from cg_dynamics.mechanisms.compass_gait import CompassGait
from cg_dynamics.rig import Setup
from cg_dynamics.rollout.compiled import compile_model

STATES = np.random.default_rng(seed=0).uniform(-1, 1, size=(20, 4)) * [0.8, 0.8, 3.0, 3.0]

# Physical parameters of Appendix A: 1 stance leg, 2 swing leg, 3 the body that bisects them.
l, g = 1.13, 9.7
m1, m2, m3 = 3.1, 5.3, 1.7
I1, I2, I3 = 0.11, 0.23, 0.05
lc1, lc2, lc3 = 0.41, 0.29, 0.17  # from the hip; legs below it, body 3 above


def lumps(stance: str) -> dict[str, float]:
    """Lumps of conventions.md; leg 1 there is the inner pair."""
    mt = m1 + m2 + m3
    c3 = (I3 + m3 * lc3**2) / (4 * mt * l**2)
    standing = (c3 + (I1 + m1 * lc1**2) / (mt * l**2), m1 * lc1 / (mt * l))
    swinging = (c3 + (I2 + m2 * lc2**2) / (mt * l**2), m2 * lc2 / (mt * l))
    inner, outer = (standing, swinging) if stance == 'inner' else (swinging, standing)
    return {
        'leg_length': l, 'total_mass': mt, 'gravity': g, 'c1': inner[0], 'c2': outer[0],
        'c3': c3, 'c4': inner[1], 'c5': outer[1], 'c6': m3 * lc3 / (4 * mt * l),
    }  # fmt: skip


def stance_first(x, stance):
    """Angles and rates in the order of Appendix A, (stance, swing)."""
    order = [0, 1] if stance == 'inner' else [1, 0]
    return x[order], x[[2 + i for i in order]]


@pytest.mark.parametrize('stance', ['inner', 'outer'])
@pytest.mark.parametrize('x', STATES[:5])
def test_energies_are_those_printed_in_appendix_a(x, stance):
    """Out[25] and Out[18], with lc2 of the other sign: the text measures the swing leg upward."""
    (t1, t2), (w1, w2) = stance_first(x, stance)
    up2 = -lc2
    printed_kinetic = (
        (
            4 * I1 + I3 + 4 * l**2 * m1 - 8 * l * lc1 * m1 + 4 * lc1**2 * m1 + 4 * l**2 * m2
            + 4 * l**2 * m3 + lc3**2 * m3 + 4 * l * lc3 * m3 * np.cos((t1 - t2) / 2)
        ) * w1**2
        + 2 * (
            I3 + lc3**2 * m3 + 2 * l * lc3 * m3 * np.cos((t1 - t2) / 2)
            + 4 * l * up2 * m2 * np.cos(t1 - t2)
        ) * w1 * w2
        + (4 * I2 + I3 + 4 * up2**2 * m2 + lc3**2 * m3) * w2**2
    ) / 8  # fmt: skip
    printed_potential = g * (
        (-lc1 * m1 + l * (m1 + m2 + m3)) * np.cos(t1)
        + up2 * m2 * np.cos(t2)
        + lc3 * m3 * np.cos((t1 + t2) / 2)
    )
    kinetic, potential = CompassGait().energies(
        ca.DM(x[:2]), ca.DM(x[2:]), lumps(stance), Setup(stance=stance), ca.DM([0, 1])
    )
    np.testing.assert_allclose(float(kinetic), printed_kinetic, rtol=1e-13)
    np.testing.assert_allclose(float(potential), printed_potential, rtol=1e-13)


@pytest.mark.parametrize('stance', ['inner', 'outer'])
@pytest.mark.parametrize('x', STATES[:5])
def test_motion_satisfies_the_equation_printed_in_appendix_a(bare, x, stance):
    """Out[45], torque included: the text's tau drives the stance leg, ours the inner one."""
    model = bare.with_values(lumps(stance))
    hip_torque = 3.7
    compiled = compile_model(model, Setup(stance=stance))
    p = parameter_vector(model, Setup(stance=stance))
    dv = np.asarray(compiled.f(x, hip_torque, p)).ravel()[2:]
    tau = hip_torque if stance == 'inner' else -hip_torque
    (t1, t2), (w1, w2) = stance_first(x, stance)
    a1, a2 = dv if stance == 'inner' else dv[::-1]
    up2 = -lc2
    half, whole = (t1 - t2) / 2, t1 - t2
    M12 = I3 + lc3**2 * m3 + 2 * l * lc3 * m3 * np.cos(half) + 4 * l * up2 * m2 * np.cos(whole)
    first = (
        -4 * tau
        + (
            4 * I1 + I3 + 4 * l**2 * m1 - 8 * l * lc1 * m1 + 4 * lc1**2 * m1 + 4 * l**2 * m2
            + 4 * l**2 * m3 + lc3**2 * m3 + 4 * l * lc3 * m3 * np.cos(half)
        ) * a1
        + M12 * a2
        - 4 * g * l * m1 * np.sin(t1) + 4 * g * lc1 * m1 * np.sin(t1) - 4 * g * l * m2 * np.sin(t1)
        - 4 * g * l * m3 * np.sin(t1)
        - l * lc3 * m3 * w1**2 * np.sin(half) + 2 * l * lc3 * m3 * w1 * w2 * np.sin(half)
        + l * lc3 * m3 * w2**2 * np.sin(half) + 4 * l * up2 * m2 * w2**2 * np.sin(whole)
        - 2 * g * lc3 * m3 * np.sin((t1 + t2) / 2)
    )  # fmt: skip
    second = (
        4 * tau + M12 * a1 + (4 * I2 + I3 + 4 * up2**2 * m2 + lc3**2 * m3) * a2
        - 2 * l * lc3 * m3 * w1**2 * np.sin(half) - 4 * l * up2 * m2 * w1**2 * np.sin(whole)
        - 4 * g * up2 * m2 * np.sin(t2) - 2 * g * lc3 * m3 * np.sin((t1 + t2) / 2)
    )  # fmt: skip
    # Rounding only: single terms reach some hundred N m.
    np.testing.assert_allclose([first, second], 0, atol=1e-10)


@pytest.mark.parametrize('x', STATES[:5])
def test_motion_satisfies_eq_4_4_to_4_6_as_printed(bare, x):
    p = bare.values
    c1, c2, c3, c4, c5, c6 = (p[f'c{i}'] for i in range(1, 7))
    stance, swing = x[0], x[1]
    theta, rates = np.array([swing, stance]), np.array([x[3], x[2]])
    minus, plus = theta[1] - theta[0], theta.sum() / 2
    w2 = p['gravity'] / p['leg_length']
    coupling = c3 - c5 * np.cos(minus) + 2 * c6 * np.cos(minus / 2)
    H = np.array([[c2, coupling], [coupling, 1 + c1 - 2 * c4 + 4 * c6 * np.cos(minus / 2)]])
    C = np.array(
        [
            [0, (c5 * np.sin(minus) - 2 * c6 * np.sin(minus / 2)) * rates[1]],
            [
                (c6 * np.sin(minus / 2) - c5 * np.sin(minus)) * rates[0],
                c6 * (2 * rates[0] - rates[1]) * np.sin(minus / 2),
            ],
        ]
    )
    G = w2 * np.array(
        [
            2 * c6 * np.sin(-plus) + c5 * np.sin(theta[0]),
            2 * c6 * np.sin(-plus) + (c4 - 1) * np.sin(theta[1]),
        ]
    )
    torque = 3.7
    B = np.array([-1, 1]) * torque / (p['total_mass'] * p['leg_length'] ** 2)
    compiled = compile_model(bare, Setup())
    dv = np.asarray(compiled.f(x, torque, parameter_vector(bare, Setup()))).ravel()[2:]
    np.testing.assert_allclose(H @ dv[::-1] + C @ rates + G, B, atol=1e-13)


def test_swapping_the_legs_swaps_the_lumps(bare):
    p = bare.values
    mirrored = bare.with_values({'c1': p['c2'], 'c2': p['c1'], 'c4': p['c5'], 'c5': p['c4']})
    inner = compile_model(bare, Setup(stance='inner'))
    outer = compile_model(mirrored, Setup(stance='outer'))
    for x in STATES:
        there = np.asarray(inner.f(x, 2.0, parameter_vector(bare, Setup()))).ravel()
        back = np.asarray(
            outer.f(x[[1, 0, 3, 2]], -2.0, parameter_vector(mirrored, Setup()))
        ).ravel()
        np.testing.assert_allclose(back[[1, 0, 3, 2]], there, rtol=1e-12)


def test_mass_matrix_is_positive_definite_and_symmetric(bare, setup):
    e = assemble(bare, setup)
    mass_matrix = ca.Function('M', [e.x, e.p], [e.mass_matrix])
    p = parameter_vector(bare, setup)
    for x in STATES:
        M = np.asarray(mass_matrix(x[: e.x.shape[0]], p))
        np.testing.assert_allclose(M, M.T, atol=1e-14)
        assert np.linalg.eigvalsh(M).min() > 0


def test_power_of_the_hip_torque_is_the_change_of_energy(robot, setup):
    """dE/dt = tau d(hip angle)/dt without friction, springs included."""
    model = robot.without_effect('viscous_friction').without_effect('coulomb_friction')
    model = model.with_values({'c3': 0.004, 'c6': 0.011})
    model = model.with_effect('payload', at='outer', mass=1.3, distance=0.3)
    model = model.with_effect('ground_slope', angle=0.07)
    e = assemble(model, setup)
    m = e.coordinates
    dE = ca.jtimes(e.energy, e.x, e.rates)
    hip_rate = ca.jtimes(e.outputs[2], e.x, e.rates)
    power = ca.Function('power', [e.x, e.u, e.p], [dE, e.u[0] * hip_rate])
    for x in STATES:
        found, given = power(x[: 2 * m], 5.0, parameter_vector(model, setup))
        np.testing.assert_allclose(float(found), float(given), atol=1e-10)


def test_friction_only_takes_energy(robot):
    e = assemble(robot, Setup())
    dE = ca.Function('dE', [e.x, e.u, e.p], [ca.jtimes(e.energy, e.x, e.rates)])
    for x in STATES:
        rate = x[2] - x[3]
        expected = -0.694 * rate**2 - 1.84 * np.tanh(rate / 0.01) * rate
        assert expected < 0
        np.testing.assert_allclose(
            float(dE(x, 0.0, parameter_vector(robot, Setup()))), expected, rtol=1e-9
        )


def test_energy_is_conserved_over_seconds(bare, setup):
    compiled = compile_model(bare, setup)
    p, e = parameter_vector(bare, setup), compiled.equations
    energy = ca.Function('E', [e.x, e.p], [e.energy])
    time = np.arange(0, 2, 0.002)
    x0 = np.array([0.1, -0.2, 0.5, 0.3])[: 2 * e.coordinates]
    states = compiled.simulate(time, np.zeros((len(time), 1)), x0, p)
    E = np.asarray(energy(states.T, p)).ravel()
    # A falling robot swings round at 6 rad/s, where a Runge-Kutta step of 2 ms errs by this much.
    np.testing.assert_allclose(E, E[0], atol=2e-6 * bare.values['total_mass'] * 9.81)


def test_spring_holds_the_leg_in_a_hand_made_equilibrium(bare, springs):
    """Both springs straight out at the height of their points, pulling alike."""
    level = tuple(
        type(s)('inner', point=1.0, anchor=(x, 1.0), stiffness=300.0, free_length=0.2)
        for s, x in zip(springs, (-0.6, 0.6), strict=True)
    )
    setup = Setup(springs=level)
    compiled = compile_model(bare, setup)
    rates = compiled.f(np.zeros(4), 0.0, parameter_vector(bare, setup))
    np.testing.assert_allclose(np.asarray(rates).ravel(), 0, atol=1e-13)
    # One of them 10 N stronger: its moment about the foot is 10 N times 1 m, forward. The stance
    # row of M dv/dt = Q reads 10 N m, the swing row 0.
    tense = (level[0], type(level[0])('inner', 1.0, (0.6, 1.0), 300.0, 0.2 - 10 / 300))
    setup = Setup(springs=tense)
    e = assemble(bare, setup)
    force = ca.Function('Q', [e.x, e.u, e.p], [ca.mtimes(e.mass_matrix, e.rates[2:])])
    found = np.asarray(force(np.zeros(4), 0.0, parameter_vector(bare, setup))).ravel()
    np.testing.assert_allclose(found, [10.0, 0.0], atol=1e-12)


def test_spring_row_of_forces_has_the_direction_of_the_pull(bare, springs):
    setup = Setup(springs=springs[:1])
    e = assemble(bare, setup)
    free = assemble(bare, Setup())
    force = [
        ca.Function('Q', [a.x, a.u, a.p], [ca.mtimes(a.mass_matrix, a.rates[2:])])
        for a in (e, free)
    ]
    x = np.array([0.1, -0.3, 0.2, 0.4])
    pull = np.asarray(force[0](x, 0, parameter_vector(bare, setup))) - np.asarray(
        force[1](x, 0, parameter_vector(bare, Setup()))
    )
    s = springs[0]
    end = s.point * np.array([np.sin(0.1), np.cos(0.1)])
    reach = np.array(s.anchor) - end
    tension = s.stiffness * (np.linalg.norm(reach) - s.free_length)
    along = reach / np.linalg.norm(reach)
    # Moment about the foot of the tension, positive forward: z F_x - x F_z.
    moment = tension * (end[1] * along[0] - end[0] * along[1])
    np.testing.assert_allclose(pull.ravel(), [moment, 0], atol=1e-10)
