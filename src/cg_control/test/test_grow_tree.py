"""The command that grows a tree."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from small_growth import ROUND, assert_same, make_small

from cg_control.following.tracking import TrackingSettings
from cg_control.grow_tree import BOX, GROWTH, LANDING, REGION, Growing, grow, main, upright_tree
from cg_control.trees.checkpoint import Checkpoint
from cg_control.trees.extension import Extension, ExtensionOptions
from cg_control.trees.growth import Counts, Grower, Region
from cg_control.trees.lookup import Lookup
from cg_control.trees.rollouts import Outcome, follow
from cg_control.trees.tree import Tree
from cg_dynamics.rollout.compiler import compiler

needs_compiler = pytest.mark.skipif(compiler() is None, reason='thousands of rollouts')


def test_upright_is_home_on_the_legs_that_are_asked_for(robot):
    assert upright_tree(robot).legs == ('inner', 'outer')
    tree = upright_tree(robot, ('outer',))
    assert tree.legs == ('outer',)
    assert np.isnan(tree.goal[0]).all()
    with pytest.raises(ValueError, match='legs is empty'):
        upright_tree(robot, ())


@needs_compiler
@pytest.mark.parametrize(
    ('goal', 'leg'),
    [
        ('inner', 0),
        pytest.param('outer', 1, marks=pytest.mark.evidence),
    ],
)
def test_a_tree_to_one_leg_is_grown_and_written(robot, tmp_path, capsys, monkeypatch, goal, leg):
    make_small(monkeypatch)
    path = tmp_path / 'tree.npz'
    given = ['--goal', goal, '--samples', '120', '--seed', '4', '--workers', '1']
    assert main([*given, '--out', str(path)]) == 0
    assert f'grow_tree: {path}: ' in capsys.readouterr().out
    assert list(tmp_path.iterdir()) == [path]
    tree = Tree.load(path, robot)
    assert tree.legs == (goal,)
    command = f'grow_tree --goal {goal} --samples 120 --seed 4 --branches 0'
    assert tree.provenance['command'] == command
    assert tree.provenance['counts']['samples'] == 2 * ROUND
    nodes = tree.nodes
    assert len(nodes) > 100
    # Every way ends on that leg, with a step where the other one stands.
    at = np.arange(len(nodes))
    while (nodes.planned[at] >= 0).any():
        at = np.where(nodes.planned[at] >= 0, nodes.planned[at], at)
    assert (nodes.stance[at] == leg).all()
    assert (nodes.steps[nodes.stance != leg] == 1).all()
    assert set(nodes.stance) == {0, 1}
    # So it does for robots: who is home stands on that leg.
    rng = np.random.default_rng(0)
    stance, x = Region(np.array(BOX)).draw(rng, 1500)
    node, depth = Lookup(nodes).best_of_many(stance, x)
    claimed = depth <= 1.0
    done = follow(nodes, robot, node[claimed], x[claimed], nodes.to_go[node[claimed]] + 3.0,
                  goal=tree.goal, settings=TrackingSettings(), options=LANDING)  # fmt: skip
    home = done.outcome == Outcome.ARRIVED
    assert home.sum() > 90
    assert (done.stance[home] == leg).all()
    # The seed says what grows.
    assert_same(grow(robot, goal, 120, 4), tree)


def test_the_progress_tells_the_coverage_of_the_last_rounds():
    grower = SimpleNamespace(counts=Counts(samples=640, grown=31), nodes=range(900))
    growing = Growing(grower, 1000)
    assert str(growing).endswith('640 of 1000 states done, 360 left; 31 branches, 900 nodes')
    growing.count(Counts(samples=64, covered=0, grown=20))
    for covered, grown in ((10, 10), (15, 5), (15, 5), (20, 0), (20, 0)):
        growing.count(Counts(samples=64, covered=covered, grown=grown, unclaimed=40))
    assert str(growing).endswith(
        'nodes; of the last 320 states 100 can be brought home, as far as is known, and the tree '
        'brought home 80 % of these by itself'
    )
    grower.counts.given_up = 2
    assert ', 900 nodes, 2 states given up; of' in str(growing)


def test_a_checkpoint_is_gone_on_from_only_with_the_same_command(robot, tmp_path, capsys):
    path, part = tmp_path / 'tree.npz', tmp_path / 'tree.npz.part'
    grower = Grower(
        robot, upright_tree(robot), REGION, Extension(robot), replace(GROWTH, seed=3),
        simulation=LANDING,
    )  # fmt: skip
    grower.counts.samples, grower.rounds = 4 * GROWTH.round_size, 4
    Checkpoint.of(grower, goal='either', extension=ExtensionOptions()).save(part)
    given = ['--workers', '1', '--out', str(path), '--samples', '2048', '--seed']
    for words, said in (
        ([*given, '4'], f'{part}: begun with growth.seed 3, now it is 4; go on as it was begun'),
        ([*given, '3', '--goal', 'inner'], f"{part}: begun with goal 'either', now it is 'inner'"),
        ([*given, '3', '--samples', '50'], f'{part}: 2048 states are drawn already, but asked'),
        ([*given, '3', '--model', 'compass_gait_flexible'], f'{part}: the tree was grown for a'),
    ):
        assert main(words) == 2
        assert capsys.readouterr().err.startswith(f'grow_tree: {said}')
    assert not path.exists()
    # As many states as are asked for are drawn: what is left is to write the tree.
    assert main([*given, '3']) == 0
    assert f'goes on from {part}: 2048 of 2048 states are done' in capsys.readouterr().err
    assert path.exists()
    assert not part.exists()
    part.write_bytes(b'no archive')
    assert main([*given, '3']) == 2
    assert capsys.readouterr().err.startswith(f'grow_tree: {part}: not a tree that grows, or dama')


@pytest.mark.parametrize(
    ('given', 'said'),
    [
        (['--model', 'oak', '--out', 'x.npz'], "no model 'oak'"),
        (['--samples', '0', '--out', 'x.npz'], 'must be 1 or more'),
        (['--workers', '0', '--out', 'x.npz'], 'must be 1 or more'),
        (['--limit', '0', '--out', 'x.npz'], '--limit is 0 s; it must be positive and finite'),
        (['--out', '/nowhere/x.npz'], 'there is no such directory'),
        (['--out', 'x.npz', '--checkpoint', '/nowhere/x'], 'there is no such directory'),
        (['--out', 'x.npz', '--checkpoint', 'x.npz'], 'must be two files'),
        (['--out', 'x.npz', '--workers', '2', '--scheduler', 'tcp://h:1'], 'leave it out where'),
    ],
)
def test_what_cannot_be_grown_is_said_before(given, said, capsys):
    assert main(given) == 2
    assert said in capsys.readouterr().err
