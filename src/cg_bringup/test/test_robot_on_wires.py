"""The whole robot live, on a serial line and a CAN bus, with emulated devices on their other ends.

What the drive was told is read from the drive.
"""

import os
import signal
import time
from dataclasses import replace

import pytest

pytest.importorskip('rclpy')
pytest.importorskip('canopen')
pytest.importorskip('serial')

import wired_robot
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from wired_robot import FAULTS, connected, options_in

from cg_bringup.robot_run import robot_nodes
from cg_bringup.runs import NodeOf
from cg_hardware.emulators.robot import INDEX
from cg_interfaces import topics
from cg_interfaces.ros import LATCHED_QOS, SENSOR_QOS
from cg_sysid import Model, Options, diagnose, read_bag

pytestmark = [pytest.mark.alone, pytest.mark.slow]

AT_MOST = 0.02  # s from a fault to zero torque at the drive
SPREAD = 0.01  # s: the instant of a fault is known from outside by reports of the emulation
HELD_UP = 0.01  # s by which a host may hold the emulation up for deadlines to mean anything


@pytest.fixture
def standing():
    """Emulated robot, person, processes by name: it balances."""
    with wired_robot.standing() as (robot, person, nodes):
        report = seen(robot)
        assert report['farthest'] < 0.1, report
        assert len(report['changes']) > 100
        yield robot, person, nodes


def seen(robot):
    """How the robot is, from a host that keeps time."""
    report = robot.report()
    if report['late'] > HELD_UP:
        pytest.skip(f'the host held the emulation up by {report["late"]:.3f} s')
    return report


def test_it_stands_is_pushed_and_stands(standing):
    robot, person, _ = standing
    robot.ask('push 0.5')
    person.wait(3.0)
    report = seen(robot)
    assert abs(report['lean']) < 0.02
    assert report['farthest'] < 0.2
    assert person.stage == 'active'


ALWAYS = 'drive_fault', 'imu_unplugged', 'drive_killed', 'balance_killed'


@pytest.mark.parametrize('fault', [
    pytest.param(name, marks=() if name in ALWAYS else pytest.mark.evidence) for name in FAULTS
])  # fmt: skip
def test_whatever_happens_the_torque_is_zero_in_time_and_stays_zero(standing, fault):
    robot, person, nodes = standing
    robot.ask('push 0.4')  # so that there is a torque to take off
    person.wait(0.05)
    before = robot.report()
    assert before['acting'] != 0
    FAULTS[fault](robot, nodes)
    person.wait(0.3)
    report = seen(robot)
    at, torque = report['changes'][-1]
    assert (report['acting'], torque) == (0, 0)
    assert at - before['time'] < AT_MOST + SPREAD
    if fault == 'balance_stopped':
        os.kill(nodes['balance'].pid, signal.SIGCONT)
    robot.ask('imu_back')
    robot.ask('can_back')
    person.wait(1.0)
    assert robot.report()['changes'] == []


@pytest.mark.evidence
def test_homing_moves_the_zero_and_no_rate_comes_of_it(tmp_path):
    nodes = robot_nodes(options_in(tmp_path))
    nodes['observer'] = replace(nodes['observer'], parameters={
        **nodes['observer'].parameters, 'stance': 'inner',
    })  # fmt: skip
    words = '--model compass_gait_mit --state 0 0 --setup'.split()
    with connected(nodes, tmp_path, *words, SETUP) as (robot, person, _):
        states, zero = [], ['']
        person.node.create_subscription(JointState, topics.STATE, states.append, SENSOR_QOS)
        person.node.create_subscription(
            String, topics.ZERO_STATE, lambda m: zero.append(m.data), LATCHED_QOS
        )
        person.until(lambda: person.stage == 'idle' and len(states) > 500)
        # The encoder woke up at some count, 3.9 rad from where the legs are parallel.
        assert states[-1].position[0] - states[-1].position[1] == pytest.approx(3.88, abs=0.05)
        for _ in range(5):  # a busy machine ends a homing
            assert person.press('/drive/home').success
            person.until(lambda: zero[-1].startswith('known') or 'failed' in zero[-1])
            if zero[-1].startswith('known'):
                break
        robot.ask('hold')
        states.clear()
        person.until(lambda: len(states) > 1000)
        report = robot.report()
    hips = [m.position[0] - m.position[1] for m in states[500:]]
    assert hips[-1] == pytest.approx(report['hip'] - INDEX, abs=5e-3)
    # Of a jump of 3.9 rad in 2 ms they would be hundreds of rad/s.
    assert max(abs(rate) for m in states for rate in m.velocity) < 3.0


