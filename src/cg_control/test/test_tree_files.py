"""Trees by name and by path, what says which one is selected, and loading beside a loop."""

import dataclasses
import threading
import time

import numpy as np
import pytest

from cg_control.trees import tree_loader
from cg_control.trees.recovery import ReadyTree
from cg_control.trees.tree import Tree, TreeError
from cg_control.trees.tree_files import TreeSelection, tree_names, tree_path
from cg_control.trees.tree_loader import TreeLoader
from cg_description.paths import model_path
from cg_dynamics.model import Model

PATIENCE = 20.0  # s


def collected(loader):
    deadline = time.monotonic() + PATIENCE
    while (found := loader.collect()) is None:
        assert time.monotonic() < deadline
        time.sleep(0.001)
    return found


def test_the_tree_that_comes_along_is_of_the_nominal_robot(robot):
    assert 'compass_gait_mit' in tree_names()
    tree = Tree.load(tree_path('compass_gait_mit'), robot)
    assert tree.legs == ('inner', 'outer')
    assert len(tree.nodes) > 1000
    assert tree.provenance['command'].startswith('grow_tree --goal either')
    assert tree_path('compass_gait_mit').stat().st_size < 2_000_000


def test_a_file_comes_before_a_name(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / 'compass_gait_mit').write_bytes(b'mine')
    assert tree_path('compass_gait_mit').read_bytes() == b'mine'
    with pytest.raises(TreeError, match=r"no tree 'oak': there is no file .*compass_gait_mit"):
        tree_path('oak')


def test_a_selection_says_which_bytes_are_meant(robot, tmp_path):
    path = tmp_path / 'tree.npz'
    path.write_bytes(tree_path('compass_gait_mit').read_bytes())
    selection = TreeSelection.of(path)
    assert TreeSelection.from_text(selection.text()) == selection
    assert len(selection.load(robot).nodes) > 1000
    path.write_bytes(b'another one')
    with pytest.raises(TreeError, match='has changed since it was selected'):
        selection.load(robot)
    path.unlink()
    with pytest.raises(TreeError, match='No such file'):
        selection.load(robot)


@pytest.mark.parametrize('text', ['', '[]', '{"path": 3, "sha256": "x"}', '{"path": "x"}'])
def test_what_is_no_selection_is_refused(text):
    with pytest.raises(TreeError, match='selection'):
        TreeSelection.from_text(text)


def test_a_tree_is_loaded_beside_whoever_asks(robot, monkeypatch):
    """However long it takes, `collect` has an answer at once."""
    may_go_on = threading.Event()
    load = ReadyTree.of

    def slowly(tree, model, sample_time):
        assert may_go_on.wait(PATIENCE)
        return load(tree, model, sample_time)

    monkeypatch.setattr(tree_loader.ReadyTree, 'of', slowly)
    loader = TreeLoader(robot, robot, 0.002)
    loader.ask(TreeSelection.of(tree_path('compass_gait_mit')))
    assert loader.collect() is None
    may_go_on.set()
    found = collected(loader)
    assert len(found.tree.nodes) > 1000
    assert loader.collect() is None


def test_the_last_question_counts(robot, tmp_path):
    loader = TreeLoader(robot, robot, 0.002)
    loader.ask(TreeSelection(str(tmp_path / 'none.npz'), 'f' * 64))
    loader.ask(TreeSelection.of(tree_path('compass_gait_mit')))
    assert isinstance(collected(loader), ReadyTree)


def test_a_tree_of_another_robot_is_an_error_of_the_loader(robot):
    loader = TreeLoader(*[Model.load(model_path('compass_gait_flexible'))] * 2, 0.002)
    loader.ask(TreeSelection.of(tree_path('compass_gait_mit')))
    with pytest.raises(TreeError, match='grown for a model with hash'):
        collected(loader)


def test_all_that_following_takes_is_made_in_the_thread(robot):
    """What is worked out when it is first asked for would hold the loop up."""
    tree = Tree.load(tree_path('compass_gait_mit'), robot)
    fresh = dataclasses.replace(tree, nodes=dataclasses.replace(tree.nodes))
    ready = ReadyTree.of(fresh, robot)
    before = set(vars(ready.tree.nodes))
    x = np.array([0.2, 0.0, 0.0, 0.0])
    claim = ready.lookup.best(0, x)
    ready.tracker.begin(claim.node)
    ready.tracker.torque(0.0, 'inner', x)
    ready.tree.nodes.cost_to_go(claim.node, 0.0, x)
    assert float(ready.tree.nodes.to_go[claim.node]) >= 0.0
    assert set(vars(ready.tree.nodes)) == before
