"""A pendulum that swings up: motions against another integration, and the tree that they grow."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from cg_control.following.nodes import ARRAYS
from cg_control.trees.growth import Grower, GrowthOptions, Region
from cg_control.trees.lookup import Lookup
from cg_control.trees.preview import AT_HOME
from cg_control.trees.rollouts import Outcome, follow
from cg_control.trees.swing_up import SwingOptions, SwingUp, upright_root, whole_turns
from cg_description.paths import model_path
from cg_dynamics.model import Model
from cg_dynamics.rollout.compiler import compiler
from cg_dynamics.walking.hybrid import WalkOptions

PENDULUM = Model.load(model_path('tedrake_pendulum'))
SWING = SwingOptions(Q=np.diag([10.0, 1.0]), R=15.0, intervals=20)
TURNS = whole_turns(joint=0, nx=2, most=1)
REGION = Region(np.array([np.pi, 6.0]), legs=1)  # rad, rad/s
GROWTH = GrowthOptions(seed=1, round_size=32, at_once=1, dense=10**9, tolerated=0.0)
SIMULATION = WalkOptions(sample_time=0.002, step=0.002, fall_angle=np.inf)


def rates(x, u):
    """1 kg at 0.5 m, 0.1 N m s/rad, angle from upright: written out here once more."""
    return np.array([x[1], (u + 4.9 * np.sin(x[0]) - 0.1 * x[1]) / 0.25])


@pytest.fixture(scope='module')
def swing_up():
    return SwingUp(PENDULUM, SWING, TURNS)


def planted(swing_up) -> Grower:
    return Grower(
        PENDULUM, upright_root(PENDULUM, SWING), REGION, swing_up, GROWTH,
        simulation=SIMULATION, turns=TURNS,
    )  # fmt: skip


@pytest.fixture(scope='module')
def grown(swing_up):
    if compiler() is None:
        pytest.skip('no C compiler: thousands of rollouts would take too long')
    grower = planted(swing_up)
    for _ in range(16):
        grower.round()
    return grower


def home(nodes, goal, node, x) -> np.ndarray:
    done = follow(
        nodes, PENDULUM, node, x, nodes.to_go[node] + AT_HOME, goal=goal, options=SIMULATION
    )
    return done.outcome == Outcome.ARRIVED


@pytest.mark.parametrize('start', [[np.pi, 0.0], [2.0, -7.0], [-1.0, -5.0]])
def test_a_motion_is_one_of_the_pendulum_and_ends_upright(swing_up, start):
    motion = swing_up.plan(np.array(start))
    (phase,) = motion.phases
    turns = (phase.states[0] - start) / (2 * np.pi)
    np.testing.assert_allclose(turns, [round(turns[0]), 0.0], atol=1e-9)
    np.testing.assert_allclose(phase.states[-1], 0.0, atol=1e-9)
    assert np.abs(phase.torque).max() <= (1 - SWING.spare) * 3.0 + 1e-6

    def pushed(t, x):
        return rates(x, np.interp(t, phase.time, phase.torque))

    # Interval by interval: over the whole motion the upright equilibrium blows errors up.
    for k in range(len(phase.time) - 1):
        span = phase.time[k], phase.time[k + 1]
        end = solve_ivp(pushed, span, phase.states[k], rtol=1e-10, atol=1e-12).y[:, -1]
        # Twenty intervals of fourth order.
        np.testing.assert_allclose(end, phase.states[k + 1], atol=5e-3)


def test_it_swings_before_it_comes_up(swing_up):
    """3 N m do not lift it from hanging: it passes the bottom at least once."""
    angle = swing_up.plan(np.array([np.pi, 0.0])).phases[0].states[:, 0]
    below = np.sign(np.sin(angle[1:-1]))
    assert (below[1:] != below[:-1]).any()


def test_gains_end_in_those_of_the_root(swing_up):
    tree = upright_root(PENDULUM, SWING)
    (branch,) = swing_up(tree.nodes, np.zeros(1, int), np.array([[2.0, -7.0]]))
    (phase,) = branch.trajectory.phases
    np.testing.assert_allclose(phase.gains[-1], tree.nodes.K[0], rtol=1e-9)
    np.testing.assert_allclose(branch.funnels[0][-1], tree.nodes.F[0])
    assert (np.linalg.eigvalsh(branch.funnels[0]) > 0).all()


def test_the_goal_region_is_where_the_regulator_brings_it_home_within_the_limit():
    tree = upright_root(PENDULUM, SWING)
    angle = np.linspace(0.0, 2 * np.pi, 400)
    edge = np.linalg.solve(
        np.linalg.cholesky(tree.goal[0]).T, np.array([np.cos(angle), np.sin(angle)])
    ).T
    assert np.abs(edge[:, 0]).max() > 0.5
    assert np.abs(edge @ tree.nodes.K[0]).max() <= 3.0
    start = np.zeros(400, int)
    later = follow(tree.nodes, PENDULUM, start, edge, 20.0, options=SIMULATION).state
    assert np.abs(later).max() < 1e-3
    soon = follow(tree.nodes, PENDULUM, start, edge, 0.5, options=SIMULATION).state
    assert (np.einsum('ni,ij,nj->n', soon, tree.goal[0], soon) < 1.0).all()


def test_a_tree_brings_the_pendulum_up_from_anywhere(grown):
    side = (np.arange(20) + 0.5) / 10 - 1
    x = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2) * REGION.half
    lookup = Lookup(grown.nodes, TURNS)
    node, depth = lookup.best_of_many(np.zeros(len(x), int), x)
    claimed = depth <= 1.0
    true = home(grown.nodes, grown.tree.goal, node[claimed], lookup.turned(node, x)[claimed])
    assert true.sum() > 0.95 * len(x)
    assert grown.counts.grown < 20
    # Its regulator alone does not.
    root = np.zeros(len(x), int)
    assert home(grown.nodes, grown.tree.goal, root, x).mean() < 0.5


def test_a_seed_says_what_grows(swing_up, grown):
    again = planted(swing_up)
    for _ in range(grown.rounds):
        again.round()
    for name in ARRAYS:
        np.testing.assert_array_equal(getattr(again.nodes, name), getattr(grown.nodes, name))


def test_a_whole_turn_is_no_other_state(grown):
    x = np.random.default_rng(3).uniform(-1.0, 1.0, (50, 2)) * REGION.half
    x[:, 0] = np.abs(x[:, 0])  # minus a turn is within the turns that are looked at
    lookup, leg = Lookup(grown.nodes, TURNS), np.zeros(50, int)
    plain = Lookup(grown.nodes)
    best = lookup.best_of_many(leg, x)[1]
    each = [plain.best_of_many(leg, x + turn)[1] for turn in (0.0, *TURNS)]
    np.testing.assert_array_equal(best, np.min(each, axis=0))
    node = plain.best_of_many(leg, x)[0]
    away = (lookup.turned(node, x + TURNS[0]) - x)[:, 0]
    np.testing.assert_allclose(away, 2 * np.pi * np.round(away / (2 * np.pi)), atol=1e-12)
    np.testing.assert_array_equal(plain.turned(node, x), x)


def test_two_inputs_are_refused():
    with pytest.raises(ValueError, match="'dfki_double_pendulum' has 2 inputs; one is allowed"):
        SwingUp(Model.load(model_path('dfki_double_pendulum')), SWING)
