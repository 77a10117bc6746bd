"""Following a tree live, rule by rule, and on the exact hybrid model."""

import dataclasses
import itertools
import math

import numpy as np
import pytest

from cg_control.balancing.balance import BalanceController, balance_gains
from cg_control.balancing.basin import shipped_basins
from cg_control.following.tracking import Tracker
from cg_control.grow_tree import BOX, LANDING
from cg_control.trees.growth import Grower, Region
from cg_control.trees.lookup import Claim, Lookup
from cg_control.trees.preview import Preview
from cg_control.trees.recovery import (
    FOLLOWING,
    OUTSIDE,
    ReadyTree,
    RecoverySettings,
    TreeController,
)
from cg_control.trees.tree import Tree
from cg_control.trees.tree_files import tree_path
from cg_dynamics.errors import SimulationError
from cg_dynamics.rig import STANCES
from cg_dynamics.rollout.compiler import compiler
from cg_dynamics.rollout.vector_code import WIDTH
from cg_dynamics.walking.hybrid import Walker

COMPILED = pytest.mark.skipif(compiler() is None, reason='hundreds of rollouts')
SAMPLE_NS = 2_000_000
INNER = 0
SEARCH = 9  # samples in which all candidates are tried, eight a sample


@pytest.fixture(scope='module')
def tree(robot) -> Tree:
    return Tree.load(tree_path('compass_gait_mit'), robot)


@pytest.fixture(scope='module')
def ready(tree, robot) -> ReadyTree:
    return ReadyTree.of(tree, robot)


@pytest.fixture(scope='module')
def gains(robot):
    return balance_gains(robot, RecoverySettings(), 0.002)


@pytest.fixture
def make(robot, ready, gains):
    def controller(**changes):
        settings = RecoverySettings(**{'preview': False} | changes)
        basins = shipped_basins(robot, gains, robot.torque_limit)
        found = TreeController(BalanceController(robot, settings, gains, basins), settings)
        found.take(ready)
        return found

    return controller


@pytest.fixture(scope='module')
def starts(tree):
    """Legs, states and nodes of what the tree claims outside its goals."""
    leg, x = Region(np.array(BOX)).draw(np.random.default_rng(11), 4000)
    node, depth = Lookup(tree.nodes).best_of_many(leg, x)
    away = np.einsum('bi,bij,bj->b', x, tree.goal[leg], x) > 1.0
    rows = np.flatnonzero((depth <= 1.0) & away)
    return leg[rows], x[rows], node[rows]


@pytest.fixture(scope='module')
def unclaimed(tree):
    """A state of the inner leg that no funnel holds."""
    leg, x = Region(np.array(BOX)).draw(np.random.default_rng(12), 4000)
    _, depth = Lookup(tree.nodes).best_of_many(leg, x)
    return x[np.flatnonzero((leg == INNER) & (depth > 10.0))[0]]


def tell(controller, tick, leg, x):
    return controller.step(tick * SAMPLE_NS, STANCES[leg], np.asarray(x, float))


def tell_until(controller, tick, leg, x, samples=SEARCH):
    """As `tell`, until it follows, as long as the search for a way home may take."""
    for k in range(samples):
        command = tell(controller, tick + k, leg, x)
        if command.mode == FOLLOWING:
            break
    return command


def test_it_follows_the_node_at_which_the_state_is_least_deep(make, starts, tree):
    for leg, x, node in zip(*(rows[:20] for rows in starts), strict=True):
        controller = make()
        command = tell(controller, 0, leg, x)
        assert command.mode == controller.mode == FOLLOWING
        assert controller.entered == controller.node == node
        assert controller.depth <= 1.0
        assert controller.to_go == pytest.approx(tree.nodes.to_go[node])
        nodes = tree.nodes
        assert nodes.compensate
        wanted = nodes.u0[node] - nodes.K[node] @ (x - nodes.x0[node])
        # What friction takes, 1.84 N m and the viscous part, is given back on top.
        assert abs(command.torque - np.clip(wanted, -40.0, 40.0)) < 8.0


