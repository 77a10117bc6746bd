"""The whole robot live, on a serial line and a CAN bus, with emulated devices on their other ends.

What the drive was told is read from the drive.
"""

import os
import signal
import time

import pytest

rclpy = pytest.importorskip('rclpy')
pytest.importorskip('canopen')
pytest.importorskip('serial')

from emulated_robot import Emulated  # noqa: E402
from rclpy.node import Node  # noqa: E402
from std_msgs.msg import String  # noqa: E402
from std_srvs.srv import Trigger  # noqa: E402

from cg_bringup.robot_run import RobotOptions, robot_nodes  # noqa: E402
from cg_bringup.supervisor import supervised  # noqa: E402
from cg_interfaces.domains import own_domain  # noqa: E402
from cg_interfaces.ros import LATCHED_QOS  # noqa: E402

pytestmark = [pytest.mark.alone, pytest.mark.slow]

PATIENCE = 60.0  # s for nodes to be there
AT_MOST = 0.02  # s from a fault to zero torque at the drive
SPREAD = 0.01  # s: the instant of a fault is known from outside by reports of the emulation
HELD_UP = 0.01  # s by which a host may hold the emulation up for deadlines to mean anything


class Person:
    """Somebody who presses buttons and reads the stage of the robot."""

    def __init__(self):
        self.node = Node('person')
        self.stage = ''
        self.node.create_subscription(String, '/robot_state', self.on_stage, LATCHED_QOS)

    def on_stage(self, message):
        self.stage = message.data

    def until(self, condition):
        deadline = time.monotonic() + PATIENCE
        while not condition():
            assert time.monotonic() < deadline, self.stage
            rclpy.spin_once(self.node, timeout_sec=0.02)

    def press(self, service):
        client = self.node.create_client(Trigger, service)
        self.until(client.service_is_ready)
        future = client.call_async(Trigger.Request())
        self.until(future.done)
        self.node.destroy_client(client)
        return future.result()

    def wait(self, seconds):
        end = time.monotonic() + seconds
        self.until(lambda: time.monotonic() > end)


@pytest.fixture
def standing(tmp_path):
    """Emulated robot, person, processes by name: it balances."""
    with own_domain(), Emulated(tmp_path, '--lean', '0.03') as robot:
        options = RobotOptions(
            imu=str(tmp_path / 'imu'), interface='slcan', channel=str(tmp_path / 'can'),
            epsilon=0.02,
        )  # fmt: skip
        with supervised(robot_nodes(options)) as supervisor:
            rclpy.init()
            person = Person()
            try:
                begin(robot, person)
                yield robot, person, supervisor.processes
            finally:
                person.node.destroy_node()
                rclpy.try_shutdown()


def seen(robot):
    """How the robot is, from a host that keeps time."""
    report = robot.report()
    if report['late'] > HELD_UP:
        pytest.skip(f'the host held the emulation up by {report["late"]:.3f} s')
    return report


def begin(robot, person):
    """As a person does it."""
    person.until(lambda: person.stage == 'idle')
    person.until(lambda: person.press('/drive/zero').success)
    person.wait(1.0)  # the observer has found the foot that stands
    assert person.press('/safety_gate/arm').success
    person.until(lambda: person.stage == 'active')
    assert person.press('/drive/enable').success
    person.until(lambda: robot.report()['state'] == 'operation enabled')
    person.wait(2.0)
    report = seen(robot)
    assert report['farthest'] < 0.1, report
    assert len(report['changes']) > 100


def test_it_stands_is_pushed_and_stands(standing):
    robot, person, _ = standing
    robot.ask('push 0.5')
    person.wait(3.0)
    report = seen(robot)
    assert abs(report['lean']) < 0.02
    assert report['farthest'] < 0.2
    assert person.stage == 'active'


FAULTS = {
    'imu_silent': lambda robot, nodes: robot.ask('imu_silent'),
    'imu_unplugged': lambda robot, nodes: robot.ask('imu_unplug'),
    'drive_fault': lambda robot, nodes: robot.ask('drive_fault 0x2310'),
    'bus_silent': lambda robot, nodes: robot.ask('can_silent'),
    **{
        f'{name}_killed': lambda robot, nodes, name=name: os.kill(
            nodes[name].pid, signal.SIGKILL)
        for name in ('drive', 'imu', 'observer', 'balance', 'safety_gate')
    },
    'balance_stopped': lambda robot, nodes: os.kill(nodes['balance'].pid, signal.SIGSTOP),
}  # fmt: skip


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
