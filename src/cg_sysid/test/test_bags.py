"""Bags: what is written comes back, foreign storage is read, bad input gets one clear error."""

from dataclasses import replace

import numpy as np
import pytest
import yaml
from rosbags.rosbag2 import CompressionFormat, CompressionMode, Reader, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from cg_dynamics.rig import Setup
from cg_interfaces.stamps import NS_PER_S
from cg_sysid.errors import RecordingError
from cg_sysid.records import bags
from cg_sysid.records.record import Record

STORE = get_typestore(Stores.ROS2_JAZZY)
START = 1_300_000_000 * NS_PER_S
NOTE = {'format': 'cg_recording/1', 'mechanism': 'pendulum', 'setup': {}}


def compass_record(seed=0, count=400, drop_hip=0.0):
    """A record of noise on every channel, jittered stamps, the encoder with gaps."""
    rng = np.random.default_rng(seed)
    stamps = START + np.cumsum(rng.integers(1_500_000, 2_500_000, count))
    hip = rng.standard_normal(count)
    hip[rng.random(count) < drop_hip] = np.nan
    return Record(
        name=f'noise_{seed}',
        stamp_ns=stamps,
        inputs={'hip_torque': rng.standard_normal(count)},
        outputs={
            'imu_angle': rng.uniform(-3.0, 3.0, count),
            'imu_rate': rng.standard_normal(count),
            'hip_angle': hip,
        },
        mechanism='compass_gait',
        setup=Setup.from_dict({'stance': 'outer', 'fixture': 'outer_fixed', 'on_blocks': True}),
        note={'experiment': 'noise', 'nominal_rate_hz': 500.0, 'notes': 'ein Gruß'},
    )


@pytest.mark.parametrize('seed', range(5))
def test_what_is_written_comes_back(tmp_path, seed):
    record = compass_record(seed, drop_hip=0.2)
    back = bags.read_bag(bags.write_bag(tmp_path / record.name, record))
    np.testing.assert_array_equal(back.stamp_ns, record.stamp_ns)
    np.testing.assert_array_equal(back.inputs['hip_torque'], record.inputs['hip_torque'])
    for channel in ('imu_rate', 'hip_angle'):
        np.testing.assert_array_equal(back.outputs[channel], record.outputs[channel])
    # The angle goes through a quaternion: a few units in the last place.
    np.testing.assert_allclose(back.outputs['imu_angle'], record.outputs['imu_angle'], atol=2e-15)
    assert (back.name, back.mechanism, back.setup) == (
        record.name, record.mechanism, record.setup,
    )  # fmt: skip
    assert back.note['notes'] == 'ein Gruß'


def test_outputs_without_a_rate_come_back_without_one(tmp_path):
    record = compass_record()
    outputs = {k: v for k, v in record.outputs.items() if k != 'imu_rate'}
    back = bags.read_bag(bags.write_bag(tmp_path / 'bag', replace(record, outputs=outputs)))
    assert set(back.outputs) == {'imu_angle', 'hip_angle'}


def test_the_note_comes_first_and_is_latched(tmp_path):
    path = bags.write_bag(tmp_path / 'bag', compass_record())
    with Reader(path) as reader:
        first = next(iter(reader.messages()))[0]
    assert first.topic == '/experiment'
    assert first.ext.offered_qos_profiles[0].durability.name == 'TRANSIENT_LOCAL'
    info = yaml.safe_load((path / 'metadata.yaml').read_text())['rosbag2_bagfile_information']
    assert (info['version'], info['storage_identifier']) == (9, 'mcap')


def test_bags_are_never_overwritten_and_no_scraps_stay(tmp_path):
    bags.write_bag(tmp_path / 'bag', compass_record())
    with pytest.raises(RecordingError, match='never overwritten'):
        bags.write_bag(tmp_path / 'bag', compass_record())
    assert [p.name for p in tmp_path.iterdir()] == ['bag']


def test_the_command_is_the_input_only_on_request_or_for_want_of_another(tmp_path):
    record = compass_record()
    command = {'hip_torque': np.arange(len(record), dtype=float)}
    path = bags.write_bag(tmp_path / 'bag', record, command)
    applied = bags.read_bag(path)
    np.testing.assert_array_equal(applied.inputs['hip_torque'], record.inputs['hip_torque'])
    commanded = bags.read_bag(path, torque_topic='/torque_command')
    np.testing.assert_array_equal(commanded.inputs['hip_torque'], command['hip_torque'])
    raw = bags.read_raw(path)
    del raw.topics['/applied_torque']
    np.testing.assert_array_equal(bags.to_record(raw).inputs['hip_torque'], command['hip_torque'])