def test_at_home_it_balances_and_out_of_the_basin_it_follows_again(make, starts):
    controller = make(hand_over=0.0)
    assert tell(controller, 0, INNER, [0.01, 0.0, 0.0, 0.0]).mode == 'balancing'
    alone = make(hand_over=0.0).balance.step(0, 'inner', np.array([0.01, 0.0, 0.0, 0.0]))
    assert tell(controller, 1, INNER, [0.01, 0.0, 0.0, 0.0]).torque == alone.torque
    assert (controller.node, controller.to_go) == (-1, 0.0)
    leg, x, _ = starts
    row = np.flatnonzero(leg == INNER)[0]
    assert tell(controller, 2, INNER, x[row]).mode == FOLLOWING


def test_it_leaves_the_basin_for_a_funnel_and_otherwise_late(make, tree, ready, monkeypatch):
    controller = make(patience=0.0)
    basin = controller.balance.basins['inner']
    edge, goal = basin.bounds[0], basin.bounds[-1]  # of the basin, and of the goal region in it
    just_out, far_out, between = (
        basin.modes.state(z, 0.0, 0.0, 0.0) for z in (1.05 * edge, 2.1 * edge, (edge + goal) / 2)
    )
    tell(controller, 0, INNER, np.zeros(4))
    assert tell(controller, 1, INNER, just_out).mode == FOLLOWING  # a funnel holds it
    # Back at home it balances again only in the goal region: this is the hysteresis.
    assert tell(controller, 2, INNER, between).mode == FOLLOWING
    assert tell(controller, 3, INNER, np.zeros(4)).mode == 'balancing'
    monkeypatch.setattr(ready.lookup, 'best', lambda leg, x: Claim(0, 5.0))
    assert tell(controller, 4, INNER, just_out).mode == 'balancing'
    assert tell(controller, 5, INNER, far_out).mode == OUTSIDE


@pytest.mark.parametrize(('out', 'samples'), [(1.05, 14), (2.1, 4), (4.0, 1)])
def test_it_leaves_the_basin_the_sooner_the_further_out_it_is(make, out, samples):
    """After patience / depth: 30 ms over out^2, in samples of 2 ms."""
    controller = make()
    basin = controller.balance.basins['inner']
    x = basin.modes.state(out * basin.bounds[0], 0.0, 0.0, 0.0)
    tell(controller, 0, INNER, np.zeros(4))
    modes = [tell(controller, 1 + k, INNER, x).mode for k in range(15)]
    assert modes[: samples - 1] == ['balancing'] * (samples - 1)
    assert modes[samples - 1] in (FOLLOWING, OUTSIDE)


@pytest.mark.parametrize('preview', [pytest.param(True, marks=COMPILED), False])
def test_noise_of_the_rates_does_not_drive_it_from_home(make, robot, preview):
    """At 0.1 rad/s balance alone stands; without patience the tree controller chatters."""
    for leg in range(2):
        found = noisy_modes(make(preview=preview), robot, leg)
        assert found == ['balancing'] * 1000
        found = noisy_modes(make(preview=preview, patience=0.0), robot, leg)
        assert sum(a != b for a, b in itertools.pairwise(found)) > 5


def noisy_modes(controller, robot, leg):
    """Modes of 2 s that begin upright, with white noise on the rates, or until the robot falls."""
    walker = Walker(robot, dataclasses.replace(LANDING, fall_angle=1.4), None)
    legs, x, modes = [walker.stand(stance) for stance in STANCES], np.zeros(4), []
    rng, noise = np.random.default_rng(7), np.zeros(4)
    for tick in range(1000):
        command = tell(controller, tick, leg, x + noise)
        modes.append(command.mode)
        then, x = walker.move(legs[leg], x, walker.inputs(command.torque), 0.002, tick * 0.002)
        leg = STANCES.index(then.stance)
        if abs(x[leg]) > 0.4:
            break
        noise[2:] = 0.1 * rng.standard_normal(2)
    return modes


