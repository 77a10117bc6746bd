"""The drive node on a bus, against a drive in another process: zero, readings, feet, limits."""

import math
import time

import pytest

rclpy = pytest.importorskip('rclpy')
pytest.importorskip('canopen')

from diagnostic_msgs.msg import DiagnosticArray  # noqa: E402
from emulated_robot import Emulated, wait_longer  # noqa: E402
from rclpy.experimental.events_executor import EventsExecutor  # noqa: E402
from rclpy.node import Node  # noqa: E402
from rclpy.parameter import Parameter  # noqa: E402
from sensor_msgs.msg import BatteryState, JointState, Temperature  # noqa: E402
from std_msgs.msg import Bool, String  # noqa: E402
from std_srvs.srv import Trigger  # noqa: E402

from cg_hardware.drive.can_drive import CanDrive  # noqa: E402
from cg_hardware.drive.zero import read_zero  # noqa: E402
from cg_hardware.drive_node import DriveNode  # noqa: E402
from cg_interfaces.domains import own_domain  # noqa: E402
from cg_interfaces.ros import LATCHED_QOS, SENSOR_QOS, to_stamp  # noqa: E402

pytestmark = pytest.mark.alone

HANGING = '--model compass_gait_mit --state 0 0 --setup'.split()
SETUP = 'stance: inner\nfixture: inner_fixed\n'
INDEX = 0.06  # rad of the hip, by the emulated encoder
TEMPERATURE = {'temperature_index': 0x2E10, 'temperature_subindex': 1, 'readings_period': 0.1}


class Bench:
    """The node, its device, and somebody who listens and commands."""

    def __init__(self, folder, **settings):
        self.robot = Emulated(folder, *HANGING, SETUP).__enter__()
        given = {
            'interface': 'slcan', 'channel': str(folder / 'can'),
            'zero_file': str(folder / 'hip.yaml'), 'stale_after': 0.5, **TEMPERATURE, **settings,
        }  # fmt: skip
        self.node = DriveNode(parameter_overrides=[
            Parameter(name, value=value) for name, value in given.items()
        ])  # fmt: skip
        self.peer, self.heard, self.status = Node('peer'), {}, {}
        for kind, topic, qos in (
            (JointState, '/hip_encoder', SENSOR_QOS), (BatteryState, '/battery_state', SENSOR_QOS),
            (Temperature, '/drive/temperature', SENSOR_QOS),
            (String, '/drive/zero_state', LATCHED_QOS),
        ):  # fmt: skip
            self.peer.create_subscription(kind, topic, self.listener(topic), qos)
        self.peer.create_subscription(DiagnosticArray, '/diagnostics', self.on_diagnostics, 10)
        self.torque = self.peer.create_publisher(JointState, '/torque_command', SENSOR_QOS)
        self.stage = self.peer.create_publisher(String, '/robot_state', LATCHED_QOS)
        self.stop = self.peer.create_publisher(Bool, '/emergency_stop', 10)
        self.feet = {
            leg: self.peer.create_publisher(Bool, f'/foot_retraction/{leg}', 10)
            for leg in ('inner', 'outer')
        }
        self.executor = EventsExecutor()
        for node in (self.node, self.peer):
            self.executor.add_node(node)
        self.until(lambda: '/hip_encoder' in self.heard and '/drive/zero_state' in self.heard)

    def listener(self, topic):
        return lambda message: self.heard.__setitem__(topic, message)

    def on_diagnostics(self, message):
        self.status |= {status.name: status for status in message.status}

    def until(self, condition, patience=40.0):
        deadline = time.monotonic() + patience
        while not condition():
            assert time.monotonic() < deadline, (self.zero_state, self.status.get('drive'))
            self.executor.spin_once(timeout_sec=self.node.poll())

    def wait(self, seconds):
        end = time.monotonic() + seconds
        self.until(lambda: time.monotonic() > end)

    def call(self, service):
        client = self.peer.create_client(Trigger, f'/drive/{service}')
        self.until(client.service_is_ready)
        future = client.call_async(Trigger.Request())
        self.until(future.done)
        return future.result()

    def enabled(self):
        answer = self.call('enable')
        assert answer.success, answer.message
        self.until(lambda: self.node.drive.enabled)

    @property
    def zero_state(self):
        return self.heard['/drive/zero_state'].data

    @property
    def hip(self):
        return self.heard['/hip_encoder'].position[0]

    def close(self):
        self.node.close()
        for node in (self.node, self.peer):
            self.executor.remove_node(node)
            node.destroy_node()
        self.robot.__exit__()


