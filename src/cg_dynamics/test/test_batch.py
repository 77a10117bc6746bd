"""Many rollouts at once are the same rollouts."""

import casadi as ca
import numpy as np
import pytest

from cg_dynamics.assemble import parameter_vector
from cg_dynamics.effects import LIBRARY
from cg_dynamics.mechanisms import MECHANISMS
from cg_dynamics.rig import Setup
from cg_dynamics.rollout import batch as module
from cg_dynamics.rollout.batch import Feedback, batch_library, simulate_batch
from cg_dynamics.rollout.compiled import compile_model
from cg_dynamics.rollout.compiler import compiler
from cg_dynamics.rollout.vector_code import UnsupportedError, vector_code

TIME = np.arange(0, 0.2, 0.002)
EVERY = [name for name, e in LIBRARY.items() if e.sites(MECHANISMS['compass_gait'])]
FOURTH = -(-len(EVERY) // 4)
TORQUE = (6 * np.sin(2 * np.pi * 3 * TIME))[:, None]

needs_compiler = pytest.mark.skipif(compiler() is None, reason='no C compiler on this machine')


@pytest.fixture
def starts(rng):
    # 21 rollouts: the last block of eight is not full.
    return rng.uniform(-1, 1, size=(21, 4)) * [0.3, 0.3, 1.0, 1.0]


def one_by_one(model, setup, u, x0, p):
    compiled = compile_model(model, setup)
    batch = len(x0)
    u = np.broadcast_to(u, (batch, *u.shape[-2:]))
    p = np.broadcast_to(p, (batch, p.shape[-1]))
    paths = []
    for torque, x, parameters in zip(u, x0.copy(), p, strict=True):
        held = compiled.delayed_inputs(TIME, torque, compiled.delays(parameters)[0])[0]
        path = [x.copy()]
        for now, dt in zip(held, np.diff(TIME), strict=False):
            steps = int(np.ceil(dt / compiled.largest_step * (1 - 1e-9)))
            compiled.advance(x, now, parameters, dt / steps, steps)
            path.append(x.copy())
        paths.append(path)
    return np.array(paths)


@pytest.fixture
def elementary(bare):
    library = batch_library(compile_model(bare, Setup()))

    def evaluate(x):
        results = [np.empty_like(x) for _ in range(4)]
        library.cgb_elementary(len(x), x.ctypes.data, *(r.ctypes.data for r in results))
        return results

    return evaluate


@needs_compiler
@pytest.mark.parametrize('reach', [0.7, 10.0, 1e3, 1e5])
def test_sine_and_cosine(elementary, rng, reach):
    x = np.concatenate([rng.uniform(-reach, reach, 79992), [0, -0.0, np.pi, -np.pi / 2] * 2])
    sine, cosine, _, _ = elementary(x)
    np.testing.assert_allclose(sine, np.sin(x), rtol=0, atol=3e-16)
    np.testing.assert_allclose(cosine, np.cos(x), rtol=0, atol=3e-16)


@needs_compiler
def test_exponential(elementary, rng):
    x = np.concatenate([rng.uniform(-708, 708, 40000), rng.uniform(-1, 1, 40000)])
    np.testing.assert_allclose(elementary(x)[2], np.exp(x), rtol=5e-16)
    far = np.array([800.0, -800.0, 1e300, -1e300, 708, -708, 0, -0.0])
    found = elementary(far)[2]
    np.testing.assert_allclose(found, np.exp(np.clip(far, -708, 708)), rtol=5e-16)


@needs_compiler
def test_hyperbolic_tangent(elementary, rng):
    x = np.concatenate([rng.uniform(-3, 3, 39992), rng.normal(0, 1e-3, 40000), [1e3, -1e3] * 4])
    np.testing.assert_allclose(elementary(x)[3], np.tanh(x), rtol=5e-16, atol=1e-300)


# Most of the time goes into compiling, so that every machine gets four effects.
@pytest.mark.parametrize('names', [EVERY[k::FOURTH] for k in range(FOURTH)], ids='+'.join)
def test_every_effect(bare, springs, starts, names):
    model = bare
    for name in names:
        model = model.with_effect(name)
    setup = Setup(springs=springs)
    compiled, p = compile_model(model, setup), parameter_vector(model, setup)
    u = np.hstack([TORQUE, np.ones((len(TIME), compiled.nu - 1))])
    x0 = np.array([compiled.initial_state(x, u[0], p) for x in starts])
    found = simulate_batch(model, setup, TIME, u, x0, p, trajectories=True)
    # Rounding, multiplied by what a stiff transmission makes of it.
    np.testing.assert_allclose(found, one_by_one(model, setup, u, x0, p), rtol=0, atol=1e-10)


def test_every_setup(robot, setup, starts):
    p = parameter_vector(robot, setup)
    x0 = np.ascontiguousarray(starts[:, : compile_model(robot, setup).nx])
    found = simulate_batch(robot, setup, TIME, TORQUE, x0, p)
    expected = one_by_one(robot, setup, TORQUE, x0, p)[:, -1]
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize('threads', [1, 2, 3])
def test_own_parameters_and_torques_for_each(robot, starts, rng, threads):
    p = parameter_vector(robot, Setup()) * rng.uniform(0.97, 1.03, size=(len(starts), 1))
    u = rng.normal(0, 3, size=(len(starts), len(TIME), 1))
    found = simulate_batch(robot, Setup(), TIME, u, starts, p, trajectories=True, threads=threads)
    np.testing.assert_allclose(found, one_by_one(robot, Setup(), u, starts, p), rtol=0, atol=1e-12)


@pytest.mark.parametrize('batch', [1, 7, 8, 9])
def test_any_number_of_rollouts(robot, starts, batch):
    p = parameter_vector(robot, Setup())
    found = simulate_batch(robot, Setup(), TIME, TORQUE, starts[:batch], p)
    expected = one_by_one(robot, Setup(), TORQUE, starts[:batch], p)[:, -1]
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12)


