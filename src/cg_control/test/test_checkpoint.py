"""Growth that is stopped, or killed, and goes on: the same tree to the bit as in one go."""

import io
import os
import signal
import time
import zipfile
from dataclasses import replace

import numpy as np
import pytest
from small_growth import BOX, ROUND, assert_same, make_small, started

from cg_control import grow_tree
from cg_control.following.tracking import TrackingSettings
from cg_control.trajectories.tvlqr import Weights
from cg_control.trees.checkpoint import LEVELS, Checkpoint, Keeper, told
from cg_control.trees.extension import Extension, ExtensionOptions
from cg_control.trees.growth import Grower, GrowthOptions, Region
from cg_control.trees.tree import Tree, TreeError
from cg_description.paths import model_path
from cg_dynamics.model import Model
from cg_dynamics.rollout.compiler import compiler

pytestmark = [
    pytest.mark.skipif(compiler() is None, reason='thousands of rollouts'),
    pytest.mark.xdist_group('checkpoint'),
]

LONG = 120.0  # s; whatever takes longer hangs
SAMPLES, SEED = 4 * ROUND, 5
OPTIONS = GrowthOptions(seed=SEED, round_size=ROUND, at_once=16)


@pytest.fixture(scope='module')
def extension(robot) -> Extension:
    return Extension(robot)


def begun(robot, extension, options=OPTIONS) -> Grower:
    return Grower(
        robot, grow_tree.upright_tree(robot), Region(np.array(BOX)), extension, options,
        simulation=grow_tree.LANDING,
    )  # fmt: skip


@pytest.fixture(scope='module')
def stages(robot, extension):
    """Checkpoints after one round and after three, grown in one go."""
    grower = begun(robot, extension)
    found = []
    for _ in range(3):
        grower.round()
        found.append(Checkpoint.of(grower, goal='either'))
    return found[0], found[2]


@pytest.fixture
def file(stages, tmp_path):
    path = tmp_path / 'tree.npz.part'
    stages[0].save(path)
    return path


def test_a_checkpoint_comes_back_and_grows_on_as_if_nothing_had_been(
    robot, extension, stages, file
):
    first, last = stages
    back = Checkpoint.load(file, robot)
    assert_same(back.tree, first.tree)
    assert (back.counts, back.rounds, back.decided) == (first.counts, 1, first.decided)
    # Twice: growing on does not touch the checkpoint.
    for _ in range(2):
        grower = back.resumed(begun(robot, extension))
        grower.round()
        grower.round()
        found = Checkpoint.of(grower, goal='either')
        assert len(found.tree.nodes) > len(first.tree.nodes)
        assert_same(found.tree, last.tree)
        assert (found.counts, found.rounds) == (last.counts, 3)
        for name in LEVELS:
            np.testing.assert_array_equal(getattr(found.levels, name), getattr(last.levels, name))


def test_what_decides_the_result_is_told_by_name_and_to_the_bit():
    found = told(growth=GrowthOptions(tolerated=0.1 + 0.2), region=Region(np.array([0.1, 0.2])),
                 extension=ExtensionOptions(weights=Weights(torque=1 / 3)))  # fmt: skip
    assert found['growth.tolerated'] == '0.30000000000000004'
    assert found['region.half'] == '[0.1, 0.2]'
    assert found['extension.weights.torque'] == repr(1 / 3)


@pytest.mark.parametrize(
    ('changed', 'said'),
    [
        ({'options': replace(OPTIONS, seed=6)}, r'begun with growth\.seed 5, now it is 6; go on'),
        ({'options': replace(OPTIONS, probes=3)}, r'growth\.probes 16, now it is 3'),
        ({'region': Region(np.array([*BOX[:3], 3.0]))}, r'region\.half \[0\.25, .*2\.0\], now'),
        ({'settings': TrackingSettings(late=0.2)}, r'law\.late 0\.3, now it is 0\.2'),
    ],
)
def test_what_was_begun_otherwise_is_refused(robot, extension, stages, changed, said):
    grower = replace(begun(robot, extension), **changed)
    with pytest.raises(TreeError, match=said):
        stages[0].require(Checkpoint.of(grower, goal='either').decided)
    stages[0].require(Checkpoint.of(begun(robot, extension), goal='either').decided)
    with pytest.raises(TreeError, match="begun with goal 'either', now it is 'inner'"):
        stages[0].require(Checkpoint.of(begun(robot, extension), goal='inner').decided)


def test_one_of_another_model_is_refused(file):
    with pytest.raises(TreeError, match='grown for a model with hash'):
        Checkpoint.load(file, Model.load(model_path('compass_gait_flexible')))


def test_a_tree_is_no_checkpoint_and_a_checkpoint_no_tree(robot, stages, file, tmp_path):
    stages[0].tree.save(tmp_path / 'tree.npz')
    with pytest.raises(TreeError, match='not a tree that grows: home, failed is missing'):
        Checkpoint.load(tmp_path / 'tree.npz', robot)
    with pytest.raises(TreeError, match="not a tree: format must be 'cg_tree/3'"):
        Tree.load(file)


def test_damaged_bytes_give_one_error(robot, file):
    whole, rng = file.read_bytes(), np.random.default_rng(0)
    named = []
    for _ in range(100):
        damaged = bytearray(whole)
        for place in rng.integers(0, len(whole), rng.integers(1, 4)):
            damaged[place] ^= 1 << int(rng.integers(8))
        cut = int(rng.integers(1, len(whole))) if rng.random() < 0.2 else len(whole)
        file.write_bytes(bytes(damaged[:cut]))
        try:
            Checkpoint.load(file, robot)
        except TreeError as error:
            named.append(str(error))
    assert len(named) > 70
    assert all(text.startswith(f'{file}: ') for text in named)