def test_the_balance_controller_takes_the_torque_over(make, ready, starts):
    """What the law before asks for at this very state dies out: the torque does not jump."""
    controller, calm = make(hand_over=1.0), make(hand_over=1.0)
    leg, x, node = (rows[0] for rows in starts)
    tell(controller, 0, leg, x)
    home = np.full(4, 0.002)
    assert controller.mode == FOLLOWING
    wanted = Tracker(ready.tree.nodes, ready.preview.known, ready.tracker.settings, int(node))
    wanted.begin(int(node))
    wanted.torque(0.0, STANCES[leg], x)
    torque = wanted.torque(0.002, STANCES[leg], home)
    command = tell(controller, 1, leg, home)
    assert command.mode == 'balancing'
    assert command.torque == pytest.approx(torque)
    assert abs(torque) > 5.0
    assert tell(calm, 1, leg, home).torque == pytest.approx(0.0)


def test_outside_every_funnel_there_is_no_torque_until_one_holds_the_state(
    make, starts, unclaimed
):
    controller = make()
    command = tell(controller, 0, INNER, unclaimed)
    assert (command.torque, command.mode) == (0.0, OUTSIDE)
    assert 'outside every funnel: depth' in command.reason
    assert controller.to_go == math.inf
    leg, x, node = starts
    row = np.flatnonzero(leg == INNER)[0]
    assert tell(controller, 1, INNER, x[row]).mode == FOLLOWING
    assert controller.entered == node[row]
    # It may be on its way home all the same: the torque ends when `patience` is over.
    ticks = round(controller.settings.patience * 1e9 / SAMPLE_NS)
    modes = [tell(controller, 2 + k, INNER, unclaimed).mode for k in range(ticks + 1)]
    assert modes[: ticks - 1] == [FOLLOWING] * (ticks - 1)
    assert modes[-1] == OUTSIDE
    assert controller.entered == -1


def at_depth(tree, node, direction, depth):
    """A state so deep in the funnel of a node."""
    F, rho = tree.nodes.F[node], tree.nodes.rho[node]
    return tree.nodes.x0[node] + direction * np.sqrt(depth * rho / (direction @ F @ direction))


@pytest.fixture(scope='module')
def edge(tree):
    """A node and a direction that leads out of its funnel and into no other one."""
    nodes, lookup = tree.nodes, Lookup(tree.nodes)
    rng = np.random.default_rng(3)
    for node in rng.permutation(np.flatnonzero((nodes.rho > 0) & (nodes.span > 0))):
        direction = rng.standard_normal(4)
        leg = int(nodes.stance[node])
        inside, outside = (at_depth(tree, node, direction, depth) for depth in (0.96, 1.04))
        if (np.abs(outside[:2]) < 0.5).all() and outside @ tree.goal[leg] @ outside > 1.5:
            claim = lookup.best(leg, inside)
            if claim.node == node and lookup.best(leg, outside).depth > 1.0:
                return int(node), direction, leg
    raise AssertionError('no such node')


@pytest.mark.parametrize(('settings', 'changes'), [({}, 0), ({'hold': 1.0, 'patience': 0.0}, 20)])
def test_noise_at_the_edge_of_a_funnel_changes_nothing(make, tree, edge, settings, changes):
    """With a hold of 1 and no patience there is no hysteresis, and the mode chatters."""
    node, direction, leg = edge
    controller, modes = make(**settings), []
    for tick in range(40):
        # Stamps hardly move on, so that the reference stays.
        x = at_depth(tree, node, direction, 0.96 if tick % 2 == 0 else 1.04)
        modes.append(controller.step(1000 * tick, STANCES[leg], x).mode)
    assert modes[0] == FOLLOWING
    found = sum(a != b for a, b in itertools.pairwise(modes))
    assert found >= changes if changes else found == 0