@pytest.fixture
def make(tmp_path, monkeypatch):
    wait_longer(monkeypatch)
    with own_domain():
        rclpy.init()
        benches = []

        def made(**settings):
            benches.append(Bench(tmp_path, **settings))
            return benches[-1]

        yield made
        for bench in benches:
            bench.close()
        rclpy.try_shutdown()


def test_homing_makes_the_hip_zero_at_index_and_offset(make, tmp_path):
    bench = make(index_offset=-0.02)
    assert bench.zero_state.startswith('unknown: call /drive/zero')
    refused = bench.call('enable')
    assert not refused.success
    assert 'the zero of the hip is unknown' in refused.message
    assert bench.call('home').success
    bench.until(lambda: bench.node.procedure is None)
    bench.until(lambda: bench.zero_state.startswith('known'))
    assert bench.zero_state.startswith('known: zero at -64 counts (homing by method 34')
    bench.robot.ask('hold')
    bench.wait(0.5)
    assert bench.hip == pytest.approx(bench.robot.report()['hip'] - INDEX + 0.02, abs=1e-3)
    kept = read_zero(str(tmp_path / 'hip.yaml'))
    assert (kept.zero_counts, kept.how) == (-64, 'homing')
    bench.enabled()


def test_a_person_turns_the_hip_through_the_index(make):
    bench = make(index_offset=0.01, counts_per_turn=-20_000.0)
    assert bench.call('index_by_hand').success
    bench.until(lambda: 'turn the hip through the index' in bench.zero_state)
    bench.robot.ask('turn 0.1')
    bench.until(lambda: bench.node.procedure is None)
    bench.until(lambda: 'index by hand' in bench.zero_state and 'known' in bench.zero_state)
    bench.wait(0.6)
    # The encoder of this lab counts backward.
    assert bench.hip == pytest.approx(-(bench.robot.report()['hip'] - INDEX) - 0.01, abs=1e-3)
    assert bench.robot.report()['changes'] == []


@pytest.mark.parametrize('stage', ['armed', 'active', 'fault: emergency stop'])
def test_a_robot_that_is_not_at_ease_is_not_homed(make, stage):
    bench = make(homing_method=33, homing_travel=6.0)
    bench.stage.publish(String(data=stage))
    bench.until(lambda: bench.node._stage == stage)
    for service in ('home', 'index_by_hand'):
        answer = bench.call(service)
        assert (answer.success, answer.message) == (False, f'not while the robot is {stage}')
    bench.stage.publish(String(data='idle'))
    bench.until(lambda: bench.node._stage == 'idle')
    bench.stop.publish(Bool(data=True))
    bench.until(lambda: bench.node._stopped)
    assert bench.call('home').message == 'not while the emergency stop is pressed'
    bench.stop.publish(Bool(data=False))
    bench.until(lambda: not bench.node._stopped)
    assert bench.call('home').success
    said = [bench.call(name).message for name in ('home', 'index_by_hand', 'enable', 'zero')]
    bench.stage.publish(String(data=stage))
    bench.until(lambda: bench.node._stage == stage and bench.node.procedure is None)
    bench.until(lambda: 'homing failed' in bench.zero_state)
    assert said == ['homing is under way: ~/disable ends it'] * 4
    assert f'homing failed: the robot is {stage}' in bench.zero_state
    bench.until(lambda: bench.robot.report()['acting'] == 0)


