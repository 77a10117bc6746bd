"""plan_walk: the file that it writes says how it was made, and what is refused."""

import numpy as np
import pytest

from cg_control import plan_walk
from cg_control.trees.routes import UPRIGHT, Routes
from cg_control.trees.tree import Tree
from cg_control.trees.tree_files import tree_path


@pytest.mark.evidence
@pytest.mark.slow
def test_a_tree_takes_in_the_first_champions_of_one_to_upright(robot, tmp_path, capsys):
    path, base = tmp_path / 'walk.npz', tree_path('compass_gait_mit')
    given = ['--speeds', '0.25', '--base', str(base), '--champions', '3', '--out', str(path)]
    assert plan_walk.main(given) == 0
    assert f'plan_walk: {path}: ' in capsys.readouterr().out
    tree, whole = Tree.load(path, robot), Tree.load(base, robot)
    assert tree.provenance['command'].endswith('--step 0.3 --base TREE --champions 3')
    assert tree.provenance['base'] == whole.provenance
    assert tree.champions.shape == (2, 3)
    # They are the same motions at other places.
    for kept, first in zip(tree.champions, whole.champions[:, :3], strict=True):
        np.testing.assert_array_equal(tree.nodes.x0[kept], whole.nodes.x0[first])
    homes = [(d.home, d.onto) for d in Routes.of(tree.nodes, tree.speeds).departures]
    assert sorted(homes) == [(UPRIGHT, 0), (UPRIGHT, 0), (0, UPRIGHT), (0, UPRIGHT)]


@pytest.mark.parametrize('given', [['--champions', '3'], ['--champions', '0', '--base', 'x.npz']])
def test_champions_are_those_of_a_base(given, tmp_path, capsys):
    assert plan_walk.main([*given, '--out', str(tmp_path / 'walk.npz')]) == 2
    assert 'must be 1 or more, and needs --base' in capsys.readouterr().err
