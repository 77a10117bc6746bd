"""Imports: expressions and splits on small tables, then each real data set that comes along.

The real data are public (data.md) and no part of the project. Tests that need them look in
the folder named by CG_DATA, or in ../shared/data beside the repository, and are skipped without.
"""

import json
import os
from pathlib import Path

import numpy as np
import pytest
import scipy.io
import yaml
from scipy.optimize import least_squares

from cg_interfaces.stamps import NS_PER_S
from cg_sysid.checks.recordings import check_recording
from cg_sysid.errors import RecordingError
from cg_sysid.identification.data_set import recording_of
from cg_sysid.records import importing
from cg_sysid.records.bags import read_bag
from cg_sysid.records.expressions import evaluate
from cg_sysid.records.importing import import_logs, import_to_bags
from cg_sysid.records.noise import measure_noise
from cg_sysid.records.tables import read_table

REPOSITORY = Path(__file__).resolve().parents[3]
DATA = Path(os.environ.get('CG_DATA', REPOSITORY.parent / 'shared' / 'data'))


def data(folder):
    """Folder of a real data set, or a skip that says why."""
    if not (DATA / folder).is_dir():
        pytest.skip(f'no {folder} under {DATA}: get it as data.md says and set CG_DATA')
    return DATA / folder


TABLE = {'a': np.array([1.0, 2.0, 4.0]), 'b': np.array([2.0, 2.0, 2.0])}


@pytest.mark.parametrize(
    ('expression', 'expected'),
    [
        ('a', [1, 2, 4]),
        (3, [3, 3, 3]),
        ({'column': 'a', 'unit': 'deg'}, np.deg2rad([1, 2, 4])),
        ({'column': 'a', 'unit': 'ms'}, [1e-3, 2e-3, 4e-3]),
        ({'column': 'a', 'unit': 'counts', 'counts_per_rev': 4}, np.pi / 2 * np.array([1, 2, 4])),
        ({'column': 'a', 'gain': -2.0, 'offset': 1.0}, [-1, -3, -7]),
        ({'product': ['a', 'b', 'b']}, [4, 8, 16]),
        ({'sum': ['a', {'column': 'b', 'gain': -1}]}, [-1, 0, 2]),
        ({'divide': ['b', 'a'], 'gain': 10}, [20, 10, 5]),
        ({'constant': 2.5}, [2.5, 2.5, 2.5]),
    ],
)
def test_expressions(expression, expected):
    np.testing.assert_allclose(evaluate(expression, TABLE, 'x'), expected, rtol=1e-15)


@pytest.mark.parametrize(
    ('expression', 'message'),
    [
        ('c', "x: no column 'c'; the file has a, b"),
        ({'column': 'a', 'unit': 'furlong'}, "x: unit: 'furlong' is not one of"),
        ({'column': 'a', 'unit': 'counts'}, 'counts_per_rev: is missing; unit counts needs it'),
        ({'product': ['a']}, 'x: product: a list of 1; 2 or more entries are needed'),
        ({'divide': ['a', 0]}, 'x: row 1: division by zero'),
        ({'divide': ['a', 'b', 'b']}, 'x: divide: a list of 3; 2 entries are needed'),
        ({'column': 'a', 'eval': 'os.system'}, "x: unknown entry 'eval'; allowed: column"),
        ({'column': 'a', 'constant': 1}, 'exactly one of'),
        ({'column': 'a', 'gain': 'big'}, "x: gain: 'big' is no number"),
        ({'column': 'a', 'gain': True}, 'x: gain: true is no number'),
        (['a'], 'is no expression'),
        (None, 'is no expression'),
    ],
)
def test_bad_expressions(expression, message):
    with pytest.raises(RecordingError, match=message):
        evaluate(expression, TABLE, 'x')


def test_mat_and_json_read_as_csv_does(tmp_path):
    (tmp_path / 'log.csv').write_text('t,q\n0,1.5\n0.1,2.5\n')
    (tmp_path / 'log.json').write_text(json.dumps({'t': [0, 0.1], 'q': [1.5, 2.5], 'rate': 10}))
    (tmp_path / 'rows.json').write_text(
        json.dumps({'entries': [{'t': 0, 'q': 1.5}, {'t': 0.1, 'q': 2.5}]})
    )
    scipy.io.savemat(tmp_path / 'log.mat', {'t': [0, 0.1], 'q': [1.5, 2.5], 'Ts': 0.1})
    expected = read_table(tmp_path / 'log.csv')
    for name in ('log.json', 'rows.json', 'log.mat'):
        table = read_table(tmp_path / name)
        assert set(table) == {'t', 'q'}
        for column in table:
            np.testing.assert_array_equal(table[column], expected[column])


