"""Mutants of every file that people write or pass on, read by the readers that meet them.

    nice -n 19 ./cg exec python bench/fuzz_readers.py [--inputs 1000000] [--seconds 300]
        [--readers model note] [--write FILE]

A mutant is a sound file with bytes or words changed, with entries deleted, renamed, swapped for
odd values or wrapped, or with a bomb in it: deep nesting, aliases of aliases, endless numbers,
texts, keys. Files of arrays are also changed inside, with sums that fit, so that the damage gets
past the archive. A reader must take it, or refuse it by an error of its own: one line, short,
without the words of the interpreter. Each mutant follows from reader and number alone
(`--replay`).

Counted are *crashes* (any other exception), *unclear* (an error of more than a line or 1000
characters, or in the words of the interpreter), the longest CPU time and the growth of the
process's largest memory over a whole run; a second and 200 MB are allowed. A reader that takes
more than 1 ms for an input ends after `--seconds` of CPU time, with as many as that makes.

Files of parameters are not here: rcl reads them.
"""

import argparse
import copy
import functools
import io
import json
import math
import random
import re
import resource
import shutil
import struct
import sys
import tempfile
import time
import traceback
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import scipy.io
import yaml

from cg_bringup.hidden import hidden_effects_file
from cg_control.balancing.basin import SHIPPED, shipped_file
from cg_control.following.nodes import Nodes
from cg_control.trajectories.trajectory import Trajectory, TrajectoryError
from cg_control.trees.tree import Tree, TreeError
from cg_control.trees.tree_files import TreeSelection
from cg_description.model_file import write_atomically
from cg_description.paths import model_path, models_directory
from cg_description.reading import DocumentError, parse_yaml, read_text
from cg_description.robot_description import parse
from cg_description.transmissions import couplings, driven_joints
from cg_dynamics.errors import DynamicsError
from cg_dynamics.model import Model
from cg_dynamics.rig import Setup
from cg_hardware.checklist import record as checklist
from cg_hardware.drive.settings import read_settings
from cg_hardware.drive.zero import read_zero as read_encoder_zero
from cg_hardware.imu.zero_file import read_zero
from cg_hardware.simulation import read_setup
from cg_sysid.errors import RecordingError
from cg_sysid.experiments.catalogue import ExperimentError, experiments_directory, load_experiment
from cg_sysid.experiments.excitation import CommandFileError, playback
from cg_sysid.identification.kept_fits import recall
from cg_sysid.records.bags import load_note, parse_note, read_bag, write_bag
from cg_sysid.records.importing import import_logs, mapping_folder
from cg_sysid.records.record import Record
from cg_sysid.records.tables import read_table
from cg_sysid.report import curves
from cg_sysid.report.diagnosis_file import read_facts

OURS = (DocumentError, RecordingError, TrajectoryError, ExperimentError, DynamicsError,
        CommandFileError, TreeError, curves.CurvesError)  # fmt: skip
# Signs of an error that comes out of the interpreter or a library and not out of a reader.
FOREIGN = re.compile(
    r"<class|NoneType|object at 0x|dtype|Errno|invalid literal|could not convert|codec can't|"
    r'Traceback|tuple index|unhashable|unexpected keyword|has no attribute|inhomogeneous'
)
ALLOWED_S, ALLOWED_MB = 1.0, 200.0
SLOW_S = 1e-3  # of CPU for an input, mutation included, from which on a reader has a time limit

