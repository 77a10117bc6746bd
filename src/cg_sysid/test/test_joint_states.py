"""Recordings of a robot that no table knows: everything it says stands on /joint_states."""

from dataclasses import replace

import numpy as np
import pytest
import yaml
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore
from two_joint_arm import ARM, FILE, TwoJointArm, arm, install

from cg_dynamics.rig import Setup
from cg_interfaces import channels
from cg_interfaces.stamps import NS_PER_S
from cg_sysid.checks.loading import load_bags
from cg_sysid.checks.recordings import check_recording, main
from cg_sysid.errors import RecordingError
from cg_sysid.experiments.rehearsal import rehearse
from cg_sysid.identification.data_set import prepare
from cg_sysid.identification.identify import fit
from cg_sysid.records.bags import read_bag, read_raw, to_record, write_bag

STORE = get_typestore(Stores.ROS2_JAZZY)
START = 1_300_000_000 * NS_PER_S
JOINTS = ('gripper', 'elbow', 'shoulder')  # in the order of the messages
NOTE = {'setup': {}, 'initial_state': 'moving', 'zeroed_at': '2011-03-13T07:00:00Z'}


@pytest.fixture
def swing(monkeypatch):
    """Three seconds of the arm under torque."""
    install(monkeypatch)
    record = rehearse(
        'swing', arm(), Setup(), [0.3, 0.0, 0.0, 0.0],
        [lambda t: 0.8 * np.sin(5.0 * t) + 0.6 * np.sin(13.0 * t)], 3.0, 0.004, 1,
    )  # fmt: skip
    return replace(record, stamp_ns=START + record.stamp_ns)


def fields_of(record):
    """Field -> values by message and joint, as a broadcaster of ros2_control fills them."""
    fields = {f: np.full((len(record), 3), np.nan) for f in ('position', 'velocity', 'effort')}
    for name, values in {**record.inputs, **record.outputs}.items():
        joint, field = name.split('_')
        fields[field][:, JOINTS.index(joint)] = values
    fields['position'][:, 0] = 0.02
    return fields