@pytest.mark.parametrize('who', ['emergency_stop', 'disable'])
def test_a_homing_is_stopped(make, who):
    bench = make(homing_method=33, homing_travel=6.0)
    assert bench.call('zero').success
    assert bench.call('home').success
    bench.until(lambda: bench.robot.report()['acting'])
    if who == 'disable':
        assert bench.call('disable').success
    else:
        bench.stop.publish(Bool(data=True))
    bench.until(lambda: bench.node.procedure is None)
    bench.wait(0.2)
    why = {'disable': '~/disable was called', 'emergency_stop': 'emergency stop'}[who]
    assert f'homing failed: {why}' in bench.zero_state
    assert 'unknown' in bench.zero_state  # the counts may have begun anew
    assert bench.robot.report()['acting'] == 0


def test_a_node_that_ends_while_the_drive_homes_leaves_it_as_it_was(make):
    bench = make(homing_method=33, homing_travel=6.0)
    drive = bench.node.drive
    assert bench.call('home').success
    bench.until(lambda: bench.robot.report()['acting'])
    bench.node.close()
    assert bench.robot.report()['acting'] == 0
    again = CanDrive(bench.node.settings.bus, 1)
    try:
        assert drive.procedure.tidy
        assert again.objects.read(0x6072) == 1000
    finally:
        again.close()


def test_an_absolute_encoder_needs_no_homing(make, tmp_path):
    (tmp_path / 'hip.yaml').write_text('format: cg_encoder_zero/1\nzero_counts: 12545\n')
    bench = make(absolute_encoder=True)
    assert bench.zero_state.startswith('known: zero at 12545')
    bench.wait(0.1)
    assert bench.hip == pytest.approx(-200 * 2 * math.pi / 20_000, abs=1e-3)
    assert 'absolute encoder' in bench.call('home').message
    bench.enabled()


def test_a_drive_that_was_without_power_has_no_zero(make):
    bench = make()
    assert bench.call('zero').success
    assert bench.zero_state.startswith('known')
    bench.enabled()
    bench.robot.ask('drive_off')
    bench.until(lambda: not bench.node.drive.wanted)
    bench.robot.ask('drive_on')
    bench.wait(0.3)
    assert not bench.call('enable').success  # looked for anew
    bench.until(lambda: bench.node.drive is not None)
    found = bench.node.drive
    # A person who tries again before it has said anything does not lose it again.
    request, response = Trigger.Request(), Trigger.Response()
    assert 'has said nothing for' in bench.node.on_enable(request, response).message
    assert bench.node.drive is found
    bench.until(lambda: found.state is not None)
    assert 'the zero of the hip is unknown' in bench.call('enable').message


def test_a_drive_that_a_busy_host_did_not_hear_for_a_moment_keeps_its_zero(make, monkeypatch):
    bench = make()
    assert bench.call('zero').success
    drive = bench.node.drive
    with monkeypatch.context() as deaf:
        deaf.setattr('cg_hardware.drive.can_drive.SILENCE_S', 0.0)
        assert 'the drive has said nothing for' in bench.call('enable').message
    assert bench.node.drive is drive
    assert bench.zero_state.startswith('known')
    bench.enabled()


def test_nobody_is_let_go_while_two_speak_to_the_drive(make):
    bench = make()
    assert bench.call('zero').success
    bench.enabled()
    assert bench.call('disable').success
    rival = bench.peer.create_publisher(JointState, '/torque_command', SENSOR_QOS)
    bench.until(lambda: bench.node.commands.get_publisher_count() == 2)
    assert '2 publishers of the torque' in bench.call('enable').message
    assert not bench.node.drive.wanted
    bench.peer.destroy_publisher(rival)
    bench.until(lambda: bench.node.commands.get_publisher_count() == 1)
    bench.enabled()