def test_structs_of_a_mat_file_have_dotted_columns(tmp_path):
    scipy.io.savemat(tmp_path / 'log.mat', {'exp': {'q': [1.0, 2.0], 'sub': {'u': [3.0, 4.0]}}})
    assert set(read_table(tmp_path / 'log.mat')) == {'exp.q', 'exp.sub.u'}


@pytest.mark.parametrize(
    ('name', 'content', 'message'),
    [
        ('a.csv', '', 'empty'),
        ('a.csv', 't,q\n', 'empty'),
        ('a.csv', 't,q\n1,2\n3\n', 'line 3 has 1 fields'),
        ('a.csv', 't,t\n1,2\n', "the header has two columns 't'"),
        ('a.csv', b't,q\n1,2\n3,4 \xb0\n', 'line 3: the byte 0xb0 is not UTF-8'),
        ('a.csv', 't,q\n1,' + 'x' * 200_000, 'line 2: no CSV: field larger'),
        ('a.json', '[{"t": 1}, {"t": 2, "q": 3}]', r"\[1\]: 'q' stands in some of the rows only"),
        ('a.json', '{"t": [1, "two"]}', r"t\[1\]: 'two' is no number"),
        ('a.json', '[' * 5000, 'more than 40 deep'),
        ('a.json', '{', 'not JSON: line 1'),
        ('a.json', '[1, 2]', r'\[0\]: 1 is no mapping'),
        ('a.mat', 'nothing', 'not a readable MAT'),
        ('a.xls', '', "suffix '.xls' is not one of"),
    ],
)
def test_bad_tables(tmp_path, name, content, message):
    (tmp_path / name).write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(RecordingError, match=message):
        read_table(tmp_path / name)


LOG = 'trial,t_ms,angle,volt\n' + '\n'.join(
    f'{k // 10},{5 * (k % 10)},{k},{2 * k}' for k in range(30)
)
MAPPING = {
    'format': 'cg_import/1',
    'files': '*.csv',
    'mechanism': 'pendulum',
    'start': '2011-03-04T10:00:00Z',
    'time': {'column': 't_ms', 'unit': 'ms'},
    'channels': {
        'angle': {'column': 'angle', 'unit': 'deg'},
        'torque': {'column': 'volt', 'gain': 0.5},
    },
}


def write_mapping(tmp_path, **changes):
    mapping = {k: v for k, v in {**MAPPING, **changes}.items() if v is not None}
    (tmp_path / 'map.yaml').write_text(yaml.safe_dump(mapping))
    (tmp_path / 'log.csv').write_text(LOG)
    return tmp_path / 'map.yaml'


def test_each_value_of_a_column_gets_its_own_record(tmp_path):
    split = {'by': ['trial'], 'name': 'trial_{trial:02d}', 'drop_first': 2, 'drop_last': 3}
    path = write_mapping(tmp_path, split=split)
    records = [imported.record for imported in import_logs(path, tmp_path)]
    assert [record.name for record in records] == ['trial_00', 'trial_01', 'trial_02']
    for k, record in enumerate(records):
        np.testing.assert_allclose(record.outputs['angle'], np.deg2rad(10 * k + np.arange(2, 7)))
        np.testing.assert_array_equal(record.inputs['torque'], 10 * k + np.arange(2, 7))
        np.testing.assert_array_equal(np.diff(record.stamp_ns), 5_000_000)
    assert records[0].stamp_ns[0] == 1_299_232_800 * NS_PER_S + 10_000_000


def test_pieces_of_one_recording_say_so_in_their_bags(tmp_path):
    """They share zeros, and never judge each other where other recordings can."""
    split = {'by': ['trial'], 'name': 'trial_{trial:02d}', 'recording': 'all'}
    bags = import_to_bags(write_mapping(tmp_path, split=split), tmp_path, tmp_path / 'bags')
    records = [read_bag(bag) for bag in bags]
    assert {recording_of(record) for record in records} == {'all'}
    assert [r.name for r in records] == ['trial_00', 'trial_01', 'trial_02']


def test_rows_can_be_chosen_and_time_can_be_a_rate(tmp_path):
    path = write_mapping(
        tmp_path, rows=[{'column': 'trial', 'equals': 1}], time={'rate_hz': 200.0}
    )
    (imported,) = import_logs(path, tmp_path)
    assert len(imported.record) == 10
    np.testing.assert_array_equal(np.diff(imported.record.stamp_ns), 5_000_000)
    assert imported.record.note['nominal_rate_hz'] == 200.0