MAPPING = """
format: cg_import/1
title: pendulum
source: {repository: here, revision: 1}
files: '*.csv'
mechanism: pendulum
start: '2011-03-04T10:00:00Z'
time: {column: t_ms, unit: ms}
rows: [{column: trial, from: 1, below: 5}]
split:
  by: [trial]
  at: [{column: t_ms, value: 25}]
  name: 'e_{trial:02d}_{part}'
  drop_first: 1
channels:
  angle: {column: angle, unit: counts, counts_per_rev: 4096, gain: -1, offset: 0.1}
  torque: {product: [volt, {column: duty, gain: 0.01}], gain: 0.5}
commands: {torque: {divide: [volt, {constant: 2.0}]}}
cases:
- when: {column: trial, equals: 1}
  setup: {stance: inner}
- when: {column: trial, from: 2}
  note: {experiment: second}
note: {experiment: first, initial_state: unknown, sensor_zeros: {angle: 0.0}, closed_loop: false}
nominal_rate_hz: 200.0
"""
LOG = 'trial,t_ms,angle,volt,duty\n' + ''.join(
    f'{k // 10},{5 * (k % 10)},{k},{2 * k},{k % 7}\n' for k in range(60)
)
NOTE = """
format: cg_recording/1
experiment: spring_stabilised_inner
mechanism: compass_gait
setup:
  stance: inner
  fixture: none
  springs:
  - {body: inner, point: 1.0, anchor: [0.6, 1.0], stiffness: 400.0, free_length: 0.3}
nominal_rate_hz: 500.0
sensor_zeros: {imu_angle: 0.0, hip_angle: 0.0}
zeroed_at: '2011-03-04T10:12:00Z'
initial_state: rest
model_file: compass_gait_mit.yaml
closed_loop: false
notes: free text
imported_from: {repository: here, revision: 92546f6}
"""
SETUP = (
    'stance: outer\nsprings: [{body: outer, point: 1, anchor: [1, 1], stiffness: 9, '
    'free_length: 0}]\non_blocks: false\n'
)
KNOTS = 4
TRAJECTORY = json.dumps({
    'format': 'cg_trajectory/1',
    'model_hash': '2fa92f5043244330',
    'provenance': {'slope': 0.0, 'friction': 'planned', 'periodic': False, 'seconds': 1.5},
    'phases': [
        {
            'stance': stance,
            'time': [start + 0.1 * k for k in range(KNOTS)],
            'states': [[0.1, -0.1, 0.5, k] for k in range(KNOTS)],
            'rates': [[0.5, k, -0.25, 1e-3] for k in range(KNOTS)],
            'torque': [0.5 * k for k in range(KNOTS)],
            'gains': [[1.0, 2.0, 3.0, k] for k in range(KNOTS)],
            'cost_to_go': [[[1.0] * 4] * 4] * KNOTS,
        }
        for stance, start in (('inner', 0.0), ('outer', 0.1 * (KNOTS - 1)))
    ],
})  # fmt: skip
FACTS = json.dumps({
    'format': 'cg_diagnosis/1', 'verdict': 'explained', 'summary': 'payload', 'findings': [],
    'gain': {'hip_angle': {'before': 1.0, 'after': 0.1, 'unit': 'rad'}}, 'causes': [{'a': None}],
})  # fmt: skip
ZERO = """
format: cg_zero/1
zero_rad: 0.0123
axis: pitch
sign: -1.0
still_rad: 0.0004
samples: 250
taken_at: '2026-03-04T10:12:00Z'
taken_by: somebody
"""
ENCODER_ZERO = """
format: cg_encoder_zero/1
zero_counts: 1234
how: index by hand
method: 33
offset_rad: 0.01
taken_at: '2026-03-04T10:12:00Z'
taken_by: somebody
"""
DRIVE = """
interface: slcan
channel: /dev/ttyACM1
bitrate: 500000
node_id: 3
sign: -1.0
gear: 100.0
"""
CHECKLIST = """
format: cg_checklist/1
date: '2026-03-04T10:12:00Z'
software: compass-gait 0.2.0
emulated: false
devices: {imu: 3DM-GX3-25 1234, drive: somebody's 5678}
settings: {sign: -1.0, gear: 100}
model_file: compass_gait_mit.yaml
model_sha256: '0123'
setup: {stance: inner}
complete: true
steps:
- {name: zero, title: the zero, verdict: passed, measured: {still_mrad: 0.2}}
- {name: sign, title: the sign, verdict: failed, reason: the wrong way}
"""
URDF = """<?xml version="1.0"?>
<robot name="arm">
  <link name="base"/>
  <link name="upper">
    <inertial>
      <origin xyz="0 0 0.2" rpy="0 0.1 0"/>
      <mass value="1.5"/>
      <inertia ixx="0.01" ixy="0" ixz="0" iyy="0.02" iyz="0" izz="0.015"/>
    </inertial>
  </link>
  <link name="fore"><inertial><mass value="0.5"/><inertia ixx="1e-3" iyy="1e-3" izz="1e-3"
      ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="shoulder" type="revolute">
    <origin xyz="0 0 0.5" rpy="0 0 0"/>
    <parent link="base"/> <child link="upper"/> <axis xyz="0 1 0"/>
    <limit lower="-1" upper="1" effort="20" velocity="3"/> <dynamics damping="0.1" friction="0.2"/>
  </joint>
  <joint name="elbow" type="continuous">
    <parent link="upper"/> <child link="fore"/> <mimic joint="shoulder" multiplier="2"/>
  </joint>
  <link name="hand"/>
  <joint name="wrist" type="continuous"><parent link="fore"/><child link="hand"/></joint>
  <transmission name="t"><type>transmission_interface/DifferentialTransmission</type>
    <actuator name="a"><role>actuator1</role></actuator>
    <actuator name="b"><role>actuator2</role></actuator>
    <joint name="shoulder"><role>joint1</role></joint>
    <joint name="wrist"><role>joint2</role><mechanicalReduction>-2</mechanicalReduction></joint>
  </transmission>
</robot>
"""
SELECTION = json.dumps({'path': '/a/b/tree.npz', 'sha256': '0' * 64})
KEPT = json.dumps({
    'theta': [1.0, 2.0], 'motions': [[0.1, 0.2], [0.3]], 'cost': 1.5, 'sse': [[1.0], [2.0]],
    'count': [[100.0], [100.0]], 'weight': 1.0, 'converged': True,
})  # fmt: skip