@pytest.mark.parametrize(
    ('member', 'change', 'said'),
    [
        ('home', lambda a: a[:-1], 'home must hold counts'),
        ('failed', lambda a: a - 1, 'failed must hold counts'),
        ('failed', lambda a: a.astype(float), 'failed must hold counts'),
        ('header', b'"samples": 64', 'samples must be a whole number'),
        ('header', b'"grown"', 'counts must be covered'),
        ('header', b'"rounds": 1', 'rounds must be a whole number'),
        ('header', b'"tolerated": 0.01', 'tolerated must be a number'),
        ('header', b'"decided"', 'decided must be texts'),
    ],
)
def test_what_is_no_checkpoint_is_named(robot, file, member, change, said):
    with np.load(file) as arrays:
        found = dict(arrays)
    if member == 'header':
        text = found['header'].tobytes()
        name = change.partition(b':')[0]
        wrong = name + b': -1' if b':' in change else b'"other"'
        assert change in text
        found['header'] = np.frombuffer(text.replace(change, wrong), np.uint8)
    else:
        found[member] = change(found[member])
    np.savez(file.with_suffix('.npz'), **found)
    with pytest.raises(TreeError, match=said):
        Checkpoint.load(file.with_suffix('.npz'), robot)


def test_an_array_that_declares_more_than_it_holds_is_refused(robot, file):
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(
        header, {'descr': '<f8', 'fortran_order': False, 'shape': (1 << 40,)}
    )
    with zipfile.ZipFile(file) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    with zipfile.ZipFile(file, 'w') as archive:
        for name, content in {**members, 'rho.npy': header.getvalue()}.items():
            archive.writestr(name, content)
    with pytest.raises(TreeError, match=r'damaged: rho is an array of shape \(1099511627776,\)'):
        Checkpoint.load(file, robot)


def test_checkpoints_are_written_no_more_often_than_asked(robot, stages, tmp_path):
    path = tmp_path / 'part'
    keeper = Keeper(path, every=1e6)
    keeper.write()
    keeper.keep(stages[0])
    assert not path.exists()
    keeper.write()
    assert Checkpoint.load(path, robot).rounds == 1
    keeper.keep(stages[1])
    assert Checkpoint.load(path, robot).rounds == 1
    keeper.write()
    assert Checkpoint.load(path, robot).rounds == 3
    Keeper(path, every=0.0).keep(stages[0])
    assert Checkpoint.load(path, robot).rounds == 1


@pytest.fixture(scope='module')
def in_one_go(robot) -> Tree:
    with pytest.MonkeyPatch.context() as patch:
        make_small(patch)
        return grow_tree.grow(robot, 'either', SAMPLES, SEED)


def written_anew(path, before, process) -> bytes:
    """Wait until the checkpoint is another one; returns it."""
    deadline = time.monotonic() + LONG
    while process.poll() is None and time.monotonic() < deadline:
        if path.exists() and (found := path.read_bytes()) != before:
            return found
        time.sleep(0.005)
    process.kill()
    raise AssertionError(process.communicate())


@pytest.mark.evidence
def test_growth_that_is_killed_again_and_again_ends_as_in_one_go(robot, in_one_go, tmp_path):
    out, part = tmp_path / 'tree.npz', tmp_path / 'tree.npz.part'
    words = ['--samples', str(SAMPLES), '--seed', str(SEED), '--workers', '2', '--out', str(out)]
    instants, before, done = np.random.default_rng(8).uniform(0.0, 0.6, 2), b'', []
    for instant in instants:
        process = started(tmp_path, *words)
        written_anew(part, before, process)
        time.sleep(instant)  # in the middle of whatever
        process.kill()
        process.communicate()
        before = part.read_bytes()
        done.append(Checkpoint.load(part, robot).rounds)
    assert not out.exists()
    assert done == sorted(set(done))
    said, err = started(tmp_path, *words).communicate(timeout=LONG)
    assert f'goes on from {part}: {done[-1] * ROUND} of {SAMPLES} states are done' in err
    assert f'grow_tree: {out}: ' in said
    assert_same(Tree.load(out, robot), in_one_go)
    assert not part.exists()


@pytest.mark.slow
@pytest.mark.parametrize('number', [
    pytest.param(signal.SIGINT, marks=pytest.mark.evidence),
    signal.SIGTERM,
])  # fmt: skip
def test_a_signal_ends_growth_with_a_checkpoint(robot, in_one_go, tmp_path, number):
    out, part = tmp_path / 'tree.npz', tmp_path / 'kept'
    words = ['--samples', str(SAMPLES), '--seed', str(SEED), '--workers', '1', '--out', str(out),
             '--checkpoint', str(part)]  # fmt: skip
    process = started(tmp_path, *words)
    written_anew(part, b'', process)
    os.killpg(process.pid, number)  # as a terminal does it: to those that plan, too
    said, err = process.communicate(timeout=LONG)
    assert (process.returncode, said) == (128 + number, ''), err
    assert err.splitlines()[-1] == (
        f'grow_tree: stopped by {number.name}; the tree so far is in {part}, and the same command '
        'goes on from there'
    )
    assert Checkpoint.load(part, robot).rounds >= 1
    process = started(tmp_path, *words)
    said, err = process.communicate(timeout=LONG)
    assert process.returncode == 0
    assert_same(Tree.load(out, robot), in_one_go)
    assert list(tmp_path.glob('*.npz*')) == [out]
    assert not part.exists()
