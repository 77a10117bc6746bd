"""No name in a file or message leads out of its folder, and none at all ends in a traceback."""

import os
import resource
import shutil
import signal
from pathlib import Path

import pytest
import yaml

from cg_control.trajectories.trajectory import Trajectory
from cg_control.trees.tree_files import TreeSelection, tree_path, trees_directory
from cg_description.paths import model_path, models_directory
from cg_dynamics.model import Model
from cg_hardware.simulation import read_setup
from cg_sysid import read_bag, rehearse, write_bag
from cg_sysid.experiments.catalogue import experiments_directory, load_experiment
from cg_sysid.experiments.excitation import ExcitationSettings, make_signal, playback
from cg_sysid.records.bags import load_note
from cg_sysid.records.importing import load_mapping
from cg_sysid.records.recover import recover

OUTSIDE = ('../../etc/passwd', '/etc/passwd', '..', '../secret.mcap', 'a/../../secret.mcap', '~/x')
ODD = (
    '..', '../x', '~nobody-of-that-name/x', 'x' * 300, 'a\0b', 'a\nb', '\x1b[31m', '/', '\ud800',
)  # fmt: skip
READERS = {
    'model': model_path, 'tree': tree_path, 'trajectory': Trajectory.load,
    'experiment': load_experiment, 'mapping': load_mapping, 'note': load_note, 'bag': read_bag,
    'set-up': read_setup, 'command file': lambda name: playback(Path(name)),
    'selected tree': lambda name: TreeSelection(name, '0' * 64).load(None),
}  # fmt: skip


def refused(read, *arguments):
    """The one line with which something is refused."""
    with pytest.raises(ValueError) as caught:  # noqa: PT011 - its words are judged below
        read(*arguments)
    message = str(caught.value)
    assert message.isprintable(), message
    assert 0 < len(message) < 1000
    return message


@pytest.fixture(scope='module')
def recorded(tmp_path_factory):
    """A sound bag."""
    e = load_experiment('swing_inner_fixed')
    signal_ = make_signal(ExcitationSettings(**e.excitation, duration=0.5, seed=1))
    machine = Model.load(model_path('compass_gait_mit'))
    made = rehearse('run', machine, e.setup, e.initial_state, [signal_], 0.5, seed=1)
    return write_bag(tmp_path_factory.mktemp('bags') / 'run', made)


@pytest.fixture
def bag(recorded, tmp_path):
    """A copy of it, a secret beside it, and a way to change its metadata."""
    copy = tmp_path / 'inner' / 'run'
    shutil.copytree(recorded, copy)
    shutil.copy(next(copy.glob('*.mcap')), tmp_path / 'inner' / 'secret.mcap')
    return copy


def change(bag, **entries):
    file = bag / 'metadata.yaml'
    tree = yaml.safe_load(file.read_text('utf-8'))
    tree['rosbag2_bagfile_information'] |= entries
    file.write_text(yaml.safe_dump(tree), encoding='utf-8')


@pytest.mark.parametrize('name', [*OUTSIDE, 'b/run.mcap', 'run.dat', '', 5, None, 'x\n.mcap'])
def test_a_bag_that_names_a_file_outside_of_it_is_refused(bag, name):
    read_bag(bag)
    change(bag, relative_file_paths=[name])
    message = refused(read_bag, bag)
    assert 'metadata.yaml' in message or 'no name of a file' in message


def test_nor_in_its_list_of_files_nor_by_another_storage(bag):
    """A file of another ending would not be looked through for damage."""
    change(bag, files=[{'path': '../secret.mcap'}])
    assert "'../secret.mcap' leads out of" in refused(read_bag, bag)
    change(bag, files=[], storage_identifier='sqlite3')
    assert 'run.mcap' in refused(read_bag, bag)
    (bag / 'run.mcap').rename(bag / 'run.db3')
    change(bag, storage_identifier='mcap', relative_file_paths=['run.db3'])
    refused(read_bag, bag)


def test_recovery_reads_and_writes_inside_of_the_bag_only(bag):
    change(bag, relative_file_paths=['../secret.mcap'])
    content = (bag / 'run.mcap').read_bytes()
    (bag / 'run.mcap').write_bytes(content[:-100])
    beside = {p: p.read_bytes() for p in bag.parent.glob('*') if p.is_file()}
    recover(bag)
    assert {p: p.read_bytes() for p in bag.parent.glob('*') if p.is_file()} == beside
    read_bag(bag)


def test_where_a_link_leads_is_for_its_owner_to_say(bag):
    (bag / 'run.mcap').unlink()
    (bag / 'run.mcap').symlink_to(bag.parent / 'secret.mcap')
    read_bag(bag)


def test_bags_of_before_name_their_folder_too(bag):
    change(bag, version=3, relative_file_paths=['run/run.mcap'])
    read_bag(bag)
    change(bag, version=3, relative_file_paths=['../run/run.mcap'])
    assert 'leads out of' in refused(read_bag, bag)


@pytest.mark.parametrize('name', OUTSIDE)
def test_an_experiment_plays_files_beside_it_only(tmp_path, name):
    shipped = yaml.safe_load((experiments_directory() / 'open_loop_playback.yaml').read_text())
    file = tmp_path / 'mine.yaml'
    shutil.copy(experiments_directory() / shipped['excitation']['file'], tmp_path / 'torque.csv')
    for named in ('torque.csv', name):
        shipped['excitation']['file'] = named
        file.write_text(yaml.safe_dump(shipped), encoding='utf-8')
        if named == 'torque.csv':
            load_experiment(str(file))
    assert 'excitation.file' in refused(load_experiment, str(file))


@pytest.mark.parametrize('pattern', ['../*.csv', '/etc/*', 'a/../../*.csv', '**/..'])
def test_an_import_reads_below_its_folder_only(tmp_path, pattern):
    file = tmp_path / 'mapping.yaml'
    file.write_text(yaml.safe_dump({'format': 'cg_import/1', 'files': pattern}), encoding='utf-8')
    refused(load_mapping, str(file))


@pytest.mark.parametrize('reader', READERS)
@pytest.mark.parametrize('name', ODD, ids=repr)
def test_a_name_that_cannot_be_is_refused_in_one_line(reader, name):
    refused(READERS[reader], name)


def test_a_name_is_looked_up_in_its_folder_only(tmp_path, monkeypatch):
    """Of trees, models, experiments: a path must be one that is there, from where we are."""
    monkeypatch.chdir(tmp_path)
    for look_up, folder in (
        (tree_path, trees_directory()), (model_path, models_directory()),
        (load_experiment, experiments_directory()),
    ):  # fmt: skip
        name = next(folder.iterdir()).stem
        refused(look_up, f'../{folder.name}/{name}')
        refused(look_up, f'x/../{name}')


@pytest.mark.parametrize('name', ['/dev/zero', '/dev/stdin', 'pipe', '.'])
def test_a_tree_that_a_message_names_is_a_file_that_ends(tmp_path, monkeypatch, name):
    """On /tree/selected anybody can name anything."""
    monkeypatch.chdir(tmp_path)
    os.mkfifo('pipe')
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    signal.alarm(10)  # a read that never ends is a failure, not a wait
    try:
        assert 'not a file' in refused(TreeSelection(name, '0' * 64).load, None)
    finally:
        signal.alarm(0)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 50 * 1024
