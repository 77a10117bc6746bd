"""Drives that follow positions: what they were told, and gains that are off."""

from dataclasses import replace

import numpy as np
import pytest
import yaml
from hanging_arm import nominal, urdf
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from cg_dynamics.errors import ModelError
from cg_dynamics.model import Model
from cg_dynamics.plant import Plant
from cg_dynamics.rig import Setup
from cg_interfaces import channels
from cg_interfaces.stamps import NS_PER_S
from cg_sysid.checks.recordings import check_recording
from cg_sysid.cli.new_robot import main as new_robot
from cg_sysid.diagnosis.diagnose import Options, diagnose
from cg_sysid.errors import RecordingError
from cg_sysid.identification.data_set import prepare
from cg_sysid.identification.identify import fit
from cg_sysid.records.bags import read_bag, write_bag

STORE = get_typestore(Stores.ROS2_JAZZY)
JOINT_STATE = 'sensor_msgs/msg/JointState'
CONTROLLER_STATE = 'control_msgs/msg/JointTrajectoryControllerState'
STORE.register(
    {
        **get_types_from_msg(
            'std_msgs/Header header\nstring[] joint_names\n'
            'trajectory_msgs/JointTrajectoryPoint reference\n'
            'trajectory_msgs/JointTrajectoryPoint feedback\n',
            CONTROLLER_STATE,
        ),
    }
)
START = 1_700_000_000 * NS_PER_S
JOINTS = ('hip_joint', 'thigh_joint', 'shank_joint')
GAINS = {
    'hip_joint': {'stiffness': 90.0, 'damping': 4.0},
    'thigh_joint': {'stiffness': 80.0, 'damping': 3.0},
    'shank_joint': {'stiffness': 40.0, 'damping': 1.5},
}
NOTE = {'setup': {}, 'position_control': '/joint_commands'}


@pytest.fixture(scope='module')
def robot():
    return channels.interface(nominal().mechanism)