def test_a_cell_that_is_no_number_is_named(tmp_path):
    path = write_mapping(tmp_path, rows=[{'column': 'trial', 'from': 1}], time={'rate_hz': 200.0})
    lines = LOG.split('\n')
    lines[17] = lines[17].replace(',16,', ',n/a,')
    (tmp_path / 'log.csv').write_text('\n'.join(lines))
    message = r"angle: row 17 \(line 18\), column 'angle': the cell 'n/a' is no number"
    with pytest.raises(RecordingError, match=message):
        list(import_logs(path, tmp_path))
    # Where the filters leave that row out, it does no harm.
    path = write_mapping(tmp_path, rows=[{'column': 'trial', 'from': 2}], time={'rate_hz': 200.0})
    (tmp_path / 'log.csv').write_text('\n'.join(lines))
    assert len(next(import_logs(path, tmp_path)).record) == 10


def test_more_dropped_than_there_is_leaves_nothing(tmp_path):
    path = write_mapping(tmp_path, split={'by': ['trial'], 'drop_last': 13})
    assert list(import_logs(path, tmp_path)) == []


def test_a_fraction_of_a_second_counts(tmp_path):
    path = write_mapping(tmp_path, start='2011-03-04T10:00:00.25Z', time={'rate_hz': 200.0})
    (imported,) = import_logs(path, tmp_path)
    assert imported.record.stamp_ns[0] == 1_299_232_800 * NS_PER_S + 250_000_000


def test_a_record_can_be_cut_at_a_value(tmp_path):
    path = write_mapping(
        tmp_path,
        time={'rate_hz': 200.0},
        split={'at': [{'column': 'angle', 'value': 12}], 'name': 'part_{part}'},
    )
    lengths = {i.record.name: len(i.record) for i in import_logs(path, tmp_path)}
    assert lengths == {'part_1': 12, 'part_2': 18}


@pytest.mark.parametrize(
    ('changes', 'message'),
    [
        ({'format': 'other'}, "format: 'other' is not cg_import/1"),
        ({'files': None}, 'files: is missing'),
        ({'files': '*.bin'}, 'no file matches'),
        ({'files': '*\n.csv'}, r"no file matches '\*\\n.csv'"),
        ({'mechanism': 'x' * 2000}, "unknown mechanism 'x{40}…'; known are"),
        ({'colour': 'red'}, "unknown entry 'colour'"),
        (
            {'mechanism': 'cart_pole'},
            "mechanism: unknown mechanism 'cart_pole'; known are compass_gait",
        ),
        ({'time': {'column': 'nope'}}, "no column 'nope'"),
        ({'time': {}}, 'time: a column or rate_hz is needed'),
        ({'start': 'yesterday'}, "start: 'yesterday' is no time; an ISO 8601 time"),
        ({'start': {'from_name': '%Y'}}, 'start.from_name: the name of the file cannot be read'),
        ({'start': '2040-01-01'}, r'time: row 1 \(line 2\): 0 s after the start is no stamp'),
        ({'channels': ['angle']}, 'channels: a list of 1 is no mapping; a mapping from names'),
        ({'channels': None, 'time': {'rate_hz': 1.0}}, 'input torque is missing'),
        ({'files': '/etc/*'}, "files: '/etc/.*' is no pattern"),
        ({'files': '../*.csv'}, 'is no pattern'),
        ({'time': {'rate_hz': -1}}, 'time.rate_hz: -1 is not allowed; a positive number'),
        ({'rows': [{'column': 'trial', 'from': 'a'}]}, r"rows\[0\].from: 'a' is no number"),
        ({'rows': [{'column': 'trial'}]}, r'rows\[0\]: nothing to compare with'),
        ({'split': {'by': 'trial'}}, "split.by: 'trial' is no list"),
        ({'split': {'name': '{part:99999999d}'}}, 'only {name} and forms such as'),
        ({'split': {'name': '{part.__class__}'}}, "there is no 'part.__class__'"),
        ({'split': {'name': '{part'}}, 'braces do not match'),
        ({'split': {'name': '../{part}'}}, "'../1' is no name of a directory"),
        ({'note': {'zeroed': 'now'}}, "note: unknown entry 'zeroed'.*did you mean 'zeroed_at'"),
        ({'rows': [{'column': 'trial', 'equals': 77}]}, 'no row is left'),
        ({'rows': [{'column': 'nope', 'equals': 1}]}, "no column 'nope'"),
        ({'split': {'by': ['nope']}}, "no column 'nope'"),
        ({'split': {'by': ['trial'], 'name': '{nope}'}}, 'cannot be filled'),
        ({'cases': [{'when': {'column': 'trial', 'equals': 5}}]}, 'none of its 1 cases'),
        ({'channels': {'angle': 'angle', 'knee': 'volt'}}, "no channel 'knee'"),
        ({'channels': {'angle': 'angle'}, 'time': {'rate_hz': 1.0}}, 'input torque is missing'),
        ({'setup': {'stance': 'left'}}, "'left' is not one of"),
        ({}, 'stamps must increase strictly'),  # the three data sets start again at 0
    ],
)
def test_bad_mappings(tmp_path, changes, message):
    path = write_mapping(tmp_path, **changes)
    with pytest.raises(ValueError, match=message):
        list(import_logs(path, tmp_path))