@dataclass(frozen=True)
class Reader:
    """A reader, and sound files that it takes.

    Attributes:
        read: Reads the file of that path.
        name: Name of the file.
        seeds: Sound contents.
        kind: 'text', 'binary' or 'archive': which mutations make sense.
        around: Name -> content of files that must stand beside it.
    """

    read: Callable[[Path], object]
    name: str
    seeds: tuple[bytes, ...]
    kind: str = 'text'
    around: dict[str, bytes] = field(default_factory=dict)


def _utf8(*texts: str) -> tuple[bytes, ...]:
    return tuple(text.encode() for text in texts)


def _files(folder: Path) -> tuple[bytes, ...]:
    return tuple(path.read_bytes() for path in sorted(folder.glob('*.yaml')))


def _full_model() -> bytes:
    model = Model.load(model_path('sydney_pendulum'))
    return model.with_effect('backlash').with_effect('payload').text().encode()


def _bag() -> dict[str, bytes]:
    """Name -> content of the files of a small bag."""
    stamps = 1_300_000_000_000_000_000 + 2_000_000 * np.arange(6)
    swing = np.linspace(0.0, 0.1, 6)
    note = {'nominal_rate_hz': 500.0, 'experiment': 'free swing'}
    record = Record(
        'bag', stamps, {'torque': 0.0 * swing}, {'angle': swing}, 'pendulum', Setup(), note
    )
    with tempfile.TemporaryDirectory() as folder:
        bag = write_bag(Path(folder) / 'bag', record)
        return {path.name: path.read_bytes() for path in bag.iterdir()}


def _mat_files() -> Iterator[bytes]:
    """A log in each form of MAT that is read."""
    time_s = np.linspace(0.0, 0.5, 6)
    log = {'t': time_s, 'run': {'angle': np.sin(time_s), 'name': 'first'}, 'rate_hz': 10.0}
    flat = {'t': time_s, 'angle': np.arange(6.0)}
    for form, compressed, content in (('5', False, log), ('5', True, log), ('4', False, flat)):
        file = io.BytesIO()
        scipy.io.savemat(file, content, format=form, do_compression=compressed)
        yield file.getvalue()


def _tree() -> bytes:
    """A tree of a few nodes: a motion of two knots, along which everything is constant."""
    model = Model.load(model_path('compass_gait_mit'))
    content = json.loads(TRAJECTORY)
    content['model_hash'] = model.hash
    nodes = Nodes.of(Trajectory.from_text(json.dumps(content), model), model)
    goal = np.array([np.full((4, 4), np.nan), 25.0 * np.eye(4)])
    tree = Tree(nodes, goal, {'seed': 3}, np.array([[nodes.first, -1], [-1, -1]]))
    return _written(tree.save, 'tree.npz')


def _curves() -> bytes:
    time_s = np.linspace(0.0, 1.0, 5)
    row = curves.Curve('a', 'train', time_s, *[time_s[:, None]] * (len(curves.SIGNALS) - 1))
    return _written(lambda path: curves.save([row], path.parent), curves.FILE_NAME)