def rivals(tree, nearer):
    """A node and a state 0.8 deep there, which another node, nearer to home or not, holds better.

    Returns:
        The node, the better claim, the leg and the state.
    """
    nodes, lookup = tree.nodes, Lookup(tree.nodes)
    rng = np.random.default_rng(4)
    for node in rng.permutation(np.flatnonzero((nodes.rho > 0) & (nodes.span > 0))):
        leg = int(nodes.stance[node])
        x = at_depth(tree, node, rng.standard_normal(4), 0.8)
        best = lookup.best(leg, x)
        sooner = nodes.to_go[node] - nodes.to_go[best.node]
        if (
            best.depth < 0.3 and (sooner > 0.1 if nearer else sooner < -0.1)
            and x @ tree.goal[leg] @ x > 1.5 and (np.abs(x[:2]) < 0.5).all()
        ):  # fmt: skip
            return int(node), best, leg, x
    raise AssertionError('no such node')


@pytest.mark.parametrize(
    ('margin', 'nearer', 'goes'), [(0.4, True, True), (2.0, True, False), (0.4, False, False)]
)
def test_it_goes_over_only_if_it_is_less_deep_there_and_home_is_not_further(
    make, ready, tree, margin, nearer, goes
):
    node, best, leg, x = rivals(tree, nearer)
    controller = make(margin=margin)
    controller.mode = FOLLOWING
    ready.tracker.begin(node)
    tell(controller, 0, leg, x)
    assert controller.switches == goes
    assert (controller.node == best.node) == goes


def test_a_landing_that_nobody_planned_is_looked_up(make, ready, tree, starts):
    leg, x, node = starts
    row = np.flatnonzero(leg == INNER)[0]
    controller = make()
    controller.mode = FOLLOWING
    ready.tracker.begin(int(np.flatnonzero((tree.nodes.stance == 1) & (tree.nodes.landing < 0)
                                           & (tree.nodes.span > 0))[0]))  # fmt: skip
    assert tell(controller, 0, INNER, x[row]).mode == FOLLOWING
    assert controller.entered == node[row]


@pytest.mark.parametrize(
    ('x', 'stance', 'reason'),
    [
        ([0.0, np.nan, 0.0, 0.0], 'inner', 'not finite'),
        ([0.7, 0.0, 0.0, 0.0], 'inner', 'leaning by 0.7 rad'),
        ([0.0, 3.1, 0.0, 0.0], 'inner', 'swing leg at 3.1 rad'),
        ([0.0, 0.0, 0.0, 0.0], 'middle', "stance is 'middle'"),
    ],
)
def test_a_state_that_is_none_gets_no_torque(make, starts, x, stance, reason):
    controller = make()
    tell(controller, 0, int(starts[0][0]), starts[1][0])
    command = controller.step(SAMPLE_NS, stance, np.array(x))
    assert (command.torque, command.mode) == (0.0, OUTSIDE)
    assert reason in command.reason
    assert tell(controller, 2, INNER, np.zeros(4)).mode == 'balancing'


def test_disarmed_or_without_a_tree_it_is_idle(make):
    controller = make(armed=False)
    assert tell(controller, 0, INNER, np.zeros(4)) == dataclasses.replace(
        tell(controller, 1, INNER, np.zeros(4)), torque=0.0, mode='idle', reason='not armed'
    )
    controller.adopt(RecoverySettings())
    controller.balance.adopt(RecoverySettings())
    assert tell(controller, 2, INNER, np.zeros(4)).mode == 'balancing'
    controller.take(None)
    assert tell(controller, 3, INNER, np.zeros(4)).reason == 'no tree'