def write_foreign(
    path,
    *,
    note=NOTE,
    torque=(),
    angle=(),
    msgtype='sensor_msgs/msg/JointState',
    storage=StoragePlugin.MCAP,
    compression=None,
):
    """A pendulum bag as another tool would write it; torque and angle are (stamp, value) pairs."""
    types = STORE.types

    def joint_state(stamp, field, value):
        time = types['builtin_interfaces/msg/Time'](
            sec=stamp // NS_PER_S, nanosec=stamp % NS_PER_S
        )
        empty = np.array([], dtype=float)
        fields = {'position': empty, 'velocity': empty, 'effort': empty}
        fields[field] = np.array([value])
        return types['sensor_msgs/msg/JointState'](
            header=types['std_msgs/msg/Header'](stamp=time, frame_id=''), name=['joint'], **fields
        )

    writer = Writer(path, version=9, storage_plugin=storage)
    if compression:
        writer.set_compression(compression, CompressionFormat.ZSTD)
    with writer:
        if note is not None:
            connection = writer.add_connection(
                '/experiment', 'std_msgs/msg/String', typestore=STORE
            )
            text = types['std_msgs/msg/String'](
                data=note if isinstance(note, str) else yaml.safe_dump(note)
            )
            writer.write(connection, START, STORE.serialize_cdr(text, 'std_msgs/msg/String'))
        for topic, field, samples in (
            ('/applied_torque', 'effort', torque),
            ('/joint_states', 'position', angle),
        ):
            if samples is None:
                continue
            connection = writer.add_connection(topic, msgtype, typestore=STORE)
            for k, (stamp, value) in enumerate(samples):
                if msgtype == 'std_msgs/msg/String':
                    message = types[msgtype](data='')
                else:
                    message = joint_state(stamp, field, value)
                writer.write(
                    connection, START + 2_000_000 * k + 1, STORE.serialize_cdr(message, msgtype)
                )
    return path


def regular(count=50, value=0.1):
    return [(START + 2_000_000 * k, value * k) for k in range(count)]


@pytest.mark.parametrize(
    ('storage', 'compression'),
    [
        (StoragePlugin.MCAP, None),
        (StoragePlugin.SQLITE3, None),
        (StoragePlugin.SQLITE3, CompressionMode.FILE),
        (StoragePlugin.SQLITE3, CompressionMode.MESSAGE),
        (StoragePlugin.MCAP, CompressionMode.STORAGE),
    ],
)
def test_every_storage_reads_the_same(tmp_path, storage, compression):
    path = write_foreign(
        tmp_path / 'bag',
        torque=regular(),
        angle=regular(),
        storage=storage,
        compression=compression,
    )
    record = bags.read_bag(path)
    np.testing.assert_array_equal(record.outputs['angle'], 0.1 * np.arange(50))


def test_a_single_mcap_file_reads_too(tmp_path):
    path = write_foreign(tmp_path / 'bag', torque=regular(), angle=regular())
    assert len(bags.read_bag(path / 'bag.mcap')) == 50


def test_a_note_can_be_given_to_a_bag_without_one(tmp_path):
    path = write_foreign(tmp_path / 'bag', note=None, torque=regular(), angle=regular())
    with pytest.raises(RecordingError, match=r'--note note\.yaml'):
        bags.read_bag(path)
    assert bags.read_bag(path, note=NOTE).mechanism.name == 'pendulum'


def test_rows_before_the_first_torque_are_dropped(tmp_path):
    path = write_foreign(tmp_path / 'bag', torque=regular()[10:], angle=regular())
    record = bags.read_bag(path)
    assert record.stamp_ns[0] == START + 20_000_000
    assert record.outputs['angle'][0] == pytest.approx(1.0)


def test_a_slow_torque_is_held(tmp_path):
    path = write_foreign(tmp_path / 'bag', torque=regular()[::10], angle=regular())
    held = bags.read_bag(path).inputs['torque']
    np.testing.assert_allclose(held, np.repeat(np.arange(0, 50, 10) * 0.1, 10))


def test_repeats_and_overtaking_are_repaired(tmp_path):
    angle = regular()
    angle[20], angle[21] = angle[21], angle[20]
    angle.insert(30, angle[30])
    path = write_foreign(tmp_path / 'bag', torque=regular(), angle=angle)
    np.testing.assert_array_equal(bags.read_bag(path).outputs['angle'], 0.1 * np.arange(50))


def back_jump():
    return [(stamp - (30_000_000 if k > 25 else 0), v) for k, (stamp, v) in enumerate(regular())]


def with_value(index, value):
    samples = regular()
    samples[index] = (samples[index][0], value)
    return samples