def _written(write: Callable[[Path], object], name: str) -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        write(Path(folder) / name)
        return (Path(folder) / name).read_bytes()


def _read_mapping(path: Path) -> None:
    (path.parent / 'log.csv').write_text(LOG)
    for _ in import_logs(path, path.parent):
        pass


def _read_note(path: Path) -> None:
    parse_note(read_text(path, RecordingError), path.name)
    Setup.from_dict(load_note(path).get('setup') or {})


def _read_basins(path: Path) -> None:
    SHIPPED.of(parse_yaml(read_text(path), path.name), path.name)


def _read_urdf(path: Path) -> None:
    text = read_text(path)
    parse(text, path.name)
    driven_joints(text)
    couplings(text)


def _read_kept(path: Path) -> None:
    if recall(path) is None:
        raise DocumentError(f'{path}: nothing that is known')


def readers() -> dict[str, Reader]:
    """All readers by name."""
    basins, hidden = shipped_file().read_bytes(), hidden_effects_file().read_bytes()
    commands = '# a\ntime,torque\n0.0,1.0\n0.5,-2.0\n'
    logs = '{"t": [0, 0.1, null], "q": [1, 2, 3]}', '{"entries": [{"t": 0, "q": 1.5}]}'
    bag = _bag()
    metadata, recorded = bag['metadata.yaml'], bag['bag.mcap']
    return {
        'model': Reader(Model.load, 'a.yaml', (*_files(models_directory()), _full_model())),
        'mapping': Reader(
            _read_mapping, 'a.yaml', (*_utf8(*[MAPPING] * 6), *_files(mapping_folder()))
        ),
        'trajectory': Reader(Trajectory.load, 'a.json', _utf8(TRAJECTORY)),
        'note': Reader(_read_note, 'a.yaml', _utf8(NOTE)),
        'setup': Reader(lambda path: read_setup(str(path)), 'a.yaml', _utf8(SETUP)),
        'experiment': Reader(
            lambda path: load_experiment(str(path)), 'a.yaml', _files(experiments_directory()),
            around={p.name: p.read_bytes() for p in experiments_directory().glob('*.csv')},
        ),
        'results': Reader(lambda path: read_facts(path.parent), 'diagnosis.json', _utf8(FACTS)),
        'settings': Reader(_read_basins, 'a.yaml', (basins, hidden)),
        'zero file': Reader(lambda path: read_zero(str(path)), 'a.yaml', _utf8(ZERO)),
        'encoder zero': Reader(
            lambda path: read_encoder_zero(str(path)), 'a.yaml', _utf8(ENCODER_ZERO)
        ),
        'drive settings': Reader(lambda path: read_settings(str(path)), 'a.yaml', _utf8(DRIVE)),
        'checklist': Reader(checklist.load, 'a.yaml', _utf8(CHECKLIST)),
        'URDF': Reader(_read_urdf, 'a.urdf', _utf8(URDF)),
        'selected tree': Reader(
            lambda path: TreeSelection.from_text(read_text(path)), 'a.json', _utf8(SELECTION)
        ),
        'kept fit': Reader(_read_kept, 'a.json', _utf8(KEPT)),
        'log (CSV)': Reader(read_table, 'a.csv', _utf8(LOG)),
        'log (JSON)': Reader(read_table, 'a.json', _utf8(*logs)),
        'log (MAT)': Reader(read_table, 'a.mat', tuple(_mat_files()), 'binary'),
        'command file': Reader(playback, 'a.csv', _utf8(commands)),
        'tree': Reader(Tree.load, 'a.npz', (_tree(),), 'archive'),
        'curves': Reader(
            lambda path: curves.load(path.parent), curves.FILE_NAME, (_curves(),), 'archive'
        ),
        'bag: metadata': Reader(
            lambda path: read_bag(path.parent), 'metadata.yaml', (metadata,),
            around={'bag.mcap': recorded},
        ),
        'bag: MCAP': Reader(
            lambda path: read_bag(path.parent), 'bag.mcap', (recorded,), 'binary',
            around={'metadata.yaml': metadata},
        ),
    }  # fmt: skip


# Mutations