def test_own_delay_for_each(bare, starts, rng):
    model = bare.with_effect('actuator_delay')
    names = compile_model(model, Setup()).parameter_names
    p = np.tile(parameter_vector(model, Setup()), (len(starts), 1))
    p[:, names.index('actuator_delay.delay')] = rng.uniform(0, 0.02, len(starts))
    found = simulate_batch(model, Setup(), TIME, TORQUE, starts, p)
    expected = one_by_one(model, Setup(), TORQUE, starts, p)[:, -1]
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12)


@pytest.fixture
def feedback(rng):
    n = len(TIME)
    return Feedback(
        gains=rng.normal(0, 5, size=(n, 1, 4)),
        reference=rng.normal(0, 0.05, size=(n, 4)),
        limit=np.array([4.0]),
    )


def test_feedback_is_computed_and_limited_at_each_row(bare, starts, feedback):
    p, compiled = parameter_vector(bare, Setup()), compile_model(bare, Setup())
    found = simulate_batch(
        bare, Setup(), TIME, TORQUE, starts, p, trajectories=True, feedback=feedback
    )
    used = set()
    for b, x in enumerate(starts):
        x = x.copy()
        for k in range(len(TIME) - 1):
            u = TORQUE[k] - feedback.gains[k] @ (x - feedback.reference[k])
            used.add(bool(abs(u[0]) > 4.0))
            compiled.advance(x, np.clip(u, -4.0, 4.0), p, 0.002, 1)
            np.testing.assert_allclose(found[b, k + 1], x, rtol=0, atol=1e-11)
    assert used == {True, False}


def test_without_a_compiler_rollouts_run_one_by_one(robot, starts, feedback, monkeypatch):
    p = parameter_vector(robot, Setup())
    closed = {'trajectories': True, 'feedback': feedback}
    fast = simulate_batch(robot, Setup(), TIME, TORQUE, starts[:5], p, **closed)
    monkeypatch.setattr(module, 'batch_library', lambda compiled: None)
    slow = simulate_batch(robot, Setup(), TIME, TORQUE, starts[:5], p, **closed)
    np.testing.assert_allclose(slow, fast, rtol=0, atol=1e-11)


def test_runaways_are_not_numbers_and_leave_the_others_alone(bare, starts):
    p = parameter_vector(bare, Setup())
    u = np.zeros((len(starts), len(TIME), 1))
    u[3] = 1e9
    found = simulate_batch(bare, Setup(), TIME, u, starts, p)
    assert np.isnan(found[3]).any()
    others = np.delete(np.arange(len(starts)), 3)
    expected = one_by_one(bare, Setup(), u[others], starts[others], p)[:, -1]
    np.testing.assert_allclose(found[others], expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    ('wrong', 'message'),
    [
        ({'x0': np.zeros((3, 5))}, r'x0 has shape \(3, 5\), expected \(3, 4\)'),
        ({'u': TORQUE[:-1]}, r'u has shape \(99, 1\), expected \(100, 1\)'),
        ({'p': np.zeros(3)}, r'p has shape \(3,\), expected'),
    ],
)
def test_wrong_shapes_are_named(bare, wrong, message):
    good = {'u': TORQUE, 'x0': np.zeros((3, 4)), 'p': parameter_vector(bare, Setup())}
    with pytest.raises(ValueError, match=message):
        simulate_batch(bare, Setup(), TIME, **(good | wrong))


def test_feedback_through_a_delay_is_refused(bare, feedback):
    model = bare.with_effect('actuator_delay')
    p = parameter_vector(model, Setup())
    with pytest.raises(ValueError, match='actuator delay'):
        simulate_batch(model, Setup(), TIME, TORQUE, np.zeros((3, 4)), p, feedback=feedback)


def test_operation_without_vector_form_is_named():
    x, u, p = ca.SX.sym('x'), ca.SX.sym('u'), ca.SX.sym('p')
    f = ca.Function('odd', [x, u, p], [ca.erf(x)])
    with pytest.raises(UnsupportedError, match="of 'odd'"):
        vector_code(f, 'odd', 'prepare')