def test_after_an_interruption_it_looks_up_again(make, starts):
    controller = make()
    leg, x, node = starts
    tell(controller, 0, leg[0], x[0])
    controller.interrupt()
    assert (controller.mode, controller.node) == ('idle', -1)
    tell(controller, 500, leg[0], x[0])
    assert controller.node == node[0]


def comes_home(controller, robot, leg, x, push=None):
    """Whether the exact hybrid robot balances for the last second of 4 s."""
    # A fall is for the test to see: the guard of a fall that is seen again and again never ends.
    walker = Walker(robot, dataclasses.replace(LANDING, fall_angle=1.4), None)
    legs = [walker.stand(stance) for stance in STANCES]
    calm = 0
    for tick in range(2000):
        if tick == 0 and push is not None:
            x = x + push
        command = tell(controller, tick, leg, x)
        calm = calm + 1 if command.mode == 'balancing' else 0
        try:
            then, x = walker.move(legs[leg], x, walker.inputs(command.torque), 0.002, tick * 0.002)
        except SimulationError:
            return False
        leg = STANCES.index(then.stance)
        if calm > 500 or abs(x[leg]) > 1.0:
            break
    return calm > 500


@COMPILED
def test_it_brings_home_what_the_tree_brings_home(make, robot, tree, starts):
    """As many as the rollouts that the tree was grown by, from the same starts."""
    leg, x, node = (rows[:60] for rows in starts)
    grower = Grower(robot, tree, Region(np.array(BOX)), lambda *_: [], simulation=LANDING)
    claimed = grower.bring_home(node, x, learn=False)
    home = np.array([
        comes_home(make(preview=True), robot, int(leg[k]), x[k]) for k in range(len(leg))
    ])  # fmt: skip
    assert claimed.sum() > 45
    # Of robots that come home only just, one or the other falls: 3 of 279 in bench/trees_live.py.
    assert home.sum() >= claimed.sum() - 2
    assert (claimed & ~home).sum() <= 3


@COMPILED
def test_a_push_that_balance_alone_does_not_survive_is_answered_by_a_step(make, robot):
    x, push = np.zeros(4), np.array([0.0, 0.0, 0.8, 0.8])  # both legs turn about the foot
    assert not comes_home(make().balance, robot, INNER, x, push)
    assert comes_home(make(preview=True), robot, INNER, x, push)


@pytest.fixture(scope='module')
def promised(tree, robot):
    """Legs and states that no funnel holds, deep outside, and the entries that bring them home."""
    leg, x = Region(np.array(BOX)).draw(np.random.default_rng(13), 6000)
    _, depth = Lookup(tree.nodes).best_of_many(leg, x)
    outside = np.flatnonzero(depth > 4.0)
    leg, x = leg[outside], x[outside]
    entry = Preview(tree, robot).choose(leg, x)
    found = entry >= 0
    return leg[found], x[found], entry[found]


@COMPILED
def test_what_no_funnel_holds_is_previewed(make, promised, unclaimed):
    for leg, x, entry in zip(*(rows[:10] for rows in promised), strict=True):
        assert tell(make(), 0, leg, x).mode == OUTSIDE
        controller = make(preview=True)
        assert tell_until(controller, 0, leg, x).mode == FOLLOWING
        assert controller.entered == controller.node == entry