def joint_state(stamp, names, fields):
    types = STORE.types
    time = types['builtin_interfaces/msg/Time'](sec=stamp // NS_PER_S, nanosec=stamp % NS_PER_S)
    header = types['std_msgs/msg/Header'](stamp=time, frame_id='')
    return types['sensor_msgs/msg/JointState'](header=header, name=list(names), **fields)


def write(path, record, *, names=JOINTS, note=NOTE, torque=None, keep=None, **changed):
    """A bag as `ros2 bag record` leaves it; `changed` are fields other than those measured."""
    fields = {**fields_of(record), **changed}
    msgtype = 'sensor_msgs/msg/JointState'
    writer = Writer(path, version=9, storage_plugin=StoragePlugin.MCAP)
    with writer:
        if note is not None:
            told = writer.add_connection('/experiment', 'std_msgs/msg/String', typestore=STORE)
            text = STORE.types['std_msgs/msg/String'](data=yaml.safe_dump(note))
            writer.write(told, START, STORE.serialize_cdr(text, 'std_msgs/msg/String'))
        states = writer.add_connection('/joint_states', msgtype, typestore=STORE)
        applied = torque and writer.add_connection('/applied_torque', msgtype, typestore=STORE)
        for k in range(len(record)) if keep is None else keep:
            stamp = int(record.stamp_ns[k])
            row = {name: np.array(values[k], dtype=float) for name, values in fields.items()}
            message = joint_state(stamp, names, row)
            writer.write(states, stamp, STORE.serialize_cdr(message, msgtype))
            if torque:
                empty = np.array([])
                row = {'position': empty, 'velocity': empty, 'effort': np.array([torque])}
                message = joint_state(stamp, ['shoulder'], row)
                writer.write(applied, stamp, STORE.serialize_cdr(message, msgtype))
    return path


def codes(report, severity):
    return {f.code for f in report.findings if f.severity == severity}


def test_effort_on_joint_states_is_the_input(swing, tmp_path):
    back = read_bag(write(tmp_path / 'bag', swing), mechanism=ARM)
    assert back.mechanism == ARM
    assert set(back.inputs) == {'shoulder_effort'}
    for name, values in {**swing.inputs, **swing.outputs}.items():
        np.testing.assert_array_equal({**back.inputs, **back.outputs}[name], values)


def test_an_applied_torque_goes_before_the_effort(swing, tmp_path):
    raw = read_raw(write(tmp_path / 'bag', swing, torque=0.25), mechanism=ARM)
    assert raw.torque_topic == '/applied_torque'
    assert 'shoulder_effort' not in raw.topics['/joint_states'].values
    assert np.all(to_record(raw).inputs['shoulder_effort'] == 0.25)


def test_currents_become_torques_by_the_gain_in_the_note(swing, tmp_path):
    amperes = fields_of(swing)['effort'] / -11.1
    note = {**NOTE, 'effort_gain': {'shoulder': -11.1}}
    back = read_bag(write(tmp_path / 'bag', swing, note=note, effort=amperes), mechanism=ARM)
    np.testing.assert_allclose(
        back.inputs['shoulder_effort'], swing.inputs['shoulder_effort'], rtol=1e-12
    )


def test_a_gain_is_of_efforts_on_joint_states_alone(swing, tmp_path):
    note = {**NOTE, 'effort_gain': {'shoulder': -11.1}}
    back = read_bag(write(tmp_path / 'bag', swing, note=note, torque=0.25), mechanism=ARM)
    assert np.all(back.inputs['shoulder_effort'] == 0.25)
    # Written once more it is a torque, and stays one.
    again = read_bag(write_bag(tmp_path / 'again', back), mechanism=ARM)
    assert np.all(again.inputs['shoulder_effort'] == 0.25)


@pytest.mark.parametrize(
    ('gains', 'message'),
    [
        ({'elbow': 2.0}, "effort_gain of 'elbow'; joints with a drive: shoulder$"),
        ({'shoulder': 0.0}, "effort_gain of 'shoulder' is 0; any other number is allowed"),
        ({'shoulder': 'strong'}, 'effort_gain.shoulder.*a finite number is needed'),
    ],
)
def test_a_gain_that_makes_no_torque_is_refused(swing, tmp_path, gains, message):
    bag = write(tmp_path / 'bag', swing, note={**NOTE, 'effort_gain': gains})
    with pytest.raises(RecordingError, match=message):
        read_bag(bag, mechanism=ARM)


def test_an_effort_that_comes_now_and_then_is_held(swing, tmp_path):
    effort = [row if k % 5 == 0 else [] for k, row in enumerate(fields_of(swing)['effort'])]
    back = read_bag(write(tmp_path / 'bag', swing, effort=effort), mechanism=ARM)
    rare = swing.inputs['shoulder_effort'][::5]
    np.testing.assert_array_equal(back.inputs['shoulder_effort'], np.repeat(rare, 5))


def test_what_a_joint_never_reports_is_left_out(swing, tmp_path):
    fields = fields_of(swing)
    fields['velocity'][:, JOINTS.index('elbow')] = np.nan
    path = write(tmp_path / 'bag', swing, velocity=fields['velocity'])
    assert 'elbow_velocity' not in read_bag(path, mechanism=ARM).outputs
    report = check_recording(read_raw(path, mechanism=ARM))
    (finding,) = (f for f in report.findings if 'elbow_velocity' in f.text)
    assert finding.text == 'holds no velocity[elbow] (elbow_velocity)'


@pytest.mark.parametrize(
    ('changed', 'message'),
    [
        (lambda f: f['effort'].fill(np.nan), 'or effort on /joint_states.* is needed'),
        (lambda f: f['effort'][9:10].fill(np.nan), r'effort\[shoulder\] is nan at sample 9'),
        (lambda f: f['position'][9:10].fill(np.nan), r'position\[shoulder\] is nan at sample 9'),
        (lambda f: f['effort'].resize((750, 2), refcheck=False), '2 values for 3 joint names'),
    ],
)
def test_bad_messages_get_one_clear_error(swing, tmp_path, changed, message):
    fields = fields_of(swing)
    changed(fields)
    path = write(tmp_path / 'bag', swing, **fields)
    with pytest.raises(RecordingError, match=message):
        read_bag(path, mechanism=ARM)


def test_other_names_of_the_joints_are_told(swing, tmp_path):
    path = write(tmp_path / 'bag', swing, names=('a', 'b', 'c'))
    wanted = r'no value that the analysis reads \(position\[shoulder\], position\[elbow\], '
    with pytest.raises(RecordingError, match='effort on /joint_states'):
        read_bag(path, mechanism=ARM)
    with pytest.raises(RecordingError, match=wanted):
        read_bag(write(tmp_path / 'two', swing, names=('a', 'b', 'c'), torque=0.1), mechanism=ARM)


def test_the_model_says_what_a_bag_does_not(swing, tmp_path, capsys):
    model = tmp_path / 'arm.yaml'
    model.write_text(FILE)
    bags = [
        write(tmp_path / 'silent', swing, note=None),
        write(tmp_path / 'named', swing, note={**NOTE, 'mechanism': 'two_joint_arm'}),
    ]
    assert main(['--model', str(model), *map(str, bags)]) == 0
    assert main([str(bags[0])]) == 1
    assert 'nothing says which mechanism was recorded' in ' '.join(capsys.readouterr().out.split())
    records = load_bags(bags, model).records
    assert [record.mechanism for record in records] == [ARM, ARM]


def test_a_robot_of_no_table_needs_its_model(tmp_path, monkeypatch):
    with monkeypatch.context() as known:
        install(known)
        record = rehearse('rest', arm(), Setup(), [0.0] * 4, [lambda t: 0.0], 0.1)
    path = write_bag(tmp_path / 'bag', record)
    with pytest.raises(RecordingError, match="unknown mechanism 'two_joint_arm'"):
        read_bag(path)
    assert read_bag(path, mechanism=ARM).mechanism == ARM
    pendulum = channels.mechanism('pendulum')
    with pytest.raises(RecordingError, match="unknown mechanism 'two_joint_arm'"):
        read_bag(path, mechanism=pendulum)


def test_a_bag_that_names_another_robot_is_refused(swing, tmp_path):
    model = tmp_path / 'arm.yaml'
    model.write_text(FILE)
    note = {**NOTE, 'mechanism': 'pendulum'}
    path = write(tmp_path / 'bag', swing, note=note, names=('gripper', 'elbow', 'joint'))
    with pytest.raises(
        ValueError, match="recorded on a pendulum, but the model 'arm' is of a two_joint"
    ):
        load_bags([path], model)


def test_joints_tell_robots_of_one_name_apart(swing):
    class Deaf(TwoJointArm):
        outputs = TwoJointArm.outputs[:2]
        output_units = TwoJointArm.output_units[:2]

        def sensors(self, q, v):
            return {'shoulder_position': q[0], 'elbow_position': q[1]}

    prepare(arm(), [swing])
    model = replace(arm(), mechanism=Deaf())
    with pytest.raises(
        ValueError, match=r'only one has elbow_velocity \(velocity\[elbow\], rad/s'
    ):
        prepare(model, [swing])


def test_what_is_written_comes_back(swing, tmp_path):
    outputs = {name: v.copy() for name, v in swing.outputs.items() if name != 'elbow_velocity'}
    for values in outputs.values():
        values[5] = np.nan  # a message that was lost
    outputs['shoulder_velocity'][6] = outputs['shoulder_velocity'][7] = np.nan
    record = replace(swing, outputs=outputs)
    back = read_bag(write_bag(tmp_path / 'bag', record), mechanism=ARM)
    assert back.outputs.keys() == outputs.keys()
    for name, values in outputs.items():
        np.testing.assert_array_equal(back.outputs[name], values)


def test_the_friction_of_an_arm_is_identified(swing, tmp_path):
    path = tmp_path / 'arm.yaml'
    path.write_text(FILE.replace('value: 0.05', 'value: 0.15'))
    loaded = load_bags([write(tmp_path / 'bag', swing, note=None)], path)
    found = fit(arm(), prepare(arm(), loaded.records))
    index = [u.name for u in found.unknowns].index('viscous_friction.coefficient')
    # Within four of its standard deviations.
    assert abs(found.values[index] - 0.05) < 4 * np.sqrt(found.covariance[index, index]) < 0.01


def raw_of(record, tmp_path, **more):
    return read_raw(write(tmp_path / 'bag', record, **more), mechanism=ARM)


def test_a_sound_recording_passes(swing, tmp_path):
    note = {**NOTE, 'nominal_rate_hz': 250.0}
    report = check_recording(raw_of(swing, tmp_path, note=note))
    assert report.verdict == 'good', [f.text for f in report.findings]
    assert ('topic_missing', 'info') in {(f.code, f.severity) for f in report.findings}


def spoilt(field, joint, change):
    def spoil(record):
        fields = fields_of(record)
        column = fields[field][:, JOINTS.index(joint)]
        column[:] = change(column, record.time)
        return {field: fields[field]}

    return spoil


@pytest.mark.parametrize(
    ('spoil', 'code', 'where'),
    [
        (spoilt('position', 'elbow', lambda v, t: v + 0.1 * (t > 1.5)),
         'zero_shift', 'elbow_position'),
        (spoilt('effort', 'shoulder', lambda v, t: -v), 'sign_error', 'shoulder_effort'),
        (spoilt('position', 'shoulder', lambda v, t: np.clip(v, -0.25, 0.25)),
         'sensor_clipping', 'shoulder_position'),
        (lambda record: {'keep': np.flatnonzero((record.time < 1.0) | (record.time > 1.3))},
         'dropped_samples', '/joint_states'),
    ],
)  # fmt: skip
def test_faults_of_a_topic_that_is_input_and_output_are_found(swing, tmp_path, spoil, code, where):
    report = check_recording(raw_of(swing, tmp_path, **spoil(swing)))
    assert (code, where) in {(f.code, f.where) for f in report.findings if f.severity == 'error'}


def test_few_lost_messages_do_no_harm(swing, tmp_path):
    keep = np.delete(np.arange(len(swing)), [100, 300, 301, 555])
    raw = raw_of(swing, tmp_path, keep=keep)
    report = check_recording(raw)
    (found,) = (f for f in report.findings if f.code == 'dropped_samples')
    assert (found.severity, found.where) == ('warning', '/joint_states')
    assert found.repair == (
        'they are left out; 4 sample(s) of the torque filled from their neighbours'
    )
    record = to_record(raw)
    assert len(record) == len(swing)
    assert np.isnan(record.outputs['shoulder_position']).sum() == 4
