"""The virtual machine does what the compiled library does."""

import logging

import numpy as np
import pytest

from cg_dynamics.assemble import parameter_vector
from cg_dynamics.errors import SimulationError
from cg_dynamics.rig import Setup
from cg_dynamics.rollout import compiled as module
from cg_dynamics.rollout import compiler as c_compiler
from cg_dynamics.rollout.compiled import CompiledModel, compile_model
from cg_dynamics.rollout.fallback import InterpretedRollout

EFFECTS = [
    (),
    ('actuator_delay',),
    ('sensor_delay',),
    ('joint_flexibility', 'payload'),
    ('actuator_delay', 'sensor_delay', 'backlash', 'coulomb_friction'),
]


@pytest.fixture(params=EFFECTS, ids='+'.join)
def pair(request, bare, springs):
    if c_compiler.compiler() is None:
        pytest.skip('no C compiler on this machine: there is nothing to compare with')
    model = bare
    for name in request.param:
        values = {'delay': 0.0053} if name.endswith('delay') else {}
        model = model.with_effect(name, **values)
    setup = Setup(springs=springs)
    c = compile_model(model, setup)
    return c, CompiledModel(c.equations, c.free, native=False), parameter_vector(model, setup)


@pytest.fixture
def record(rng):
    # 300 rows of two to four steps each: several chunks, the last one not full.
    time = np.cumsum(rng.uniform(0.0015, 0.0065, size=300))
    return time, np.repeat(rng.normal(0, 3, size=(30, 1)), 10, axis=0)


def test_simulation_and_outputs(pair, record):
    compiled, interpreted, p = pair
    time, torque = record
    x0 = compiled.initial_state(np.array([0.05, 0.1, 0.2, -0.3]), torque[0], p)
    states = compiled.simulate(time, torque, x0, p)
    again = interpreted.simulate(time, torque, x0, p)
    np.testing.assert_allclose(again, states, atol=1e-9)
    np.testing.assert_allclose(
        interpreted.outputs(time, torque, states, p),
        compiled.outputs(time, torque, states, p), atol=1e-12,
    )  # fmt: skip


def test_normal_equations(pair, record, rng):
    compiled, interpreted, p = pair
    time, torque = record
    motion = np.array([0.05, 0.1, 0.2, -0.3])
    x0, by_motion, by_free = compiled.initial_sensitivity(motion, torque[0], p)
    nf = len(compiled.free)
    column = np.arange(4, 4 + nf)
    column[1] = -1
    s0 = np.hstack([by_motion, by_free])
    measured = rng.normal(0, 0.1, size=(len(time), 3))
    measured[::4, 2] = np.nan
    weight = np.array([1.0, 2.0, 3.0])
    arguments = (time, torque, x0, s0, p, column, measured, weight)
    expected, y, J = compiled.normal(*arguments, keep=True)
    found, again_y, again_J = interpreted.normal(*arguments, keep=True)
    np.testing.assert_allclose(again_y, y, atol=1e-9)
    np.testing.assert_allclose(again_J, J, rtol=1e-6, atol=1e-6 * np.abs(J).max())
    np.testing.assert_allclose(found.hessian, expected.hessian, rtol=1e-6, atol=1e-3)
    np.testing.assert_allclose(found.sse, expected.sse, rtol=1e-8)
    np.testing.assert_array_equal(found.count, expected.count)
    assert found.rows == expected.rows == len(time)


def test_single_steps(pair):
    compiled, interpreted, p = pair
    x = compiled.initial_state(np.array([0.05, 0.1, 0.2, -0.3]), np.zeros(1), p)
    y = x.copy()
    compiled.advance(x, np.array([2.0]), p, 0.0005, 7)
    interpreted.advance(y, np.array([2.0]), p, 0.0005, 7)
    np.testing.assert_allclose(y, x, atol=1e-13)


def test_runaway_is_found_at_the_same_row(bare):
    time, torque = np.arange(500) * 0.002, np.full((500, 1), 1e13)
    p = parameter_vector(bare, Setup())
    compiled = compile_model(bare, Setup())
    times = []
    for route in (compiled, CompiledModel(compiled.equations, compiled.free, native=False)):
        with pytest.raises(SimulationError) as caught:
            route.simulate(time, torque, np.zeros(4), p)
        times.append(caught.value.time)
    assert times[0] == pytest.approx(times[1], abs=0.0021)


def test_without_a_compiler_it_is_used_and_says_so(bare, monkeypatch, caplog):
    monkeypatch.setenv('CG_COMPILER', '')
    c_compiler.compiler.cache_clear()
    monkeypatch.setattr(module, '_built', {})
    try:
        with caplog.at_level(logging.WARNING):
            compiled = compile_model(bare, Setup())
    finally:
        monkeypatch.undo()
        c_compiler.compiler.cache_clear()
    assert isinstance(compiled._c, InterpretedRollout)
    assert 'no C compiler' in caplog.text