@COMPILED
def test_a_sample_simulates_a_register_full_at_most(make, ready, promised, monkeypatch):
    """Who comes home by a late candidate is found at a later sample, from its state then."""
    leg, x, entry = promised
    asked, simulate = [], ready.preview.brings_home
    monkeypatch.setattr(
        ready.preview, 'brings_home', lambda node, *rest: asked.append(len(node))
        or simulate(node, *rest),
    )  # fmt: skip
    late = 0
    for k in range(len(leg)):
        tried = ready.preview.candidates(leg[k : k + 1], x[k : k + 1])[0]
        place = int(np.flatnonzero(tried[tried >= 0] == entry[k])[0])
        controller, before = make(preview=True), len(asked)
        # At home at first: it goes on balancing while it looks for something better.
        tell(controller, 0, leg[k], np.zeros(4))
        for tick in range(place // WIDTH):
            assert tell(controller, 1 + tick, leg[k], x[k]).mode == 'balancing'
        assert tell(controller, 1 + place // WIDTH, leg[k], x[k]).mode == FOLLOWING
        assert controller.entered == entry[k]
        assert len(asked) - before == 1 + place // WIDTH
        late += place >= WIDTH
    assert late > 2
    assert max(asked) == WIDTH


@COMPILED
def test_previews_hold_the_torque_for_as_long_as_the_loop_does(make, tree, robot, promised):
    """At 40 ms some do not come home whom 2 ms promise it."""
    leg, x, _ = promised
    slow = ReadyTree.of(tree, robot, sample_time=0.04)
    kept = slow.preview.choose(leg, x) >= 0
    assert 0.5 < kept.mean() < 1.0
    for k in np.flatnonzero(~kept):
        controller = make(preview=True)
        assert tell_until(controller, 0, leg[k], x[k]).mode == FOLLOWING
        controller.take(slow)
        controller.adopt(controller.settings)  # takes over its angles, not the sample time
        assert tell_until(controller, SEARCH, leg[k], x[k]).mode == OUTSIDE


@COMPILED
def test_nothing_is_followed_where_nothing_comes_home(make):
    falling = np.array([-0.45, -0.3, -1.4, 0.0])  # backward, faster than any torque brakes
    controller = make(preview=True)
    for tick in range(50):
        command = tell(controller, tick, INNER, falling)
        assert (command.torque, command.mode) == (0.0, OUTSIDE)
    # 64 candidates, 8 a sample, and anew 10 ms later: 8 of every 12 samples.
    assert len(controller.preview_times) == 34


@COMPILED
def test_a_way_that_leads_home_is_not_left(make, promised):
    """The state is deep outside every funnel, at every sample."""
    leg, x, entry = (rows[0] for rows in promised)
    controller = make(preview=True, preview_period=0.001)
    for tick in range(5):
        assert controller.step(1000 * tick, STANCES[leg], x).mode == FOLLOWING
    controller.step(2_000_000, STANCES[leg], x)
    assert len(controller.preview_times) == 2
    assert (controller.switches, controller.entered) == (0, entry)


@COMPILED
def test_a_way_that_fails_is_left_after_patience(make, promised):
    leg, x, _ = (rows[0] for rows in promised)
    controller = make(preview=True, patience=0.03)
    tell(controller, 0, leg, x)
    x = np.roll(np.array([-0.45, -0.3, -1.4, 0.0]).reshape(2, 2), leg, axis=1).ravel()
    modes = [tell(controller, tick, leg, x).mode for tick in range(5, 30)]
    assert modes.count(FOLLOWING) == 10  # until 30 ms after the start
    assert modes[-1] == OUTSIDE


@pytest.mark.evidence
@COMPILED
def test_it_brings_home_what_a_preview_promises(make, robot, promised):
    leg, x, _ = (rows[:20] for rows in promised)
    home = {
        preview: sum(
            comes_home(make(preview=preview), robot, int(leg[k]), x[k]) for k in range(20)
        )
        for preview in (True, False)
    }
    # The balance controller takes over in the end, which previews do not simulate.
    assert home[True] >= 19
    assert home[False] <= 10


@COMPILED
def test_what_would_not_be_followed_is_not_promised(make, promised):
    """The same limits hold for previews and for the robot."""
    leg, x, _ = (rows[:20] for rows in promised)
    modes = {
        swing: [
            tell_until(make(preview=True, largest_swing=swing), 0, int(leg[k]), x[k]).mode
            for k in range(20)
        ]
        for swing in (2.0, 1.05)
    }
    assert modes[2.0].count(FOLLOWING) == 20
    assert modes[1.05].count(FOLLOWING) < 15