def header(stamp):
    types = STORE.types
    time = types['builtin_interfaces/msg/Time'](sec=stamp // NS_PER_S, nanosec=stamp % NS_PER_S)
    return types['std_msgs/msg/Header'](stamp=time, frame_id='')


def joint_state(stamp, **fields):
    given = {
        f: np.ascontiguousarray(fields.get(f, []), float)
        for f in ('position', 'velocity', 'effort')
    }
    return STORE.types[JOINT_STATE](header=header(stamp), name=list(JOINTS), **given)


def controller_state(stamp, position):
    types = STORE.types
    none = np.array([])
    zero = types['builtin_interfaces/msg/Duration'](sec=0, nanosec=0)
    point = types['trajectory_msgs/msg/JointTrajectoryPoint'](
        positions=np.asarray(position, float), velocities=none, accelerations=none, effort=none,
        time_from_start=zero,
    )  # fmt: skip
    return types[CONTROLLER_STATE](
        header=header(stamp), joint_names=list(JOINTS), reference=point, feedback=point
    )


def write(path, states, commands, note=NOTE, topic='/joint_commands', also=()):
    """A bag of messages, each by its instant in s."""
    every = {'/joint_states': (JOINT_STATE, states)}
    if commands:
        kind = CONTROLLER_STATE if 'controller' in topic else JOINT_STATE
        every[topic] = kind, commands
    every |= {name: (JOINT_STATE, rows) for name, rows in also}
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        told = writer.add_connection('/experiment', 'std_msgs/msg/String', typestore=STORE)
        text = STORE.types['std_msgs/msg/String'](data=yaml.safe_dump(note))
        writer.write(told, START, STORE.serialize_cdr(text, 'std_msgs/msg/String'))
        for name, (kind, rows) in every.items():
            connection = writer.add_connection(name, kind, typestore=STORE)
            for time, make in rows:
                stamp = START + round(1e9 * time)
                writer.write(connection, stamp, STORE.serialize_cdr(make(stamp), kind))
    return path


def positions(times, values, make=joint_state):
    return [(t, lambda s, v=v: make(s, position=v) if make is joint_state else make(s, v))
            for t, v in zip(times, values, strict=True)]  # fmt: skip


def ways(times):
    """Where each joint is, or is told to be, rad, shape (n, 3)."""
    t = np.asarray(times)[:, None]
    return np.array([0.4, 0.3, -0.5]) * np.sin(np.array([2.0, 3.1, 4.3]) * t + [0.3, 1.0, 2.0])


def followed(stiffness=1.0, damping=1.0):
    """The robot with its drives' gains, times these."""
    model = nominal()
    for joint, gains in GAINS.items():
        model = model.with_effect(
            'position_control', joint, stiffness=stiffness * gains['stiffness'],
            damping=damping * gains['damping'],
        )  # fmt: skip
    return model


@pytest.mark.parametrize('topic', ['/joint_commands', '/arm_controller/controller_state'])
def test_commands_are_held_from_message_to_message(robot, tmp_path, topic):
    times, told = np.arange(0, 2, 0.004), np.arange(-0.013, 2, 0.01)
    make = joint_state if topic == '/joint_commands' else controller_state
    note = {'setup': {}, 'position_control': topic}
    bag = write(
        tmp_path / 'bag', positions(times, ways(times)),
        positions(told, ways(told), make), note, topic,
    )  # fmt: skip
    found = read_bag(bag, mechanism=robot)
    since = (found.stamp_ns - START) / NS_PER_S
    held = ways(told)[np.searchsorted(told, since + 1e-7, side='right') - 1]
    for k, joint in enumerate(JOINTS):
        np.testing.assert_array_equal(found.inputs[f'{joint}_commanded_position'], held[:, k])
        assert not found.inputs[f'{joint}_commanded_velocity'].any()
        assert not found.inputs[f'{joint}_effort'].any()
    again = read_bag(write_bag(tmp_path / 'again', found), mechanism=robot)
    assert again.inputs.keys() == found.inputs.keys()
    for name, values in found.inputs.items():
        np.testing.assert_array_equal(again.inputs[name], values)


def test_the_rate_and_the_torque_of_a_command_are_read(robot, tmp_path):
    times = np.arange(0, 1, 0.004)
    told = [(t, lambda s: joint_state(s, position=[0.2] * 3, velocity=[0, 0.5, 0],
                                      effort=[np.nan, np.nan, np.nan]))
            for t in times]  # fmt: skip
    bag = write(tmp_path / 'bag', positions(times, ways(times)), told)
    found = read_bag(bag, mechanism=robot)
    assert np.all(found.inputs['thigh_joint_commanded_velocity'] == 0.5)
    assert not found.inputs['thigh_joint_effort'].any()  # NaN throughout: none was told


def test_efforts_are_the_input_where_the_note_says_nothing_of_positions(robot, tmp_path):
    times = np.arange(0, 1, 0.004)
    effort = [(t, lambda s: joint_state(s, effort=[1.0, 2.0, 3.0])) for t in times]
    bag = write(
        tmp_path / 'bag', positions(times, ways(times)), positions(times, ways(times)),
        {'setup': {}}, also=[('/applied_torque', effort)],
    )  # fmt: skip
    found = read_bag(bag, mechanism=robot)
    assert set(found.inputs) == {f'{joint}_effort' for joint in JOINTS}
    assert np.all(found.inputs['thigh_joint_effort'] == 2.0)


def test_a_recording_and_a_model_that_do_not_fit_are_told(robot, tmp_path):
    times = np.arange(0, 1, 0.004)
    told = read_bag(
        write(tmp_path / 'told', positions(times, ways(times)), positions(times, ways(times))),
        mechanism=robot,
    )  # fmt: skip
    with pytest.raises(
        ValueError, match=r'told positions, but the model .leg. has no position_co'
    ):
        prepare(nominal(), [told])
    torques = replace(told, inputs={n: v for n, v in told.inputs.items() if 'effort' in n})
    with pytest.raises(ValueError, match='no commanded positions were read: `position_control`'):
        prepare(followed(), [torques])
    prepare(followed(), [told])


def test_commands_that_are_missing_or_no_numbers_are_refused(robot, tmp_path):
    times = np.arange(0, 1, 0.004)
    states, told = positions(times, ways(times)), ways(times)
    note = {'setup': {}, 'position_control': '/elsewhere'}
    bag = write(tmp_path / 'elsewhere', states, positions(times, told), note)
    with pytest.raises(RecordingError, match='position_control in the note names /elsewhere'):
        read_bag(bag, mechanism=robot)
    told[17, 1] = np.nan
    bag = write(tmp_path / 'nan', states, positions(times, told))
    with pytest.raises(RecordingError, match=r'position\[thigh_joint\] is nan at sample 17'):
        read_bag(bag, mechanism=robot)
    with pytest.raises(RecordingError, match='drives of a pendulum are told torques'):
        read_bag(bag, mechanism=channels.mechanism('pendulum'))


def test_a_new_model_file_has_the_loops_of_drives_that_were_told_positions(robot, tmp_path):
    times = np.arange(0, 2, 0.004)
    told = ways(times) * [1, 0, 1]  # nobody ever told the thigh anything else than 0
    bag = write(tmp_path / 'bag', positions(times, ways(times)), positions(times, told))
    (tmp_path / 'leg.urdf').write_text(urdf())
    out = tmp_path / 'leg.yaml'
    words = [str(tmp_path / 'leg.urdf'), '--joint-states', str(bag), '--out', str(out)]
    assert new_robot(words) == 0
    loops = [effect for effect in Model.load(out).effects if effect.name == 'position_control']
    assert [effect.site for effect in loops] == ['hip_joint', 'shank_joint']
    text = out.read_text()
    assert 'state the gains of the drive' in text
    adding = text.replace('# - {name: integral_control', '- {name: integral_control')
    added = [e.site for e in Model.from_text(adding).effects if e.name == 'integral_control']
    assert added == ['hip_joint', 'shank_joint']


def test_a_simulated_machine_says_that_it_takes_torques():
    with pytest.raises(ModelError, match='takes torques, not hip_joint_commanded_position'):
        Plant(followed(), Setup())


def codes(report, severity='error'):
    return {(f.code, f.where) for f in report.findings if f.severity == severity}


def checked(tmp_path, states, commands):
    model = tmp_path / 'model.yaml'
    model.write_text(followed().text())
    bag = write(tmp_path / 'bag', states, commands)
    return check_recording(bag, model)


def lagging(times):
    return ways(times - 0.04) + 5e-5 * np.random.default_rng(1).standard_normal((len(times), 3))


TIMES = np.arange(0, 6, 0.004)
NONE = np.zeros(3)


def test_check_says_how_late_a_joint_follows(tmp_path):
    report = checked(tmp_path, positions(TIMES, lagging(TIMES)), positions(TIMES, ways(TIMES)))
    assert not codes(report)
    lags = {f.where: f.value for f in report.findings if f.code == 'follows'}
    assert lags == {f'{joint}_position': pytest.approx(0.04, abs=0.0051) for joint in JOINTS}


@pytest.mark.parametrize(
    ('spoil', 'expected'),
    [
        (lambda q: q * [1, -1, 1], {('sign_error', 'thigh_joint_position')}),
        (lambda q: np.degrees(q), {('unit', f'{joint}_position') for joint in JOINTS}),
        (lambda q: q[:, [1, 0, 2]], {('joints_swapped', 'hip_joint_position'),
                                     ('joints_swapped', 'thigh_joint_position')}),
    ],
    ids=['sign', 'degrees', 'swapped'],
)  # fmt: skip
def test_check_knows_ways_that_are_not_those_told(tmp_path, spoil, expected):
    states = positions(TIMES, spoil(lagging(TIMES)))
    assert codes(checked(tmp_path, states, positions(TIMES, ways(TIMES)))) == expected


def following(
    tmp_path, robot, seconds=6.0, count=2, scale=1.0, law=lambda q, v: 0.0, integral=NONE,
    holding=NONE,
):  # fmt: skip
    """MuJoCo's robot follows positions; a drive that reads its own encoder."""
    mujoco_tree = pytest.importorskip('mujoco_tree', reason='MuJoCo is not installed')
    k = scale * np.array([GAINS[j]['stiffness'] for j in JOINTS])
    d = scale * np.array([GAINS[j]['damping'] for j in JOINTS])
    records = []
    for seed in range(1, count + 1):
        at, start = mujoco_tree.wander(np.random.default_rng(seed), 3, np.full(3, 0.8), 0.2, 1.2)
        told = np.arange(0, seconds, 0.01)
        commands = np.array([at(t)[0] for t in told])

        total, before = holding.copy(), [0.0, NONE, start]

        def tells(time, q, v, commands=commands, total=total, before=before):
            since, told, place = before  # as a drive adds up, of what it was told since then
            total += integral * (time - since) * (told - (place + q) / 2)
            before[:] = time, commands[int(time / 0.01 + 1e-6)], q
            return before[1]

        def follows(time, q, v, held, total=total, before=before):
            # What is held is applied as a torque; here it is where to be.
            summed = total + integral * (time - before[0]) * (held - q)
            return k * (held - q) - d * v + summed + law(q, v) - held

        made = mujoco_tree.record(
            urdf(), JOINTS, tells, seconds - 0.01, start,
            mujoco_tree.Secret(torque=follows, damping=dict(zip(JOINTS, DAMPING, strict=True))),
            noise=5e-5, counts=2**17 / (2 * np.pi), seed=seed,
        )  # fmt: skip
        bag = write(
            tmp_path / f'bag_{seed}', positions(made.time[:-1], made.position[:-1]),
            positions(told, commands),
        )  # fmt: skip
        records.append(read_bag(bag, mechanism=robot))
    return records


DAMPING = (0.2, 0.15, 0.1)  # N m s/rad


def without_dry_friction(model):
    return model.with_values({f'coulomb_friction@{joint}.torque': 0.0 for joint in JOINTS})


def test_a_robot_follows_in_simulation_as_in_mujoco(robot, tmp_path):
    records = following(tmp_path, robot)
    model = without_dry_friction(followed())
    found = fit(model, prepare(model, records), only=[])
    # The loop keeps what is simulated on its way for the whole record: noise is all that is left.
    assert found.normalised_error < 1.1  # 1.07: rounding to counts is not quite white


def test_gains_that_are_off_are_found(robot, tmp_path):
    records = following(tmp_path, robot)
    model = without_dry_friction(followed(stiffness=0.85, damping=1.2))
    only = [n for n in model.declarations if n.startswith('position_control')]
    found = fit(model, prepare(model, records), only=only)
    values = dict(zip([u.name for u in found.unknowns], found.values, strict=True))
    assert found.normalised_error < 1.1  # 1.07: rounding to counts is not quite white
    for joint, gains in GAINS.items():
        for name, value in gains.items():
            assert values[f'position_control@{joint}.{name}'] == pytest.approx(value, rel=0.01)


@pytest.mark.slow
@pytest.mark.parametrize(
    ('law', 'expected'),
    [
        (lambda q, v: 0.0, []),
        pytest.param(
            lambda q, v: np.array([0.0, 0.35, 0.0]), ['torque_bias@thigh_joint'],
            marks=pytest.mark.evidence,
        ),
        pytest.param(
            lambda q, v: np.array([0.0, 0.0, -0.05 * v[2] * abs(v[2])]),
            ['quadratic_friction@shank_joint'], marks=pytest.mark.evidence,
        ),
    ],
    ids=['sound', 'bias', 'quadratic'],
)  # fmt: skip
def test_what_a_robot_lacks_that_follows_positions_is_named(robot, tmp_path, law, expected):
    records = following(tmp_path, robot, count=4, law=law)
    effects = (
        'torque_bias', 'encoder_offset', 'quadratic_friction', 'viscous_friction',
        'integral_control',
    )  # fmt: skip
    found = diagnose(followed(), records, Options(effects=effects, workers=1))
    assert [cause.label for cause in found.causes] == expected
    assert found.verdict == ('explained' if expected else 'consistent')


@pytest.mark.evidence
@pytest.mark.slow
def test_the_integral_part_of_a_drive_is_named(robot, tmp_path):
    """It holds a torque already as the recordings begin, which nobody told."""
    gain = np.array([0.0, 260.0, 0.0])
    records = following(tmp_path, robot, count=4, integral=gain, holding=np.array([0.0, 1.5, 0.0]))
    effects = ('torque_bias', 'encoder_offset', 'viscous_friction', 'integral_control')
    found = diagnose(followed(), records, Options(effects=effects, workers=1))
    (cause,) = found.causes
    assert cause.label == 'integral_control@thigh_joint'
    assert found.verdict == 'explained'
    value, sigma, *_ = cause.parameters['gain']
    # Of torques and inertias only the ratio is known, and bodies are believed to 15 %.
    assert value == pytest.approx(260.0, abs=2 * sigma)
    assert 0 < sigma < 0.15 * 260.0


@pytest.mark.slow
@pytest.mark.evidence
def test_the_integral_parts_of_all_drives_are_named(robot, tmp_path):
    """Each hides what the others would gain."""
    records = following(
        tmp_path, robot, count=4, integral=np.array([220.0, 260.0, 90.0]),
        holding=np.array([0.5, 1.5, -0.3]),
    )  # fmt: skip
    effects = ('torque_bias', 'encoder_offset', 'viscous_friction', 'payload', 'integral_control')
    found = diagnose(followed(), records, Options(effects=effects, workers=1))
    assert {c.label for c in found.causes} == {f'integral_control@{joint}' for joint in JOINTS}
    assert found.verdict == 'explained'


def test_drives_that_all_add_up_are_identified_from_any_gains(robot, tmp_path):
    """What they hold is no torque that somebody measured: it may not lead the masses astray."""
    gains = dict(zip(JOINTS, (220.0, 260.0, 90.0), strict=True))
    records = following(
        tmp_path, robot, count=2, integral=np.array([*gains.values()]),
        holding=np.array([0.5, 1.5, -0.3]),
    )  # fmt: skip
    model = without_dry_friction(followed())
    for joint, gain in gains.items():
        model = model.with_effect('integral_control', joint, gain=0.4 * gain)
    only = [n for n in model.declarations if n.startswith('integral_control')]
    found = fit(model, prepare(model, records), only=only)
    assert found.normalised_error < 1.15  # rounding to counts is not quite white
    for unknown, value in zip(found.unknowns, found.values, strict=True):
        joint = unknown.name.partition('@')[2].partition('.')[0]
        assert value == pytest.approx(gains[joint], rel=0.001)
    assert fit(model, prepare(model, records)).normalised_error < 1.15  # bodies too