ODD = (
    '', '~', 'null', 'true', 'no', '0', '-1', '1', '1e-3', '1E400', '-.inf', '.nan', 'NaN',
    'Infinity', '1e999', '0x1F', '0o17', '010', '1_000', '1:30', '9' * 400, '-' + '9' * 25,
    '2011-99-99', '2011-03-04', "''", "'0.3'", '""', '"\\ud800"', '"\\0"', '[]', '{}', '[[]]',
    '[1, 2]', '{a: 1}', '{"a": 1}', '[1, [2]]', '&a', '*a', '!!int 3', '!!python/name:os.system',
    '<<', '=', '? x', '|', '>-', '%', '@', '`', '\t', '\x00', '\x1b[31m', '\u2028', '\ufeff', '§',
    'x' * 300, 'inner', 'angle', 'kg', 'pendulum', 'format', 'name', '**', '../x', '/', '{x}',
    '{part:99999999d}', '{part.__class__}', '{', '%Y%', 'a.b', '1;2', '"',
)  # fmt: skip
ODD_VALUES = (
    None, True, False, 0, -1, 1, 2**31, 10**18, -(10**30), 10**399, 1e-320, 1e308, float('nan'),
    float('inf'), '', ' ', '0.3', '1e-3', '9' * 400, 'x' * 300, '\x00', 'é\u2028', '2011-99-99',
    [], {}, [[]], [None], [1.0, 'a'], {'a': {}}, {'value': 1.0, 'unit': 'kg'}, [{}, {}], 'inner',
    'angle', '{part:99999d}', '../../x', '**/**', {'from_name': '%'}, {'column': 'angle'},
)  # fmt: skip
WORD = re.compile(rb'[\w.+-]+|[^\w\s]|\s+')


def flip_bytes(data: bytes, rng: random.Random, seeds: tuple[bytes, ...]) -> bytes:
    """A few bytes changed, inserted, taken out or doubled."""
    out = bytearray(data)
    for _ in range(rng.choice((1, 1, 1, 2, 4, 16))):
        k = rng.randrange(len(out) + 1)
        kind = rng.randrange(6)
        if kind == 0 and k < len(out):
            out[k] ^= 1 << rng.randrange(8)
        elif kind == 1 and k < len(out):
            out[k] = rng.randrange(256)
        elif kind == 2:
            out[k:k] = rng.randbytes(rng.choice((1, 2, 8)))
        elif kind == 3:
            del out[k : k + rng.choice((1, 2, 10, 100))]
        elif kind == 4:
            out[k:k] = out[k : k + rng.choice((1, 5, 50))]
        else:
            del out[k:]
    return bytes(out)


def swap_words(data: bytes, rng: random.Random, seeds: tuple[bytes, ...]) -> bytes:
    """A few words swapped for odd ones, taken out, doubled or exchanged."""
    words = list(_words(data)) or [b' ']
    for _ in range(rng.choice((1, 1, 1, 2, 4))):
        k, other = rng.randrange(len(words)), rng.randrange(len(words))
        kind = rng.randrange(6)
        if kind <= 2:
            words[k] = rng.choice(ODD).encode()
        elif kind == 3:
            words[k] = b''
        elif kind == 4:
            words[k], words[other] = words[other], words[k]
        else:
            words[k] = words[other]
    return b''.join(words)


def swap_entries(data: bytes, rng: random.Random, seeds: tuple[bytes, ...]) -> bytes:
    """The content with entries swapped for odd values, deleted, renamed, doubled or wrapped."""
    text = _as_json(data)
    if text is None:
        return swap_words(data, rng, seeds)
    tree = json.loads(text)
    for _ in range(rng.choice((1, 1, 1, 2, 3))):
        places = list(_places(tree))
        if not places:
            break
        content, key = rng.choice(places)
        kind = rng.randrange(8)
        if kind <= 3:
            content[key] = copy.deepcopy(rng.choice(ODD_VALUES))
        elif kind == 4:
            del content[key]
        elif kind == 5 and isinstance(content, dict):
            content[rng.choice(('x', key[:-1], key + 's', key.upper(), ''))] = content.pop(key)
        elif kind == 6:
            value = content[key]
            content[key] = rng.choice(([value], {str(key): value}, [value] * 3))
        else:
            other, name = rng.choice(places)
            content[key] = json.loads(json.dumps(other[name]))
    # JSON is YAML; a number of 400 digits is written by hand.
    return json.dumps(tree, ensure_ascii=rng.random() < 0.5).encode('utf-8', 'surrogatepass')


