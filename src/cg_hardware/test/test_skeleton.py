"""The drive node with the driver that is there to be copied, and the choice of a driver."""

import time
from types import SimpleNamespace

import pytest

from cg_hardware.drive import drivers
from cg_hardware.drive.objects import DriveError
from cg_hardware.drive.skeleton import SkeletonDrive

rclpy = pytest.importorskip('rclpy')

from rclpy.experimental.events_executor import EventsExecutor  # noqa: E402
from rclpy.node import Node  # noqa: E402
from rclpy.parameter import Parameter  # noqa: E402
from sensor_msgs.msg import JointState  # noqa: E402
from std_srvs.srv import Trigger  # noqa: E402

from cg_hardware.drive.settings import DriveSettings  # noqa: E402
from cg_hardware.drive_node import DriveNode  # noqa: E402
from cg_interfaces.domains import own_domain  # noqa: E402
from cg_interfaces.ros import SENSOR_QOS  # noqa: E402

PATIENCE = 20.0  # s
SETTINGS = SimpleNamespace(interface='wire', channel='0', sign=-1.0, gear=10.0,
                           counts_per_turn=20_000.0)  # fmt: skip


class Bench:
    """The node with the skeleton, and a controller that asks for a torque all the time."""

    def __init__(self, **settings):
        self.node = DriveNode(parameter_overrides=[
            Parameter(name, value=value)
            for name, value in ({'driver': 'skeleton', 'gear': 10.0} | settings).items()
        ])  # fmt: skip
        self.peer = Node('controller')
        self.torque, self.hip, self.applied = 0.0, [], []
        self.commands = self.peer.create_publisher(JointState, '/torque_command', SENSOR_QOS)
        self.peer.create_subscription(
            JointState, '/hip_encoder', lambda m: self.hip.append(m.position[0]), SENSOR_QOS
        )
        self.peer.create_subscription(
            JointState, '/applied_torque', lambda m: self.applied.append(m.effort[0]), SENSOR_QOS
        )
        self.executor = EventsExecutor()
        for node in (self.node, self.peer):
            self.executor.add_node(node)
        self.until(lambda: len(self.hip) > 10 and len(self.applied) > 10)
        assert self.press('zero').success

    def until(self, condition):
        deadline = time.monotonic() + PATIENCE
        while not condition():
            assert time.monotonic() < deadline
            self.executor.spin_once(timeout_sec=min(self.node.poll(), 0.001))
            command = JointState(name=['hip'], effort=[self.torque])
            command.header.stamp = self.peer.get_clock().now().to_msg()
            self.commands.publish(command)

    def press(self, button):
        client = self.peer.create_client(Trigger, f'/drive/{button}')
        self.until(client.service_is_ready)
        future = client.call_async(Trigger.Request())
        self.until(future.done)
        return future.result()

    @property
    def motor(self):
        return self.node.drive._wire

    def close(self):
        self.node.close()
        for node in (self.node, self.peer):
            self.executor.remove_node(node)
            node.destroy_node()


@pytest.fixture
def bench(request, monkeypatch):
    # A busy host holds the node up for longer than a drive may be silent.
    monkeypatch.setattr('cg_hardware.drive.skeleton.SILENCE_S', 2.0)
    with own_domain():
        rclpy.init()
        bench = Bench(**getattr(request, 'param', {}))
        yield bench
        bench.close()
        rclpy.try_shutdown()


@pytest.mark.parametrize('bench', [{}, {'sign': -1.0}], indirect=True)
def test_torque_acts_once_it_is_enabled_in_the_sign_of_the_settings(bench):
    bench.torque = 1.0
    bench.applied.clear()
    bench.until(lambda: len(bench.applied) > 50)
    assert set(bench.applied) == {0.0}
    assert bench.press('enable').success
    bench.until(lambda: bench.applied[-1] == pytest.approx(1.0))
    sign = bench.node.settings.sign
    assert bench.motor.amperes == pytest.approx(sign * 2.0)
    bench.until(lambda: sign * bench.hip[-1] > 0.1)


def test_a_fault_takes_the_torque_off_until_a_person_enables(bench):
    bench.torque = 1.0
    bench.press('enable')
    bench.until(lambda: bench.applied[-1] > 0)
    bench.motor.faulty = True
    bench.until(lambda: bench.motor.amperes == 0.0 and not bench.node.drive.wanted)
    bench.motor.faulty = False
    count = len(bench.applied)
    bench.until(lambda: len(bench.applied) > count + 50)
    assert bench.applied[-1] == 0.0
    assert 'fault' in bench.node.drive.reason
    bench.press('enable')
    bench.until(lambda: bench.applied[-1] > 0)


def test_a_wire_that_is_gone_is_looked_for_anew_and_gives_no_torque_by_itself(bench):
    bench.torque = 1.0
    bench.press('enable')
    bench.until(lambda: bench.applied[-1] > 0)
    bench.motor.there = False
    bench.until(lambda: bench.node.drive is None)
    bench.until(lambda: bench.node.drive is not None)
    count = len(bench.applied)
    bench.until(lambda: len(bench.applied) > count + 50)
    assert bench.applied[-1] == 0.0


def test_a_silent_drive_is_given_up(monkeypatch):
    drive = SkeletonDrive(SETTINGS)
    drive.enable()
    drive.cycle(0.0)
    drive.cycle(1.0)
    assert drive.enabled
    assert drive.answers[-1].torque == pytest.approx(1.0)
    assert drive._wire.amperes == pytest.approx(-2.0)
    monkeypatch.setattr(drive._wire, 'exchange', lambda on, amperes: None)
    deadline = time.monotonic() + PATIENCE
    while drive.wanted:
        drive.cycle(1.0)
        assert time.monotonic() < deadline
    assert (drive.state, drive.reason) == (None, 'the drive is silent')


def test_too_much_and_what_is_no_number_never_go_out():
    drive = SkeletonDrive(SETTINGS)
    drive.enable()
    drive.cycle(0.0)
    drive.cycle(1e3)
    assert abs(drive._wire.amperes) == 10.0
    drive.cycle(float('nan'))
    assert drive._wire.amperes == 0.0


def test_a_driver_that_does_not_exist_names_those_that_do():
    with pytest.raises(ValueError, match="driver is 'can402'; there are cia402, skeleton"):
        DriveSettings(driver='can402')
    assert drivers.found('cia402') is None
    assert drivers.found('skeleton').load() is SkeletonDrive


def test_a_drive_that_is_not_there_is_an_error_of_the_driver(monkeypatch):
    monkeypatch.setattr('cg_hardware.drive.skeleton.MotorInMemory',
                        lambda counts: SimpleNamespace(there=False))  # fmt: skip
    with pytest.raises(DriveError, match='no drive on wire:0'):
        SkeletonDrive(SETTINGS)