def test_an_unknown_mapping_lists_those_that_come_along():
    with pytest.raises(RecordingError, match='bam_servo_pendulum, dfki_double_pendulum'):
        importing.load_mapping('moon')


@pytest.mark.parametrize('name', importing.mapping_names())
def test_each_mapping_states_where_its_data_come_from(name):
    mapping = importing.load_mapping(name)
    assert set(mapping['source']) == {'repository', 'revision', 'licence'}
    assert mapping['title']


def test_the_command_line_imports_and_lists(tmp_path, capsys):
    path = write_mapping(tmp_path, rows=[{'column': 'trial', 'equals': 1}])
    argv = [str(path), str(tmp_path), '--out', str(tmp_path / 'bags')]
    assert importing.main(argv) == 0
    assert len(read_bag(tmp_path / 'bags' / 'map_log')) == 10
    assert importing.main(argv) == 1
    assert 'never overwritten' in capsys.readouterr().err
    assert importing.main(['--list']) == 0
    assert 'sydney_walking' in capsys.readouterr().out


# --- the real data sets ---------------------------------------------------------------------

FOLDERS = {
    'sydney_pendulum': ('sydney_compass_gait', 2),
    'sydney_walking': ('sydney_compass_gait', 90),
    'dfki_double_pendulum': ('dfki_double_pendulum', 10),
    'dfki_double_pendulum_command': ('dfki_double_pendulum', 10),
    'bam_servo_pendulum': ('bam_servo_pendulum', 12),
}


@pytest.mark.parametrize('name', [
    name if name in ('sydney_pendulum', 'bam_servo_pendulum')
    else pytest.param(name, marks=pytest.mark.evidence)
    for name in FOLDERS
])  # fmt: skip
def test_real_data_come_through_bags_unchanged_and_usable(tmp_path, name):
    folder, count = FOLDERS[name]
    source = data(folder)
    paths = import_to_bags(name, source, tmp_path / 'bags')
    assert len(paths) == count
    for path, imported in zip(paths, import_logs(name, source), strict=True):
        back = read_bag(path)
        np.testing.assert_array_equal(back.stamp_ns, imported.record.stamp_ns)
        for channel, values in {**imported.record.inputs, **imported.record.outputs}.items():
            np.testing.assert_allclose(
                {**back.inputs, **back.outputs}[channel], values, rtol=0.0, atol=1e-15
            )
        report = check_recording(path)
        assert report.verdict == 'warnings', report.findings  # when it was zeroed is not known


def test_quanta_of_the_real_encoders():
    free_fall = next(import_logs('sydney_pendulum', data('sydney_compass_gait'))).record
    assert measure_noise(free_fall)['angle'].quantum == pytest.approx(2 * np.pi / 8192, rel=1e-4)
    for imported in import_logs('bam_servo_pendulum', data('bam_servo_pendulum')):
        quantum = measure_noise(imported.record)['angle'].quantum
        assert quantum == pytest.approx(2 * np.pi / 4096, rel=1e-3)


def test_the_whole_sydney_pendulum_would_be_refused(tmp_path):
    mapping = importing.load_mapping('sydney_pendulum')
    del mapping['split']
    (path,) = import_to_bags(mapping, data('sydney_compass_gait'), tmp_path)
    (shift,) = check_recording(path).of('zero_shift')
    assert shift.start_s == pytest.approx(37.845, abs=1e-6)
    assert shift.value == pytest.approx(np.deg2rad(1.0546875), rel=1e-6)


def test_the_sydney_pendulum_settles_on_the_side_of_its_torque():
    record = next(import_logs('sydney_pendulum', data('sydney_compass_gait'))).record
    torque, angle = record.inputs['torque'], record.outputs['angle']
    late_in_a_step = np.convolve(np.abs(np.diff(torque, prepend=0.0)) > 0, np.ones(600), 'full')
    settled = (late_in_a_step[: len(torque)] == 0) & (torque != 0.0)
    assert settled.sum() > 500
    # mgl sin(angle) = torque, up to friction; mgl = 0.307 N m in the authors' model.
    np.testing.assert_allclose(0.307 * np.sin(angle[settled]), torque[settled], atol=0.01)


