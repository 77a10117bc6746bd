"""The command that grows a tree."""

import numpy as np
import pytest

from cg_control.grow_tree import grow, main, upright_tree
from cg_control.nodes import ARRAYS
from cg_control.tree import Tree
from cg_dynamics.c_compiler import compiler

needs_compiler = pytest.mark.skipif(compiler() is None, reason='thousands of rollouts')


def test_upright_is_home_on_the_legs_that_are_asked_for(robot):
    assert upright_tree(robot).legs == ('inner', 'outer')
    tree = upright_tree(robot, ('outer',))
    assert tree.legs == ('outer',)
    assert np.isnan(tree.goal[0]).all()
    with pytest.raises(ValueError, match='legs is empty'):
        upright_tree(robot, ())


@needs_compiler
def test_a_tree_is_grown_and_written(robot, tmp_path, capsys):
    path = tmp_path / 'tree.npz'
    given = ['--goal', 'outer', '--samples', '20', '--seed', '4', '--workers', '1']
    assert main([*given, '--out', str(path)]) == 0
    assert f'grow_tree: {path}: ' in capsys.readouterr().out
    tree = Tree.load(path, robot)
    assert tree.legs == ('outer',)
    assert tree.provenance['command'] == 'grow_tree --goal outer --samples 20 --seed 4'
    assert tree.provenance['counts']['samples'] >= 20
    # No branch ends on the leg that is no goal, and the seed says what grows.
    assert (tree.nodes.stance[tree.nodes.planned < 0] == 1).all()
    assert len(tree.nodes) > 100
    again = grow(robot, 'outer', 20, 4, workers=2)
    for name in ARRAYS:
        np.testing.assert_array_equal(getattr(tree.nodes, name), getattr(again.nodes, name))


@pytest.mark.parametrize(
    ('given', 'said'),
    [
        (['--model', 'oak', '--out', 'x.npz'], "no model 'oak'"),
        (['--samples', '0', '--out', 'x.npz'], 'must be 1 or more'),
        (['--out', '/nowhere/x.npz'], 'there is no such directory'),
    ],
)
def test_what_cannot_be_grown_is_said_before(given, said, capsys):
    assert main(given) == 2
    assert said in capsys.readouterr().err