@functools.cache
def _as_json(data: bytes) -> str | None:
    try:
        return json.dumps(yaml.load(data, yaml.CSafeLoader), default=str)
    except (ValueError, yaml.YAMLError):
        return None


@functools.cache
def _words(data: bytes) -> tuple[bytes, ...]:
    return tuple(WORD.findall(data))


def _places(tree: object) -> Iterator[tuple]:
    if isinstance(tree, dict | list):
        for key in tree if isinstance(tree, dict) else range(len(tree)):
            yield tree, key
            yield from _places(tree[key])


def splice(data: bytes, rng: random.Random, seeds: tuple[bytes, ...]) -> bytes:
    """The head of one file and the tail of another."""
    other = rng.choice(seeds)
    return data[: rng.randrange(len(data) + 1)] + other[rng.randrange(len(other) + 1) :]


def _aliases_of_aliases(n: int) -> str:
    """Nine to the power of 8, or of 20."""
    levels = 8 if n < 1000 else 20
    lines = ['a: &a0 [x, x, x, x, x, x, x, x, x]']
    lines += [f'b{k}: &a{k} [{", ".join([f"*a{k - 1}"] * 9)}]' for k in range(1, levels)]
    return '\n'.join([*lines, f'name: *a{levels - 1}', ''])


# Things that swell or nest, by how often.
FUSES: tuple[Callable[[int], str], ...] = (
    lambda n: '[' * n,
    lambda n: '{a: ' * n,
    lambda n: '{"a":' * n,
    lambda n: '- ' * n,
    lambda n: '? ' * n,
    lambda n: '[' * n + ']' * n,
    lambda n: '[[],' * n,
    lambda n: '9' * n,
    lambda n: '-' * n,
    lambda n: '0.' + '0' * n + '1',
    lambda n: '1e' + '9' * n,
    lambda n: 'x' * n,
    lambda n: '"' + 'x' * n,
    lambda n: '"\\"' * n,
    lambda n: "'" + "''" * n + "'",
    lambda n: '[' + '1,' * n + '1]',
    lambda n: '[' + '[],' * n + '1]',
    lambda n: '[' + '{},' * n + '{}]',
    lambda n: '{' + ','.join(f'"{k}":1' for k in range(n)) + '}',
    lambda n: '{' + '"a":1,' * n + '"a":2}',
    lambda n: '\n' * n,
    lambda n: '#' * n,
    lambda n: ' ' * n,
    lambda n: '\t' * n,
    lambda n: '|\n' + ' a\n' * n,
    lambda n: '\n'.join(f'k{k}: {k}' for k in range(n)),
    lambda n: '&a ' * n,
    lambda n: '*a ' * n,
    lambda n: '!!str ' * n,
    lambda n: '%TAG !a! b\n' * n,
    lambda n: '---\n' * n,
    lambda n: '"' + '\\u0041' * n + '"',
    lambda n: 'é' * n,
    lambda n: '(' * n,
    lambda n: ',' * n,
    _aliases_of_aliases,
    lambda n: '[' + ', '.join(f'&a{k} {k}' for k in range(n)) + ']',
    lambda n: '[&a ' + 'x' * n + ', ' + '*a, ' * n + '*a]',
    lambda n: '{' * n + '}' * n,
    lambda n: '0' * n,
    lambda n: '=\n' * n,
    lambda n: '\n'.join(['1,2,3,4,5'] * n),
    lambda n: '"a\n' * n,
    lambda n: '[null,' * n,
)


def bomb(data: bytes, rng: random.Random, seeds: tuple[bytes, ...]) -> bytes:
    """Something that swells or nests, in place of a word or of the whole."""
    n = rng.choice((100, 1500, 1500, 20_000)) if rng.random() < 0.98 else 300_000
    fuse = rng.choice(FUSES)(n)
    if rng.random() < 0.3:
        return fuse.encode()
    words = list(_words(data)) or [b' ']
    words[rng.randrange(len(words))] = fuse.encode()
    return b''.join(words)


ODD_NUMBERS = tuple(
    struct.pack(form, value)
    for form, values in (
        ('<d', (math.nan, math.inf, -math.inf, -1.0, 0.0, 1e308, 5e-324)),
        ('<q', (-1, 0, 1, 2**31, 2**62, -(2**63))),
        ('<i', (-1, 0, 1, 2**30, 2**31 - 1, -(2**31))),
        ('<H', (0, 1, 0xFFFF)),
    )
    for value in values
)
HEADER = 'header.npy'


