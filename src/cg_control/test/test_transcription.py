"""The program: derivatives against differences, rows against the model, structure for fatrop."""

import numpy as np
import pytest

from cg_control.trajectories.collocation import planning_model
from cg_control.trajectories.transcription import EDGE, PIECES, UNITS, Structure, transcribe
from cg_dynamics.assemble import parameter_vector
from cg_dynamics.rig import Setup
from cg_dynamics.rollout.compiled import compile_model
from cg_dynamics.walking.impact import impact

TASK = [0.03, 0.02, 0.1, 0.05, 0.1, 0.05, 0.4]
CASES = [
    Structure(('inner',), (4,)),
    Structure(('inner', 'outer'), (3, 4), rate_limited=True, clearance=True),
    Structure(('outer', 'inner'), (2, 3), elastic=True),
    Structure(('inner',), (3,), periodic=True, goal='region'),
    Structure(('outer', 'inner'), (2, 2), goal='tube'),
    Structure(('inner',), (3,), goal='stretch', elastic=True),
    Structure(('inner',), (3,), periodic=True, elastic=True),
    Structure(('inner', 'outer'), (3, 2), periodic=True, clocked=True),
    Structure(('outer', 'inner'), (2, 2), clocked=True, elastic=True),
]


def parameters(model, structure):
    goal = np.zeros(8)
    form = np.diag([1.0, 2.0, 3.0, 4.0]).ravel()
    if structure.goal == 'region':
        goal = np.concatenate([np.full(4, 0.1), form])
    elif structure.goal != 'box':
        # Six pieces of 0.2 s, each with an edge of its own.
        start = np.where(np.arange(PIECES) < 6, 0.2 * np.arange(PIECES), 1e3)
        edges = np.random.default_rng(1).normal(size=EDGE * PIECES)
        goal = np.concatenate([start, edges, form if structure.goal == 'tube' else []])
    return np.concatenate([parameter_vector(model, Setup()), TASK, goal])


@pytest.mark.parametrize('structure', CASES, ids=str)
def test_derivatives_are_those_of_the_rows(robot, structure):
    model = planning_model(robot, friction=False)
    program = transcribe(model, structure)
    functions, p = program.functions(), parameters(model, structure)
    rng = np.random.default_rng(0)
    z = rng.uniform(0.0, 1.0, program.size)
    multipliers = rng.normal(size=len(program.names))
    g, jacobian = (np.array(a) for a in functions['nlp_jac_g'](z, p))
    gamma, hessian = (np.array(a) for a in functions['nlp_hess_l'](z, p, 1.3, multipliers))
    _, again = functions['nlp'](z, p)
    np.testing.assert_array_equal(np.array(again), g)
    step = 1e-5
    for i in rng.permutation(program.size)[:25]:
        nudge = np.zeros(program.size)
        nudge[i] = step
        up, down = z + nudge, z - nudge
        slope = np.array(functions['nlp_g'](up, p) - functions['nlp_g'](down, p)) / (2 * step)
        # Differences err by step^2 times third derivatives, which short intervals make large.
        scale = max(1.0, np.abs(jacobian[:, i]).max())
        np.testing.assert_allclose(jacobian[:, i], slope.ravel(), atol=1e-5 * scale)
        lagrangian = [
            1.3 * float(functions['nlp_f'](a, p))
            + float(np.dot(multipliers, np.array(functions['nlp_g'](a, p)).ravel()))
            for a in (up, down)
        ]
        change = (lagrangian[0] - lagrangian[1]) / (2 * step)
        np.testing.assert_allclose(gamma[i, 0], change, rtol=1e-4, atol=1e-3)
        slope = [
            np.array(functions['nlp_hess_l'](a, p, 1.3, multipliers)[0]).ravel()
            for a in (up, down)
        ]
        scale = max(1.0, np.abs(hessian[:, i]).max())
        np.testing.assert_allclose(
            hessian[:, i], (slope[0] - slope[1]) / (2 * step), atol=2e-5 * scale
        )


def test_rows_vanish_on_a_motion_of_the_model_as_the_step_shrinks(robot):
    """Hermite-Simpson errs by h^5 in a step: halving it divides the rows by 2^5."""
    model = planning_model(robot, friction=False)
    compiled, p_model = compile_model(model, Setup()), parameter_vector(model, Setup())
    worst = []
    for n in (10, 20):
        program = transcribe(model, Structure(('inner',), (n,)))
        p = parameters(model, program.structure)
        times = np.linspace(0.0, 0.6, 6001)
        u = 3.0 - 4.0 * times[:, None]
        x = compiled.simulate(times, u - 4.0 * 5e-5, np.array([0.1, -0.2, 0.3, 0.5]), p_model)
        x, torque = x[:: 6000 // n], u[:: 6000 // n]
        a = np.array(compiled.f(x.T, torque.T, p_model)).T[:, 2:]
        knots = np.column_stack([x, a, torque])
        z = np.zeros(program.size)
        for k in range(n + 1):
            z[program.offsets[k] : program.offsets[k] + 8] = [*knots[k] / UNITS, 0.6]
            if k < n:
                z[program.offsets[k] + 8 : program.offsets[k + 1]] = knots[k + 1] / UNITS
        g = np.array(program.functions()['nlp_g'](z, p)).ravel()
        np.testing.assert_allclose(g[program.rows_of['']], 0.0, atol=1e-14)
        # Rounding of accelerations of 10 rad/s^2, and the 0.1 ms steps of the simulation.
        np.testing.assert_allclose(g[program.rows_of['dynamics']], 0.0, atol=1e-9)
        worst.append(np.abs(g[program.rows_of['collocation']]).max())
    # Kinematic rows fall by 2^5, the slope in the middle by 2^4 less rounding: at least 2^3.
    assert worst[1] < worst[0] / 8
    assert worst[1] < 1e-3


def test_phases_are_joined_by_the_impact_map(robot):
    model = planning_model(robot, friction=False)
    program = transcribe(model, Structure(('inner', 'outer'), (2, 2)))
    x = np.array([0.2, -0.2, 0.9, 0.4])
    z = np.zeros(program.size)
    at = program.offsets[2]
    z[at : at + 4] = x / UNITS[:4]
    after = impact(model, 'inner', x).x_plus
    z[program.offsets[3] : program.offsets[3] + 4] = after / UNITS[:4]
    g = np.array(program.functions()['nlp_g'](z, parameters(model, program.structure))).ravel()
    first = program.rows_of['landing'][0]
    # The gap to the next phase stands right before the landing row. Feet at one height are above
    # ground that falls by 0.03 rad, in tenths of m.
    np.testing.assert_allclose(g[first - 8 : first - 4], 0.0, atol=1e-12)
    reach = 2 * model.values['leg_length'] * np.sin(0.2)
    assert g[first] == pytest.approx(10 * reach * np.tan(0.03), abs=1e-12)
    assert g[program.rows_of['reach'][0]] == pytest.approx(reach - 0.1, abs=1e-12)


@pytest.mark.parametrize(
    ('arguments', 'message'),
    [
        ((('left',), (4,)), "'left' is not one of inner, outer"),
        ((('inner', 'inner'), (4, 4)), 'an impact changes the leg'),
        ((('inner',), (4, 4)), 'same number of entries'),
        ((('inner',), (1,)), 'needs at least 2'),
    ],
)
def test_nonsense_is_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        Structure(*arguments)
