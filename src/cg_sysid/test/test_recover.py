"""A journal, whatever became of it, gives an ordinary bag of everything that is intact."""

import json
import shutil

import numpy as np
import pytest
import yaml
from rosbags.highlevel import AnyReader
from rosbags.rosbag2.errors import ReaderError
from rosbags.typesys import Stores, get_typestore

from cg_sysid.records.recorder import Recording
from cg_sysid.records.recover import JOURNAL_NAME, RecoveryError, main, needs_recovery, recover

TYPESTORE = get_typestore(Stores.ROS2_JAZZY)
JOINT_STATE = 'sensor_msgs/msg/JointState'
TOPICS = {
    '/applied_torque': JOINT_STATE,
    '/hip_encoder': JOINT_STATE,
    '/experiment': 'std_msgs/msg/String',
}
QOS = {
    'history': 'keep_last', 'depth': 10, 'reliability': 'reliable', 'durability': 'volatile',
    'deadline': {'sec': 9223372036, 'nsec': 854775807},
    'lifespan': {'sec': 9223372036, 'nsec': 854775807},
    'liveliness': 'automatic',
    'liveliness_lease_duration': {'sec': 9223372036, 'nsec': 854775807},
    'avoid_ros_namespace_conventions': False,
}  # fmt: skip
MS = 1_000_000
TODAY = 1_300_000_000_123_456_789  # ns, with all the digits of a real time