@pytest.mark.parametrize(
    ('content', 'message'),
    [
        ({'angle': None}, 'topic missing.*/joint_states is needed'),
        ({'torque': None}, r'topic missing.*/applied_torque.*the bag has /joint_states'),
        ({'msgtype': 'std_msgs/msg/String'}, 'has type std_msgs/msg/String; sensor_msgs'),
        ({'angle': with_value(7, np.nan)}, r'position\[joint\] is nan at sample 7 .*0.014 s'),
        ({'torque': with_value(9, np.inf)}, r'effort\[joint\] is inf at sample 9'),
        ({'angle': regular(1)}, r'1 sample\(s\); at least 2'),
        ({'torque': regular(1)}, r'1 sample\(s\); at least 2'),
        ({'angle': []}, 'no value'),
        ({'angle': back_jump()}, 'stamps run backwards.*sample 26'),
        ({'angle': [(START, 0.1 * k) for k in range(9)]}, 'every sample has the same stamp'),
        ({'note': {**NOTE, 'mechanism': 'cart_pole'}}, "unknown mechanism 'cart_pole'"),
        ({'note': {**NOTE, 'format': 'cg_recording/9'}}, "'cg_recording/9' is not cg_recording/1"),
        ({'note': {**NOTE, 'setup': {'stance': 'left'}}}, "stance: 'left' is not one of"),
        ({'note': '[1, 2]'}, 'a list of 2 is no mapping'),
        ({'note': 'a: [1'}, '/experiment: not YAML: line 2, column 1'),
        ({'note': {**NOTE, 'nominal_rate_hz': 'fast'}}, "nominal_rate_hz: 'fast' is no number"),
        ({'note': {**NOTE, 'sensor_zeros': [0.0]}}, 'sensor_zeros: a list of 1 is no mapping'),
        ({'note': {'format': 'cg_recording/1'}}, 'which mechanism was recorded'),
    ],
)
def test_bad_bags_get_one_clear_error(tmp_path, content, message):
    path = write_foreign(tmp_path / 'bag', **{'torque': regular(), 'angle': regular(), **content})
    with pytest.raises(RecordingError, match=message) as caught:
        bags.read_bag(path)
    assert str(path) in str(caught.value)


def test_a_bag_without_messages_is_empty(tmp_path):
    path = write_foreign(tmp_path / 'bag', note=None, torque=None, angle=None)
    with pytest.raises(RecordingError, match='empty'):
        bags.read_bag(path)


@pytest.mark.parametrize('kind', ['missing', 'folder', 'text', 'garbage', 'bad_metadata'])
def test_what_is_no_bag_is_refused(tmp_path, kind):
    path = tmp_path / 'thing'
    if kind == 'folder':
        path.mkdir()
    elif kind == 'text':
        path.write_text('no bag')
    elif kind == 'garbage':
        path = path.with_suffix('.mcap')
        path.write_bytes(b'no bag at all' * 100)
    elif kind == 'bad_metadata':
        path.mkdir()
        (path / 'metadata.yaml').write_text('nothing')
    with pytest.raises(RecordingError, match=r'no such file|not a bag|not a readable'):
        bags.read_bag(path)


@pytest.mark.parametrize('word', ['/applied_torque', 'sensor_msgs/msg/JointState'])
def test_a_topic_that_is_called_by_a_number_is_refused(tmp_path, word):
    # A text of YAML 1.1, as we read it, and a number of YAML 1.2, as the reader of bags does.
    path = bags.write_bag(tmp_path / 'bag', compass_record())
    file = path / 'metadata.yaml'
    file.write_text(file.read_text().replace(word, '1e+308'))
    with pytest.raises(
        RecordingError, match=r'calls a topic or its type 1e\+308; expected a text'
    ):
        bags.read_bag(path)


@pytest.mark.parametrize('share', [0.3, 0.9, 0.999])
def test_a_truncated_bag_names_the_way_out(tmp_path, share):
    path = bags.write_bag(tmp_path / 'bag', compass_record())
    file = path / 'bag.mcap'
    content = file.read_bytes()
    file.write_bytes(content[: int(share * len(content))])
    with pytest.raises(RecordingError, match=r'cg_sysid recover'):
        bags.read_bag(path)


def test_a_bag_without_metadata_names_the_way_out(tmp_path):
    path = bags.write_bag(tmp_path / 'bag', compass_record())
    (path / 'metadata.yaml').unlink()
    with pytest.raises(RecordingError, match=r'cg_sysid recover'):
        bags.read_bag(path)


def test_a_sqlite_bag_without_metadata_names_its_own_way_out(tmp_path):
    path = write_foreign(
        tmp_path / 'bag', torque=regular(), angle=regular(), storage=StoragePlugin.SQLITE3
    )
    (path / 'metadata.yaml').unlink()
    with pytest.raises(RecordingError, match='ros2 bag reindex'):
        bags.read_bag(path)


def test_tied_legs_need_no_torque(tmp_path):
    record = replace(compass_record(), setup=Setup.from_dict({'fixture': 'legs_tied'}))
    raw = bags.read_raw(bags.write_bag(tmp_path / 'bag', record))
    del raw.topics['/applied_torque']
    assert not bags.to_record(raw).inputs['hip_torque'].any()