def swap_numbers(data: bytes, rng: random.Random, seeds: tuple[bytes, ...]) -> bytes:
    """A few odd numbers where some others were: lengths, counts, offsets, values."""
    out = bytearray(data)
    for _ in range(rng.choice((1, 1, 1, 2, 4))):
        number = rng.choice(ODD_NUMBERS)
        k = rng.randrange(max(1, len(out) - len(number)))
        if rng.random() < 0.7:
            k -= k % len(number)
        out[k : k + len(number)] = number
    return bytes(out)


def change_inside(data: bytes, rng: random.Random, seeds: tuple[bytes, ...]) -> bytes:
    """An archive of arrays of which some are changed, missing or exchanged."""
    arrays = dict(_arrays(data))
    for _ in range(rng.choice((1, 1, 1, 2))):
        name, other = rng.choice(list(arrays)), rng.choice(list(arrays))
        kind = rng.randrange(8)
        if name == HEADER and kind < 6:
            text = np.load(io.BytesIO(arrays[HEADER])).tobytes()
            text = rng.choice((swap_entries, swap_entries, swap_words, bomb))(text, rng, (text,))
            file = io.BytesIO()
            np.save(file, np.frombuffer(text, np.uint8))
            arrays[HEADER] = file.getvalue()
        elif kind < 2:
            arrays[name] = swap_numbers(arrays[name], rng, seeds)
        elif kind < 4:
            arrays[name] = arrays[name][:128] + swap_numbers(arrays[name][128:], rng, seeds)
        elif kind == 4:
            arrays[name] = swap_words(arrays[name], rng, seeds)
        elif kind == 5:
            arrays[name] = flip_bytes(arrays[name], rng, seeds)
        elif kind == 6:
            arrays[name], arrays[other] = arrays[other], arrays[name]
        elif len(arrays) > 1:
            del arrays[name]
    file = io.BytesIO()
    with zipfile.ZipFile(file, 'w') as archive:
        for name, content in arrays.items():
            archive.writestr(zipfile.ZipInfo(name), content)
    return file.getvalue()


@functools.cache
def _arrays(data: bytes) -> tuple[tuple[str, bytes], ...]:
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        return tuple((name, archive.read(name)) for name in archive.namelist())


# Kind of file -> mutations and how often.
MUTATIONS = {
    'text': ((flip_bytes, swap_words, swap_entries, splice, bomb), (30, 30, 30, 8, 2)),
    'binary': ((flip_bytes, swap_numbers, splice, bomb), (45, 45, 8, 2)),
    'archive': ((change_inside, flip_bytes, swap_numbers, bomb), (80, 9, 9, 2)),
}


def mutant(name: str, reader: Reader, number: int) -> bytes:
    """The mutant of that number."""
    rng = random.Random(f'{name} {number}')
    data = rng.choice(reader.seeds)
    changes, weights = MUTATIONS[reader.kind]
    (change,) = rng.choices(changes, weights)
    return change(data, rng, reader.seeds)


# Judging


@dataclass
class Tally:
    """What came of the mutants of one reader."""

    inputs: int = 0
    taken: int = 0
    crashes: list[str] = field(default_factory=list)
    unclear: list[str] = field(default_factory=list)
    longest_s: float = 0.0
    longest: int = 0
    cpu_s: float = 0.0


def complaint(error: Exception) -> str:
    """What is wrong with an error; empty if it is one of ours, short and plain."""
    message = str(error)
    if not isinstance(error, OURS):
        return 'crash'
    if not message or '\n' in message or len(message) > 1000 or FOREIGN.search(message):
        return 'unclear'
    return ''


