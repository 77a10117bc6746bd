"""Compiled rollouts: sensitivities against differences, inputs, delays, cache and failures."""

import os
import sys

import numpy as np
import pytest

from cg_description.paths import model_path
from cg_dynamics.assemble import parameter_vector
from cg_dynamics.effects import LIBRARY
from cg_dynamics.errors import SimulationError
from cg_dynamics.mechanisms import MECHANISMS
from cg_dynamics.model import Model
from cg_dynamics.rig import Setup
from cg_dynamics.rollout import compiled as module
from cg_dynamics.rollout import compiler as c_compiler
from cg_dynamics.rollout.compiled import CompiledModel, compile_model, simulate

TIME = np.arange(0, 0.4, 0.002)
TORQUE = (6 * np.sin(2 * np.pi * 3 * TIME) + 3 * np.cos(50 * TIME))[:, None]
# Values off the grid of rows and off the neutral value, as identification meets them.
VALUES = {
    'actuator_delay': {'delay': 0.0053},
    'sensor_delay': {'delay': 0.0047},
    'backlash': {'gap': 0.02},
    'torque_quantisation': {'roundness': 0.5},  # differences need edges that they can resolve
}


def start(compiled, p):
    motion = np.array([0.05, 0.12, 0.2, -0.3])
    m2 = 2 * compiled.equations.coordinates
    return motion[:m2] if m2 == 4 else motion[[0, 2]]


def jacobian_and_differences(model, setup, backend=None):
    compiled = compile_model(model, setup)
    if backend is not None:
        compiled = CompiledModel(compiled.equations, compiled.free, native=False)
    p = parameter_vector(model, setup)
    torque = np.hstack([TORQUE, np.ones((len(TIME), compiled.nu - 1))])
    motion = start(compiled, p)
    m2, nf = len(motion), len(compiled.free)

    def outputs(motion, p):
        x0 = compiled.initial_state(motion, torque[0], p)
        return compiled.readings(TIME, torque, x0, p)

    x0, by_motion, by_free = compiled.initial_sensitivity(motion, torque[0], p)
    s0, column = np.hstack([by_motion, by_free]), np.arange(m2, m2 + nf)
    measured = np.zeros((len(TIME), compiled.ny))
    normal, y, J = compiled.normal(
        TIME, torque, x0, s0, p, column, measured, np.ones(compiled.ny), keep=True
    )
    np.testing.assert_allclose(y, outputs(motion, p), atol=1e-12)
    differences = np.empty_like(J)
    for j in range(m2 + nf):
        ahead, behind = [motion.copy(), p.copy()], [motion.copy(), p.copy()]
        if j < m2:
            which, index, h = 0, j, 1e-5
        else:
            which, index = 1, compiled.parameter_names.index(compiled.free[j - m2])
            h = 1e-5 * max(abs(p[index]), 1e-3)
        ahead[which][index] += h
        behind[which][index] -= h
        differences[:, :, j] = (outputs(*ahead) - outputs(*behind)) / (2 * h)
    return compiled, normal, y, J, differences


def assert_close(J, differences):
    scale = np.abs(differences).max(axis=(0, 1))
    error = np.abs(J - differences).max(axis=(0, 1)) / np.maximum(scale, 1e-4)
    # Differences of a Runge-Kutta solution; a delayed output is a cubic between rows.
    assert error.max() < 2e-4, error


@pytest.mark.parametrize(
    ('name', 'site'),
    [(n, s) for n, e in LIBRARY.items() for s in e.sites(MECHANISMS['compass_gait'])],
)
def test_sensitivities_under_every_effect(bare, springs, name, site):
    model = bare.with_effect(name, at=site, **VALUES.get(name, {}))
    _, _, _, J, differences = jacobian_and_differences(model, Setup(springs=springs))
    assert_close(J, differences)


@pytest.mark.parametrize('name', ['encoder_offset', 'encoder_eccentricity'])
def test_sensitivities_of_a_machine_with_one_output(name):
    """Its outputs by several parameters of a sensor are a single row."""
    model = Model.load(model_path('sydney_pendulum')).with_effect(name)
    model = model.with_values({'coulomb_friction.transition_rate': 0.1})
    _, _, _, J, differences = jacobian_and_differences(model, Setup())
    assert_close(J, differences)


def test_sensitivities_in_every_setup(robot, setup):
    model = robot.with_values({'coulomb_friction.transition_rate': 0.1})
    model = model.with_effect('payload', at='outer', mass=0.7, distance=0.4)
    _, _, _, J, differences = jacobian_and_differences(model, setup)
    assert_close(J, differences)