def joint_state(stamp_ns, value):
    types = TYPESTORE.types
    message = types[JOINT_STATE](
        types['std_msgs/msg/Header'](
            types['builtin_interfaces/msg/Time'](stamp_ns // 10**9, stamp_ns % 10**9), 'hip'
        ),
        ['hip'],
        *(np.array([float(value)]) for _ in range(3)),
    )
    return bytes(TYPESTORE.serialize_cdr(message, JOINT_STATE))


def note(text):
    string = 'std_msgs/msg/String'
    return bytes(TYPESTORE.serialize_cdr(TYPESTORE.types[string](text), string))


def journal(path, samples=200, order=1):
    """A recording that was never closed: 2 topics at 500 Hz."""
    recording = Recording(path, TOPICS, by_stamp=True)
    for topic in TOPICS:
        recording.announce(topic, [QOS])
    recording.write('/experiment', note('mechanism: compass_gait'), 0, 0.0)
    for k in range(samples):
        stamp = 10**9 + 2 * MS * k
        for topic in ('/applied_torque', '/hip_encoder')[::order]:
            recording.write(topic, joint_state(stamp, k), 0, 0.002 * k)
    return recording


def content(path):
    with AnyReader([path]) as reader:
        return [(c.topic, t, bytes(data)) for c, t, data in reader.messages()]


def test_a_closed_recording_is_an_ordinary_bag(tmp_path):
    result = journal(tmp_path / 'bag').close()
    assert result.messages == 401
    assert not result.damage
    assert not needs_recovery(tmp_path / 'bag')
    assert sorted(p.name for p in (tmp_path / 'bag').iterdir()) == ['bag.mcap', 'metadata.yaml']
    messages = content(tmp_path / 'bag')
    assert [t for _, t, _ in messages] == sorted(t for _, t, _ in messages)
    assert messages[0][1] == 10**9
    with AnyReader([tmp_path / 'bag']) as reader:
        (connection,) = [c for c in reader.connections if c.topic == '/hip_encoder']
        assert connection.ext.offered_qos_profiles[0].depth == 10


def test_the_order_of_arrival_leaves_no_trace(tmp_path):
    for name, order in (('a', 1), ('b', -1)):
        journal(tmp_path / name / 'bag', order=order).close()
    first, second = (tmp_path / name / 'bag' / 'bag.mcap' for name in 'ab')
    assert first.read_bytes() == second.read_bytes()


def test_ordinary_readers_refuse_what_recover_reads(tmp_path):
    journal(tmp_path / 'bag')  # killed: never closed
    assert needs_recovery(tmp_path / 'bag')
    with pytest.raises((ReaderError, FileNotFoundError)), AnyReader([tmp_path / 'bag']):
        pass
    recover(tmp_path / 'bag')
    assert not needs_recovery(tmp_path / 'bag')


def test_a_killed_recording_lacks_nothing_that_was_written(tmp_path):
    journal(tmp_path / 'bag', samples=201)
    assert recover(tmp_path / 'bag').messages == 403
    stamps = [t for topic, t, _ in content(tmp_path / 'bag') if topic == '/hip_encoder']
    assert stamps == [10**9 + 2 * MS * k for k in range(201)]


def test_cut_anywhere_everything_before_the_cut_is_there(tmp_path):
    journal(tmp_path / 'whole', samples=20)
    data = (tmp_path / 'whole' / JOURNAL_NAME).read_bytes()
    recover(tmp_path / 'whole')
    whole = content(tmp_path / 'whole')
    counts = []
    for index, length in enumerate(range(200, len(data), 211)):
        bag = tmp_path / f'cut{index}'
        bag.mkdir()
        (bag / JOURNAL_NAME).write_bytes(data[:length])
        try:
            recover(bag)
        except RecoveryError:
            # Nothing was complete yet; what there is stays.
            assert (bag / JOURNAL_NAME).is_file()
            counts.append(0)
            continue
        found = content(bag)
        assert found == [m for m in whole if m in found]
        counts.append(len(found))
    assert counts == sorted(counts)
    assert counts[-1] > 0.8 * len(whole)


def test_a_flipped_bit_costs_its_message_and_is_told(tmp_path):
    journal(tmp_path / 'bag', samples=100)
    file = tmp_path / 'bag' / JOURNAL_NAME
    data = bytearray(file.read_bytes())
    data[len(data) * 3 // 4] ^= 0x10
    file.write_bytes(data)
    result = recover(tmp_path / 'bag')
    (loss,) = result.losses
    assert (result.messages, loss.estimate, sum(loss.messages.values())) == (200, 1, 1)
    assert loss.start <= len(data) * 3 // 4 < loss.stop
    assert 0 < loss.until_ns - loss.from_ns <= 4 * MS
    assert 'the CRC of a chunk does not fit; about 1 messages lost (1 of /' in result.damage[0]
    assert (tmp_path / 'bag' / f'{JOURNAL_NAME}.damaged').read_bytes() == data
    with AnyReader([tmp_path / 'bag']) as reader:
        info = yaml.safe_load((tmp_path / 'bag' / 'metadata.yaml').read_text())
        told = info['rosbag2_bagfile_information']['custom_data']['damage']
        assert json.loads(told) == list(result.damage)
        assert reader.message_count == 200


def test_the_bag_begins_where_the_last_expected_topic_does(tmp_path):
    recording = Recording(tmp_path / 'bag', TOPICS, False, ('/applied_torque', '/hip_encoder'))
    for topic in TOPICS:
        recording.announce(topic, [])
    recording.write('/experiment', note('mechanism: compass_gait'), TODAY, 0.0)
    for k in range(50):
        log = TODAY + 10**9 + 2 * MS * k
        recording.write('/applied_torque', joint_state(log, k), log, 0.0)
        if k >= 20:
            recording.write('/hip_encoder', joint_state(log, k), log + 1, 0.0)
    assert recording.silent == ()
    begin_ns = recording.begin()
    result = recording.close()
    assert begin_ns == TODAY + 10**9 + 40 * MS
    assert result.left_out == 20
    # The note is latched: it holds from the beginning on, though it came before.
    assert [(topic, t) for topic, t, _ in content(tmp_path / 'bag')[:3]] == [
        ('/applied_torque', begin_ns), ('/experiment', begin_ns), ('/hip_encoder', begin_ns + 1)
    ]  # fmt: skip
    assert not result.began_late


def test_stamps_of_another_clock_do_not_decide_where_the_bag_begins(tmp_path):
    recording = Recording(tmp_path / 'bag', TOPICS, False, ('/applied_torque', '/hip_encoder'))
    for topic in TOPICS:
        recording.announce(topic, [])
    for k in range(50):
        log = 2000 * 10**9 + 2 * MS * k
        recording.write('/applied_torque', joint_state(log, k), log, 0.0)
        if k >= 20:
            recording.write('/hip_encoder', joint_state(10**9 + 2 * MS * k, k), log + 1, 0.0)
    assert recording.begin() == 2000 * 10**9 + 40 * MS + 1
    assert recording.close().left_out == 21


def test_nothing_is_left_out_if_all_began_together_while_ready(tmp_path):
    recording = Recording(tmp_path / 'bag', TOPICS, False, ('/applied_torque', '/hip_encoder'))
    for topic in TOPICS:
        recording.announce(topic, [])
    for k in range(5):
        for delay, topic in ((0, '/applied_torque'), (30 * MS, '/hip_encoder')):
            recording.write(topic, joint_state(10**9 + k, k), 10**9 + 2 * MS * k + delay, 0.0)
    assert recording.begin(was_ready=True) == 0
    result = recording.close()
    assert (result.messages, result.left_out) == (10, 0)
    assert result.began_late == {'/hip_encoder': pytest.approx(0.03)}


def test_a_topic_that_never_began_is_told(tmp_path):
    recording = Recording(tmp_path / 'bag', TOPICS, False, ('/applied_torque', '/hip_encoder'))
    recording.announce('/applied_torque', [QOS])
    recording.write('/applied_torque', joint_state(10**9, 1), 2 * 10**9, 0.0)
    assert recording.silent == ('/hip_encoder',)
    assert recording.begin() == 0
    result = recording.close()
    assert result.began_late == {'/hip_encoder': None}
    assert result.remarks == ('/hip_encoder never began',)


def test_messages_that_were_received_late_are_told(tmp_path):
    recording = Recording(tmp_path / 'bag', TOPICS, by_stamp=False)
    recording.announce('/applied_torque', [QOS])
    for k, delay in enumerate((MS, 2 * MS, 61 * MS, MS)):
        stamp = 10**9 + 2 * MS * k
        recording.write('/applied_torque', joint_state(stamp, k), stamp + delay, 0.0)
    assert recording.close().received_late == {'/applied_torque': pytest.approx(0.06)}


def test_recovery_that_is_cut_off_can_be_repeated(tmp_path):
    journal(tmp_path / 'bag')
    work = tmp_path / 'bag' / '.recovering' / 'bag'
    work.mkdir(parents=True)
    (work / 'bag.mcap').write_bytes(b'half')
    assert recover(tmp_path / 'bag').messages > 380
    assert not (tmp_path / 'bag' / '.recovering').exists()
    (tmp_path / 'bag' / 'metadata.yaml').unlink()
    assert needs_recovery(tmp_path / 'bag')
    assert recover(tmp_path / 'bag').messages > 380


def test_a_single_file_becomes_a_bag_beside_it(tmp_path):
    journal(tmp_path / 'bag')
    shutil.move(tmp_path / 'bag' / JOURNAL_NAME, tmp_path / 'loose.mcap')
    assert needs_recovery(tmp_path / 'loose.mcap')
    assert recover(tmp_path / 'loose.mcap').path == tmp_path / 'loose'
    assert len(content(tmp_path / 'loose')) > 380
    assert (tmp_path / 'loose.mcap').is_file()


def test_nothing_to_recover_is_said(tmp_path, capsys):
    journal(tmp_path / 'bag').close()
    assert main([str(tmp_path / 'bag')]) == 0
    assert 'nothing to recover' in capsys.readouterr().out
    assert main([str(tmp_path / 'absent')]) == 1
    assert 'neither a bag directory nor' in capsys.readouterr().err


def test_an_empty_recording_leaves_nothing(tmp_path):
    recording = Recording(tmp_path / 'bag', TOPICS, by_stamp=False)
    assert recording.close().messages == 0
    assert not (tmp_path / 'bag').exists()


def test_recordings_are_never_overwritten(tmp_path):
    with pytest.raises(ValueError, match='never overwritten'):
        Recording(tmp_path, TOPICS, by_stamp=False)
