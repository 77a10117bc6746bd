"""States that no sensor reads, simulated along a measured motion."""

import numpy as np
import pytest
from finger import data, finger
from scipy.integrate import solve_ivp

from cg_dynamics.effects.backlash import Backlash
from cg_sysid.identification import along_motion
from cg_sysid.identification.along_motion import follows
from cg_sysid.identification.torque_error import fits_by_torque, problems_of
from cg_sysid.identification.unknowns import unknowns_of
from cg_sysid.search.starts import starts_of

DRIVES = {
    'joint_flexibility': {'stiffness': 0.06, 'rotor_inertia': 3e-5, 'damping': 4e-4},
    'backlash': {'gap': 0.015, 'rotor_inertia': 2e-5, 'stiffness': 2.5, 'damping': 4e-3},
    'actuator_lag': {'time_constant': 0.02},
    'joint_creep': {'stiffness': 0.01, 'time_constant': 0.2},
    'presliding_friction': {'torque': 2e-3, 'deflection': 0.02, 'damping': 1e-4},
}


@pytest.fixture(scope='module')
def stiff():
    return data(finger(), 2, seconds=2.0)


def along(name, data_sets):
    """What follows the states of an effect, and its parameters and those of the model."""
    model = finger().with_effect(name, **DRIVES[name])
    problem = problems_of(model, data_sets, unknowns_of(model))[0]
    plain = problem.equations.p.shape[0]
    return model, problem.followed[0], problem.vector[:plain], problem.vector[plain:], problem


@pytest.mark.parametrize('name', DRIVES)
def test_another_integrator_comes_to_the_same_torque(name, stiff):
    model, effect, p, own, problem = along(name, stiff)
    law = next(e for e in model.effects if e.name == name)
    assert follows(law)
    values = model.values_of(law)
    samples = problem.motion.records[0]
    time = np.arange(len(samples.position)) * samples.spacing
    angle, rate = samples.position[:, 0], samples.rate[:, 0]

    def reaches(t, z):
        k = min(int(t / samples.spacing), len(time) - 2)
        at = t / samples.spacing - k
        basis = np.array([
            (1 + 2 * at) * (1 - at) ** 2, at * (1 - at) ** 2, at**2 * (3 - 2 * at),
            at**2 * (at - 1),
        ])  # fmt: skip
        slope = np.array([6 * at * (at - 1), (1 - at) * (1 - 3 * at), 6 * at * (1 - at),
                          at * (3 * at - 2)])  # fmt: skip
        ends = angle[k], rate[k] * samples.spacing, angle[k + 1], rate[k + 1] * samples.spacing
        q, v, tau = basis @ ends, slope @ ends / samples.spacing, samples.inputs[k, 0]
        if law.place == 'command':
            passed, rates = law.deliver(tau, list(z[:-1]), values)
        elif law.place == 'transmission':
            passed, rates = law.transmit(tau, q, v, list(z[:-1]), values)
        else:
            added, rates = law.joint_torque(q, v, tau, list(z[:-1]), values)
            passed = tau + added
        return [float(x) for x in (*rates, passed - tau)]

    start = law.initial_states(angle[0], rate[0], samples.inputs[0, 0], values)
    z = np.array([*(float(x) for x in start), 0.0])
    impulse = [0.0]
    for k in range(60):  # sample by sample, as the torque jumps there
        piece = solve_ivp(
            reaches, (time[k], time[k + 1] - 1e-12), z, rtol=1e-9, atol=1e-12, max_step=2e-4
        )
        z = piece.y[:, -1]
        impulse.append(z[-1])
    mean = np.diff(impulse) / samples.spacing
    found = effect.simulated(samples, p, own)[:60, 0]
    # Runge-Kutta of fixed steps, across the edges of teeth: a part in 300 of the largest torque.
    assert found == pytest.approx(mean, abs=3e-3 * np.abs(mean).max())


@pytest.mark.parametrize('name', DRIVES)
def test_slopes_are_differences(name, stiff):
    _, effect, p, own, _ = along(name, stiff)
    _, slope = effect(p, own)
    for k, value in enumerate(own):
        step = 1e-6 * value
        ahead, behind = (effect(p, own + np.eye(len(own))[k] * s)[0] for s in (step, -step))
        difference = (ahead - behind) / (2 * step)
        size = np.abs(difference).max()
        assert slope[:, k] == pytest.approx(difference, abs=1e-4 * size + 1e-12)


def test_what_a_rotor_takes_is_its_momentum(stiff, monkeypatch):
    """A stiff rotor turns as its joint does: the torque that is missing there changes its rate."""
    name = 'joint_flexibility'
    drive = {'stiffness': 3.0, 'rotor_inertia': 3e-5, 'damping': 8e-3}
    monkeypatch.setitem(DRIVES, name, drive)
    _, effect, p, own, problem = along(name, stiff)
    samples = problem.motion.records[0]
    taken = effect.simulated(samples, p, own)[:, 0] * samples.spacing
    change = samples.rate[:, 0] - samples.rate[0, 0]
    last = int(np.argmax(np.abs(change)))
    # A tenth: the rate of the joint is that of a noisy encoder.
    assert np.sum(taken[:last]) == pytest.approx(-drive['rotor_inertia'] * change[last], rel=0.1)


def test_without_a_compiler_it_is_the_same(stiff, monkeypatch):
    _, effect, p, own, _ = along('backlash', stiff)
    monkeypatch.setattr(along_motion, 'compiler', lambda: None)
    _, slower, _, _, _ = along('backlash', stiff)
    assert slower(p, own)[0] == pytest.approx(effect(p, own)[0], rel=1e-9, abs=1e-12)


def test_a_rotor_that_runs_away_is_no_start(stiff):
    """Steps of play, 0.5 ms, follow a rotor of 5600 rad/s or less."""
    model = finger()
    starts = [
        DRIVES['backlash'], {**DRIVES['backlash'], 'rotor_inertia': 1e-8, 'stiffness': 50.0}
    ]  # fmt: skip
    assert np.sqrt(50.0 / 1e-8) * Backlash.largest_step > 2.8
    good, bad = fits_by_torque([model.with_effect('backlash', **s) for s in starts], stiff)
    assert np.isfinite(good.deviance)
    assert bad.deviance == np.inf


@pytest.mark.parametrize('gap', [pytest.param(0.008, marks=pytest.mark.evidence), 0.02])
def test_play_is_found_with_no_simulation_of_the_robot(gap):
    hidden = {'gap': gap, 'rotor_inertia': 2e-5, 'stiffness': 3.0, 'damping': 5e-3}
    believed = finger()
    data_sets = data(believed.with_effect('backlash', **hidden), 2)
    law = next(e for e in believed.with_effect('backlash', **hidden).effects
               if e.name == 'backlash')  # fmt: skip
    models = [believed.with_effect('backlash', **start) for start in starts_of(law)]
    found = fits_by_torque(models, data_sets, followed=6)
    best = min(found, key=lambda fitted: fitted.deviance)
    assert best.values['backlash.rotor_inertia'] == pytest.approx(2e-5, rel=0.1)
    # What noise of the encoder the rotor sees, teeth pass on by their stiffness: soft ones leave
    # less of it, and part of the gap is taken for what they give way.
    assert 0.5 * gap < best.values['backlash.gap'] < 1.2 * gap