def test_sensitivities_of_many_effects_at_once(robot, springs):
    model = robot.with_values({'coulomb_friction.transition_rate': 0.1})
    for name in ('payload', 'joint_flexibility', 'actuator_delay', 'sensor_delay', 'imu_offset'):
        model = model.with_effect(name, **VALUES.get(name, {}))
    _, _, _, J, differences = jacobian_and_differences(model, Setup(springs=springs))
    assert_close(J, differences)


def test_normal_equations_are_those_of_the_jacobian(robot, rng):
    compiled, p = compile_model(robot, Setup()), parameter_vector(robot, Setup())
    x0 = np.array([0.05, 0.12, 0.2, -0.3])
    nf = len(compiled.free)
    s0, column = np.hstack([np.eye(4), np.zeros((4, nf))]), np.arange(4, 4 + nf)
    measured = rng.normal(0, 0.1, size=(len(TIME), 3))
    measured[::3, 1] = np.nan
    weight = np.array([2.0, 3.0, 5.0])
    normal, y, J = compiled.normal(TIME, TORQUE, x0, s0, p, column, measured, weight, keep=True)
    residual = np.where(np.isnan(measured), 0, y - measured) * weight
    J = np.where(np.isnan(measured)[:, :, None], 0, J) * weight[:, None]
    J = J.reshape(-1, J.shape[2])
    np.testing.assert_allclose(normal.hessian, J.T @ J, rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(normal.gradient, J.T @ residual.ravel(), rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(normal.sse, (residual**2).sum(axis=0), rtol=1e-12)
    np.testing.assert_array_equal(normal.count, (~np.isnan(measured)).sum(axis=0))
    assert normal.rows == len(TIME)


def test_parameters_without_a_column_stay_constant(robot):
    compiled, p = compile_model(robot, Setup()), parameter_vector(robot, Setup())
    x0, nf = np.array([0.05, 0.12, 0.2, -0.3]), len(compiled.free)
    measured, weight = np.zeros((len(TIME), 3)), np.ones(3)
    full = compiled.normal(
        TIME, TORQUE, x0, np.zeros((4, nf)), p, np.arange(nf), measured, weight, keep=True
    )[2]
    column = np.full(nf, -1)
    column[2] = 0
    one = compiled.normal(
        TIME, TORQUE, x0, np.zeros((4, 1)), p, column, measured, weight, keep=True
    )[2]
    np.testing.assert_allclose(one[:, :, 0], full[:, :, 2], rtol=1e-13)


def test_inputs_are_held_between_uneven_rows(bare, rng):
    """A row put between two others, with the same input, changes nothing."""
    time = np.cumsum(rng.uniform(0.001, 0.006, size=60))
    torque = rng.normal(0, 4, size=(60, 1))
    x0 = np.array([0.05, 0.12, 0.2, -0.3])
    states, _ = simulate(bare, Setup(), time, torque, x0)
    between = np.insert(time, 31, time[30] + 0.4 * (time[31] - time[30]))
    repeated = np.insert(torque, 31, torque[30], axis=0)
    again, _ = simulate(bare, Setup(), between, repeated, x0)
    # Runge-Kutta of other steps.
    np.testing.assert_allclose(np.delete(again, 31, axis=0), states, atol=1e-8)


def test_order_of_the_integrator_is_four(bare):
    compiled, p = compile_model(bare, Setup()), parameter_vector(bare, Setup())

    def end(steps):
        x = np.array([0.05, 0.12, 0.2, -0.3])
        compiled.advance(x, np.array([3.0]), p, 0.4 / steps, steps)
        return x

    exact = end(4000)
    ratio = np.abs(end(20) - exact).max() / np.abs(end(40) - exact).max()
    assert 12 < ratio < 22


@pytest.mark.parametrize(
    ('name', 'values'),
    [
        ('backlash', {'gap': 0.02}),
        ('presliding_friction', {'torque': 2.0, 'deflection': 0.002}),
        ('joint_flexibility', {}),
        ('actuator_lag', {'time_constant': 0.01}),
    ],
)
def test_steps_follow_what_happens(bare, name, values):
    """A fast swing through play, bristles and springs, beside steps of 20 microseconds."""
    model = bare.with_effect(name, **values)
    setup = Setup(fixture='inner_fixed')
    compiled, p = compile_model(model, setup), parameter_vector(model, setup)
    time = np.arange(0, 2, 0.002)
    torque = 6 * np.sin(2 * np.pi * 3 * time)[:, None]
    x0 = compiled.initial_state(np.array([0.2, 6.0]), torque[0], p)
    x, path = x0.copy(), [x0.copy()]
    for held in torque[:-1]:
        compiled.advance(x, held, p, 2e-5, 100)
        path.append(x.copy())
    exact = compiled.outputs(time, torque, np.array(path), p)
    usual = np.abs(compiled.readings(time, torque, x0, p) - exact).max()
    finer = np.abs(compiled.readings(time, torque, x0, p, refinement=4) - exact).max()
    # A tolerance of 3e-7 a step: some steps add up. An encoder of 16 bits resolves 1e-4 rad.
    assert usual < 5e-6
    assert finer < 5e-8


@pytest.mark.parametrize(
    ('rotor', 'damping', 'goes'),
    [
        (0.05, 20.0, True),  # 400/s, teeth stiffer than those of real drives are
        (1e-4, 3.0, False),  # 30 000/s: 2 ms in steps of 60 microseconds
    ],
)
def test_a_coarse_simulation_does_not_follow_what_is_stiffer_than_drives(
    bare, rotor, damping, goes
):
    values = {'stiffness': 2e4, 'rotor_inertia': rotor, 'damping': damping}
    model = bare.with_effect('joint_flexibility', **values)
    setup = Setup(fixture='inner_fixed')
    compiled, p = compile_model(model, setup), parameter_vector(model, setup)
    time = np.arange(0, 1, 0.002)
    torque = 6 * np.sin(2 * np.pi * 3 * time)[:, None]
    x0 = compiled.initial_state(np.array([0.2, 6.0]), torque[0], p)
    measured, weight = np.zeros((len(time), compiled.ny)), np.ones(compiled.ny)
    coarse, usual = (
        compiled.judge(time, torque, x0, p, measured, weight, refinement=refinement)
        for refinement in (0.25, 1.0)
    )
    assert usual.rows == len(time)
    assert (coarse.rows == len(time)) == goes


def test_sensitivities_are_stable_where_the_state_rests(bare):
    """Bristles settle within 0.3 ms; over 2 ms what is left of their turning grows eightfold."""
    model = bare.with_effect('presliding_friction', torque=0.3, deflection=0.002)
    setup = Setup(fixture='inner_fixed')
    compiled, p = compile_model(model, setup), parameter_vector(model, setup)
    time = np.arange(0, 8, 0.002)
    torque = (60 * np.sin(2 * np.pi * 1.3 * time) + 30 * np.cos(17 * time))[:, None]
    motion, place = np.array([0.2, 0.5]), compiled.free.index('presliding_friction.deflection')
    x0, by_motion, by_free = compiled.initial_sensitivity(motion, torque[0], p)
    s0, column = np.hstack([by_motion, by_free]), 2 + np.arange(len(compiled.free))
    _, y, J = compiled.normal(
        time, torque, x0, s0, p, column, np.zeros((len(time), compiled.ny)),
        np.ones(compiled.ny), keep=True,
    )  # fmt: skip
    assert np.abs(np.diff(y[:, 2])).max() / 0.002 > 5  # rad/s
    ends = []
    for h in (2e-5, -2e-5):
        q = p.copy()
        q[compiled.parameter_names.index('presliding_friction.deflection')] += h
        x0 = compiled.initial_state(motion, torque[0], q)
        ends.append(compiled.readings(time, torque, x0, q))
    difference = (ends[0] - ends[1]) / 4e-5
    scale = np.abs(difference).max()
    np.testing.assert_allclose(J[:, :, 2 + place], difference, atol=0.03 * scale)


def test_runaway_is_an_error_that_says_when(bare):
    torque = np.full((1000, 1), 1e9)
    with pytest.raises(SimulationError, match='runs away') as caught:
        simulate(bare, Setup(), np.arange(1000) * 0.002, torque, np.zeros(4))
    assert 0 <= caught.value.time < 2


def test_library_is_built_once_and_found_again(bare, tmp_path, monkeypatch):
    if c_compiler.compiler() is None:
        pytest.skip('no C compiler on this machine')
    monkeypatch.setenv('CG_CACHE', str(tmp_path))
    monkeypatch.setattr(module, '_built', {})
    first = compile_model(bare, Setup())
    assert compile_model(bare.with_values({'c1': 0.12}), Setup()) is first
    (library,) = tmp_path.glob('*.so')
    stamp = library.stat().st_mtime_ns
    monkeypatch.setattr(module, '_built', {})
    compile_model(bare, Setup())
    assert library.stat().st_mtime_ns == stamp
    compile_model(bare, Setup(stance='outer'))
    assert len(list(tmp_path.glob('*.so'))) == 2


def test_library_may_be_kept_in_a_relative_directory(bare, tmp_path, monkeypatch):
    if c_compiler.compiler() is None:
        pytest.skip('no C compiler on this machine')
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv('CG_CACHE', '.')
    monkeypatch.setattr(module, '_built', {})
    compile_model(bare, Setup())
    assert len(list(tmp_path.glob('*.so'))) == 1
    monkeypatch.setenv('CG_CACHE', '')
    monkeypatch.setenv('XDG_CACHE_HOME', str(tmp_path / 'cache'))
    assert c_compiler.cache_directory() == tmp_path / 'cache' / 'compass_gait'


def test_the_compiler_does_not_hear_what_a_terminal_tells_us(tmp_path, monkeypatch):
    """A stand-in for it: a signal to our process group is not one to its own."""
    group = tmp_path / 'group'
    stand_in = tmp_path / 'cc'
    stand_in.write_text(
        f'#!/bin/sh\n{sys.executable} -c "import os; print(os.getpgrp())" > {group}\n'
        'while [ "$1" != -o ]; do shift; done; : > "$2"\n'
    )
    stand_in.chmod(0o755)
    monkeypatch.setattr(c_compiler, 'compiler', lambda: str(stand_in))
    c_compiler.build('int f;', tmp_path / 'f.so')
    assert int(group.read_text()) != os.getpgrp()


def test_arrays_of_wrong_shape_are_refused(bare):
    compiled, p = compile_model(bare, Setup()), parameter_vector(bare, Setup())
    good = {'time': TIME, 'u': TORQUE, 'x0': np.zeros(4), 'p': p}
    for name, wrong in (('u', TORQUE[:-1]), ('x0', np.zeros(3)), ('p', p[:-1])):
        with pytest.raises(ValueError, match=rf'^{name} has shape .*, expected'):
            compiled.simulate(**(good | {name: wrong}))
    with pytest.raises(ValueError, match='x, u, p have shapes'):
        compiled.advance(np.zeros(4), np.zeros(2), p, 0.001, 1)


@pytest.mark.parametrize('lump', ['c1', 'c2', 'c3', 'c4', 'c5', 'c6'])
def test_every_lump_matters(bare, lump):
    """What a flipped or dropped term would do: no parameter may be without effect."""
    x0 = np.array([0.05, 0.12, 0.2, -0.3])
    changed = bare.with_values({lump: 1.05 * bare.values[lump]})
    difference = (
        simulate(changed, Setup(), TIME, TORQUE, x0)[1]
        - simulate(bare, Setup(), TIME, TORQUE, x0)[1]
    )
    assert np.abs(difference).max() > 1e-5


def test_torque_of_the_other_sign_moves_the_robot_the_other_way(bare):
    """Mirror symmetry: the robot upright, motion and torque mirrored, moves mirrored."""
    x0 = np.array([0.05, 0.12, 0.2, -0.3])
    right, _ = simulate(bare, Setup(), TIME, TORQUE, x0)
    left, _ = simulate(bare, Setup(), TIME, -TORQUE, -x0)
    wrong, _ = simulate(bare, Setup(), TIME, TORQUE, -x0)
    np.testing.assert_allclose(left, -right, atol=1e-13)
    assert np.abs(wrong + right).max() > 0.1


def test_late_outputs_are_those_of_the_earlier_instant_under_torque_that_jumps(bare, rng):
    """Between rows an output is a cubic; its slopes belong to the torque that is held there."""
    torque = np.repeat(rng.normal(0, 5, size=(20, 1)), 10, axis=0)
    x0 = np.array([0.05, 0.12, 0.2, -0.3])
    late = simulate(bare.with_effect('sensor_delay', delay=0.0031), Setup(), TIME, torque, x0)[1]
    fine_time, fine_torque = np.arange(0, 0.4 - 0.0019, 1e-4), np.repeat(torque, 20, axis=0)
    fine = simulate(bare, Setup(), fine_time, fine_torque[: len(fine_time)], x0)[1]
    rows = np.arange(2, len(TIME))
    np.testing.assert_allclose(late[rows], fine[20 * rows - 31], atol=1e-8)
