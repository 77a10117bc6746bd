"""The file of a tree: it comes back whole, and every kind of damage is named."""

import io
import zipfile

import numpy as np
import pytest

from cg_control.following.nodes import ARRAYS, Nodes
from cg_control.trees import tree as module
from cg_control.trees.tree import Tree, TreeError
from cg_description.paths import model_path
from cg_dynamics.model import Model


@pytest.fixture(scope='module')
def grown(robot, step, back) -> Tree:
    forth = Nodes.of(step, robot)
    nodes = forth.grafted(back, robot, forth.first)
    goal = np.array([np.full((4, 4), np.nan), 25.0 * np.eye(4)])
    return Tree(nodes, goal, {'seed': 3}, np.array([[forth.first, -1], [nodes.first, 0]]))


def rewritten(grown, path, **changes):
    """The file of a tree with other arrays."""
    arrays = grown.arrays()
    grown.save(path)
    with zipfile.ZipFile(path) as archive:
        header = archive.read('header.npy')
    file = io.BytesIO()
    np.savez(file, **(arrays | changes))
    with zipfile.ZipFile(file, 'a') as archive:
        archive.writestr('header.npy', header)
    path.write_bytes(file.getvalue())
    return path


def test_a_tree_comes_back_to_the_bit(grown, robot, tmp_path):
    grown.save(tmp_path / 'tree.npz')
    back = Tree.load(tmp_path / 'tree.npz', robot)
    for name in ARRAYS:
        np.testing.assert_array_equal(getattr(back.nodes, name), getattr(grown.nodes, name))
    np.testing.assert_array_equal(back.goal, grown.goal)
    np.testing.assert_array_equal(back.champions, grown.champions)
    assert back.provenance == {'seed': 3}
    assert back.legs == ('outer',)


def test_a_tree_of_another_model_is_refused(grown, tmp_path):
    grown.save(tmp_path / 'tree.npz')
    other = Model.load(model_path('compass_gait_flexible'))
    with pytest.raises(TreeError, match='grown for a model with hash'):
        Tree.load(tmp_path / 'tree.npz', other)


@pytest.mark.parametrize(
    ('name', 'change', 'said'),
    [
        ('next', lambda a: np.where(a >= 0, a + 100000, a), 'next must be -1 to'),
        ('next', lambda a: np.zeros_like(a), 'span must be infinite'),
        ('landing', lambda a: a - 5, 'landing must be'),
        ('stance', lambda a: a + 2, 'stance must be'),
        ('stance', lambda a: 1 - a, 'a leg that is no goal'),
        ('x0', lambda a: a * np.nan, 'x0 must be finite'),
        ('K', lambda a: a[:-1], 'K has shape'),
        ('F', lambda a: a[:, :3], 'F has shape'),
        ('rho', lambda a: a - 1e9, 'rho must not be negative'),
        ('rho', lambda a: np.full(a.shape, 'x'), 'rho holds'),
        ('span', lambda a: a * np.nan, 'span must be finite'),
        ('goal', lambda a: a * np.nan, 'goal must be positive definite'),
        ('goal', lambda a: -a, 'goal must be positive definite'),
        ('goal', lambda a: np.where(a == 0, 1e308, a), 'goal must be positive definite'),
        ('goal', lambda a: a[:1], 'goal has shape'),
        ('u0', lambda a: np.array(1.0), 'u0 holds'),
        ('champions', lambda a: a * 1.0, 'champions holds'),
        ('champions', lambda a: a[:1], 'champions has shape'),
        ('champions', lambda a: a + 100000, 'champions must be -1 to'),
        ('champions', lambda a: a[::-1], 'champions of the inner leg must be entries'),
        ('champions', lambda a: np.where(a >= 0, a + 1, a), 'leg must be entries on that leg'),
    ],
)
def test_what_is_no_tree_is_named(grown, tmp_path, name, change, said):
    path = rewritten(grown, tmp_path / 'tree.npz', **{name: change(grown.arrays()[name])})
    with pytest.raises(TreeError, match=said):
        Tree.load(path)


def test_a_way_round_and_round_is_refused(grown, tmp_path):
    following = grown.nodes.next.copy()
    first = grown.nodes.first
    following[first + 3] = first  # the same leg, and a span as before
    path = rewritten(grown, tmp_path / 'tree.npz', next=following)
    with pytest.raises(TreeError, match='never home'):
        Tree.load(path)


def test_objects_are_never_unpacked(grown, tmp_path):
    bad = np.array([{'a': 1}] * len(grown.nodes), dtype=object)
    with pytest.raises(TreeError, match='damaged'):
        Tree.load(rewritten(grown, tmp_path / 'tree.npz', rho=bad))


def test_damaged_bytes_give_one_error(grown, tmp_path):
    path = tmp_path / 'tree.npz'
    grown.save(path)
    whole, rng = path.read_bytes(), np.random.default_rng(0)
    named = []
    for _ in range(150):
        damaged = bytearray(whole)
        for place in rng.integers(0, len(whole), rng.integers(1, 4)):
            damaged[place] ^= 1 << int(rng.integers(8))
        cut = int(rng.integers(1, len(whole))) if rng.random() < 0.2 else len(whole)
        path.write_bytes(bytes(damaged[:cut]))
        try:
            Tree.load(path)
        except TreeError as error:
            named.append(str(error))
    assert len(named) > 100
    assert all(text.startswith(f'{path}: ') for text in named)


def test_what_unpacks_to_too_much_is_refused(grown, tmp_path, monkeypatch):
    grown.save(tmp_path / 'tree.npz')
    monkeypatch.setattr(module, 'LARGEST_FILE', 1000)
    with pytest.raises(TreeError, match='bytes unpacked; allowed are 1000'):
        Tree.load(tmp_path / 'tree.npz')


def test_a_missing_file_and_another_archive_are_named(tmp_path):
    with pytest.raises(TreeError, match='No such file'):
        Tree.load(tmp_path / 'none.npz')
    np.savez(tmp_path / 'other.npz', a=np.zeros(3))
    with pytest.raises(TreeError, match='is missing'):
        Tree.load(tmp_path / 'other.npz')