def test_the_drive_of_the_servo_is_off_after_a_drop():
    for imported in import_logs('bam_servo_pendulum', data('bam_servo_pendulum')):
        enabled = imported.record.inputs['drive_enabled']
        assert (enabled.min() == 0.0) == ('lift_and_drop' in imported.record.name)
        assert not imported.record.inputs['torque'][enabled == 0.0].any()


def walking_error(record, signs, published):
    """Root mean square error in rad of the published walker against one step.

    Written from the authors' description alone, independent of the model library. The initial
    rates are fitted.

    Args:
        record: One step.
        signs: Factors (stance angle, hip angle, torque), each +1 or -1.
        published: The authors' values of experiment 2.
    """
    stance_sign, hip_sign, torque_sign = signs
    inner = record.setup.stance == 'inner'
    stance, swing = ('inner', 'outer') if inner else ('outer', 'inner')
    p, m, l, g = published, published['m_inner_kg'], published['leg_length_m'], published['g']
    side = 1.0 if inner else -1.0
    lc, lc_swing = p[f'lc_{stance}_m'], p[f'lc_{swing}_m']
    inertia = p[f'I_about_hip_{stance}_kgm2'] - m * lc**2 + m * (l - lc) ** 2
    m11 = inertia + (p['mH_inertial_kg'] + m) * l**2
    m22, coupling = p[f'I_about_hip_{swing}_kgm2'], -m * l * lc_swing
    g1, g2 = g * (m * (l - lc) + (p['mH_gravity_kg'] + m) * l), g * m * lc_swing

    def derivative(x, u):
        a, b, va, vb = x
        hip_rate = side * (va - vb)
        tau = side * (u - p['Fc_hip_Nm'] * np.tanh(hip_rate / 0.05) - p['Fv_hip_Nms'] * hip_rate)
        c, s = coupling * np.cos(a - b), coupling * np.sin(a - b)
        r1, r2 = tau - s * vb**2 + g1 * np.sin(a), -tau + s * va**2 - g2 * np.sin(b)
        det = m11 * m22 - c * c
        return np.array([va, vb, (m22 * r1 - c * r2) / det, (m11 * r2 - c * r1) / det])

    hip = hip_sign * record.outputs['hip_angle']
    measured_inner = record.outputs['imu_angle']
    q_stance = stance_sign * (
        measured_inner if inner else measured_inner - record.outputs['hip_angle']
    )
    q_swing = q_stance - side * hip

    def residual(rates):
        x = np.array([q_stance[0], q_swing[0], *rates])
        path = [x]
        for u, h in zip(torque_sign * record.inputs['hip_torque'], record.dt, strict=False):
            k1 = derivative(x, u)
            k2 = derivative(x + 0.5 * h * k1, u)
            k3 = derivative(x + 0.5 * h * k2, u)
            x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + derivative(x + h * k3, u))
            path.append(x)
        path = np.array(path)
        return np.concatenate([path[:, 0] - q_stance, side * (path[:, 0] - path[:, 1]) - hip])

    start = [(q[4] - q[0]) / (record.time[4]) for q in (q_stance, q_swing)]
    return np.sqrt(np.mean(least_squares(residual, start).fun ** 2))


def test_the_signs_of_the_walking_steps_are_the_only_ones_that_fit():
    folder = data('sydney_compass_gait')
    published = json.loads((folder / 'published_parameters.json').read_text())['exp2']
    steps = [i.record for i in import_logs('sydney_walking', folder)][4:44:10]  # outer stance
    steps += [i.record for i in import_logs('sydney_walking', folder)][5:45:10]  # inner stance
    assert {step.setup.stance for step in steps} == {'inner', 'outer'}

    def median_error(*signs):
        return np.median([walking_error(step, signs, published) for step in steps])

    right = median_error(1, 1, 1)
    assert right < 0.01
    for signs in ((-1, 1, 1), (1, -1, 1), (1, 1, -1)):
        assert median_error(*signs) > 4.0 * right
    # The mirrored plane is the same physics: only the direction of walking excludes it.
    assert median_error(-1, -1, -1) == pytest.approx(right, rel=1e-6)
    for step in steps:
        lean = step.outputs['imu_angle'] - (
            step.outputs['hip_angle'] if step.setup.stance == 'outer' else 0.0
        )
        assert lean[0] < 0.0 < lean[-1]  # the hip passes over the foot, forward