def judge(
    name: str, reader: Reader, numbers: range, folder: Path, seconds: float = math.inf
) -> Tally:
    """Read the mutants of these numbers, or those of them that a slow reader takes in time.

    Args:
        name: Of the reader, from which its mutants follow.
        reader: The reader.
        numbers: Of the mutants.
        folder: Empty but for what the reader needs.
        seconds: CPU time after which a slow reader ends.
    """
    tally, path = Tally(), folder / reader.name
    start = time.process_time()
    for number in numbers:
        path.write_bytes(mutant(name, reader, number))
        began = time.process_time()
        try:
            reader.read(path)
            tally.taken += 1
        except Exception as error:
            fault = complaint(error)
            if fault:
                last = traceback.extract_tb(error.__traceback__)[-1]
                place = f'{Path(last.filename).name}:{last.lineno}'
                line = f'{name} {number}: {type(error).__name__} at {place}: {str(error)[:200]!r}'
                (tally.crashes if fault == 'crash' else tally.unclear).append(line)
        ended = time.process_time()
        spent = ended - began
        tally.inputs += 1
        tally.cpu_s += spent
        if spent > tally.longest_s:
            tally.longest_s, tally.longest = spent, number
        if ended - start > max(seconds, SLOW_S * tally.inputs):
            break
    return tally


def memory_mb() -> float:
    """Largest memory of this process so far in MB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def place_around(reader: Reader, folder: Path) -> None:
    """Put what a reader needs beside its file."""
    for name, content in reader.around.items():
        (folder / name).write_bytes(content)


def run(
    inputs: int, only: list[str] | None = None, seconds: float = math.inf
) -> Iterator[tuple[str, Tally, float]]:
    """Reader, its tally and the growth of the largest memory in MB, for each reader."""
    known = readers()
    shared = Path('/dev/shm')
    with tempfile.TemporaryDirectory(dir=shared if shared.is_dir() else None) as folder:
        for name in only or known:
            reader, here = known[name], Path(folder) / 'bag'
            here.mkdir()
            place_around(reader, here)
            for seed in reader.seeds:
                if name != 'settings':  # its two kinds of files exclude each other
                    (here / reader.name).write_bytes(seed)
                    # The logs of the other mappings are not here.
                    if name != 'mapping' or seed == MAPPING.encode():
                        reader.read(here / reader.name)
            before = memory_mb()
            tally = judge(name, reader, range(inputs), here, seconds)
            yield name, tally, memory_mb() - before
            shutil.rmtree(here)


def main() -> int:
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument('--inputs', type=int, default=1_000_000, help='of each reader [10^6]')
    options.add_argument(
        '--seconds', type=float, default=300.0, help='of CPU for a slow reader [300]'
    )
    options.add_argument('--readers', nargs='+', choices=readers(), metavar='READER')
    options.add_argument('--replay', nargs=2, metavar=('READER', 'NUMBER'), help='show a mutant')
    options.add_argument('--write', type=Path, metavar='FILE', help='write the table there')
    given = options.parse_args()
    if given.replay:
        name, number = given.replay[0], int(given.replay[1])
        sys.stdout.buffer.write(mutant(name, readers()[name], number))
        return 0
    only = [f'--readers {" ".join(map(repr, given.readers))}'] if given.readers else []
    command = ['python bench/fuzz_readers.py', f'--inputs {given.inputs}',
               f'--seconds {given.seconds:g}', *only]  # fmt: skip
    lines = [
        '# Mutated files', '',
        f'Command: `{" ".join(command)}`. What mutants, crashes and unclear errors are is said '
        'at the top of the script, and why some readers got fewer mutants.', '',
        '| reader | mutants | taken | crashes | unclear errors | longest, s CPU | CPU, s | '
        'memory grew by, MB |',
        '|---|---:|---:|---:|---:|---:|---:|---:|',
    ]  # fmt: skip
    bad, total = 0, Tally()
    for name, tally, grown in run(given.inputs, given.readers, given.seconds):
        for line in (*tally.crashes, *tally.unclear)[:20]:
            print(line, file=sys.stderr)
        bad += len(tally.crashes) + len(tally.unclear)
        bad += tally.longest_s > ALLOWED_S or grown > ALLOWED_MB
        total.inputs += tally.inputs
        total.cpu_s += tally.cpu_s
        lines.append(
            f'| {name} | {tally.inputs} | {tally.taken} | {len(tally.crashes)} '
            f'| {len(tally.unclear)} | {tally.longest_s:.3f} | {tally.cpu_s:.0f} | {grown:.0f} |'
        )
        print(lines[-1], f'longest: {tally.longest}', flush=True)
        if given.write:
            write_atomically(given.write, '\n'.join(lines) + '\n')
    print(f'{total.inputs} inputs, {total.cpu_s:.0f} s of CPU in the readers, {bad} faults')
    return 1 if bad else 0


if __name__ == '__main__':
    sys.exit(main())