DELAY = 0.009  # s that the emulated drive's current takes, and nobody knows of
SETUP = 'stance: inner\nfixture: inner_fixed\n'
NOTE = """
format: cg_recording/1
experiment: swing_inner_fixed
mechanism: compass_gait
setup: {stance: inner, fixture: inner_fixed}
nominal_rate_hz: 500.0
initial_state: unknown
sensor_zeros: {imu_angle: 0.0, hip_angle: 0.0}
zeroed_at: '%s'
"""


def record(folder, model_file, seed):
    """One experiment through the wires; the bag."""
    bag = folder / f'swing_{seed}'
    words = f'--model {model_file} --state 0 0 --seed {seed}'.split()
    nodes = robot_nodes(options_in(folder))
    del nodes['observer'], nodes['balance']
    nodes['safety_gate'] = replace(nodes['safety_gate'], parameters={
        **nodes['safety_gate'].parameters, 'fall_angle': 0.0,
    })  # fmt: skip
    nodes['excitation'] = NodeOf('cg_sysid', 'excitation_node', {
        'kind': 'multisine', 'amplitude': 6.0, 'f_min': 0.1, 'f_max': 3.0, 'duration': 12.0,
        'seed': seed,
    }, ((topics.TORQUE_COMMAND, topics.TORQUE_REQUEST),))  # fmt: skip
    nodes['recorder'] = NodeOf('cg_sysid', 'recorder_node', {'bag': str(bag)}, ending=10.0)
    with connected(nodes, folder, *words, '--setup', SETUP) as (robot, person, _):
        robot.ask('can_jitter_ms 1')
        robot.ask('usb_ms 4')
        note = person.node.create_publisher(String, topics.EXPERIMENT, LATCHED_QOS)
        note.publish(String(data=NOTE % time.strftime('%Y-%m-%dT%H:%M:%SZ', time.gmtime())))
        person.until(lambda: person.stage == 'idle')
        person.until(lambda: person.press('/drive/zero').success)  # it hangs still
        assert person.press('/safety_gate/arm').success
        person.until(lambda: person.stage == 'active')
        assert person.press('/drive/enable').success
        person.wait(9.0)
    return bag


@pytest.mark.evidence
def test_an_experiment_recorded_through_the_wires_names_the_delay(tmp_path):
    machine = tmp_path / 'machine.yaml'
    nominal = Model.load('compass_gait_mit')
    nominal.with_effect('actuator_delay', delay=DELAY).save(machine)
    bags = [record(tmp_path, machine, seed) for seed in (1, 2)]
    records = [read_bag(bag) for bag in bags]
    effects = ('actuator_delay', 'sensor_delay', 'torque_constant', 'torque_bias')
    answer = diagnose(nominal, records, Options(effects=effects, workers=1))
    (cause,) = answer.causes
    # Late torque and late sensors are one but for the first moments of a record.
    assert cause.label in ('actuator_delay', 'sensor_delay'), answer.summary
    # The torque acts at the body's next step, up to 2 ms after its SYNC, in the mean 1 ms.
    delay, _, _ = cause.parameters['delay']
    assert delay == pytest.approx(DELAY + 1e-3, abs=2e-3)