def test_voltage_and_temperature_are_told_and_limits_take_the_torque(make):
    bench = make(voltage_low_warn=46.0, voltage_low_error=42.0, temperature_error=80.0)
    bench.until(lambda: '/drive/temperature' in bench.heard and '/battery_state' in bench.heard)
    assert bench.heard['/battery_state'].voltage == pytest.approx(48.0)
    assert math.isnan(bench.heard['/battery_state'].percentage)
    assert bench.heard['/drive/temperature'].temperature == pytest.approx(31.4)
    assert bench.call('zero').success
    bench.enabled()
    bench.robot.ask('drive_volts 45')
    bench.until(lambda: bench.status['DC link'].level == b'\x01')
    assert bench.node.drive.enabled
    for fault, why, name in (
        ('drive_volts 41.5', 'DC link is 41.5 V; the least is 42 V', 'DC link'),
        ('drive_degc 93', 'temperature of the drive is 93 degC; the limit is 80 degC',
         'temperature of the drive'),
    ):  # fmt: skip
        bench.robot.ask(fault)
        bench.until(lambda: not bench.node.drive.wanted)
        assert bench.node.drive.reason == why
        bench.until(lambda: bench.robot.report()['state'] == 'switch on disabled')
        bench.until(lambda name=name: bench.status[name].level == b'\x02')
        assert bench.status[name].message == why
        answer = bench.call('enable')
        assert (answer.success, answer.message) == (False, why)
        assert bench.call('home').message == why
        bench.robot.ask('drive_volts 48')
        bench.until(lambda: bench.node.voltage.value > 47.0)
        if name == 'DC link':
            bench.enabled()


def test_a_drive_without_such_objects_is_no_trouble(make):
    bench = make(temperature_index=0x2FFF, voltage_low_error=10.0)
    bench.until(lambda: 'temperature of the drive' in bench.status)
    bench.until(lambda: bench.node.temperature.absent)
    # It has limits, and nobody can watch them.
    bench.until(lambda: bench.status['temperature of the drive'].level == b'\x01')
    assert 'object 0x2fff:1' in bench.status['temperature of the drive'].message
    assert '/drive/temperature' not in bench.heard


def test_feet_go_in_while_they_are_asked_to_and_out_on_a_fault(make):
    bench = make(inner_retraction=0, outer_retraction=5, retraction_stale_after=0.3)
    outputs = lambda: bench.robot.report()['outputs']  # noqa: E731

    def keep(leg):
        bench.feet[leg].publish(Bool(data=True))
        bench.wait(0.05)

    bench.until(lambda: all(p.get_subscription_count() for p in bench.feet.values()))
    for _ in range(5):
        keep('outer')
    assert outputs() == 0  # the drive is not enabled
    assert bench.call('zero').success
    bench.enabled()

    def asked():
        keep('outer')
        return outputs() == 1 << 5

    bench.until(asked)
    bench.until(lambda: outputs() == 0)  # nobody asks any more
    bench.until(asked)
    keep('inner')
    bench.until(lambda: outputs() == 0)  # both: none
    bench.wait(0.4)
    bench.until(asked)
    bench.robot.ask('drive_fault 0x2310')
    bench.until(lambda: not bench.node.drive.wanted)
    keep('outer')
    bench.until(lambda: outputs() == 0)


@pytest.mark.parametrize('watch', ['heartbeat', 'guarding'])
def test_torque_acts_under_either_watch(make, watch):
    bench = make(watch=watch)
    assert bench.call('zero').success
    command = JointState(name=['hip'], effort=[2.0])

    def acting():
        if not bench.node.drive.wanted:  # a guarded drive does not wait longer
            bench.call('enable')
        command.header.stamp = to_stamp(time.time_ns())
        bench.torque.publish(command)
        bench.wait(0.02)
        return bench.robot.report()['acting'] == 50

    bench.until(acting)
