"""The gate between a controller and the hardware, on real topics."""

import math
import time
from contextlib import contextmanager

import pytest

rclpy = pytest.importorskip('rclpy')

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus  # noqa: E402
from rclpy.experimental.events_executor import EventsExecutor  # noqa: E402
from rclpy.node import Node  # noqa: E402
from rclpy.parameter import Parameter  # noqa: E402
from sensor_msgs.msg import Imu, JointState  # noqa: E402
from std_msgs.msg import Bool, String  # noqa: E402
from std_srvs.srv import Trigger  # noqa: E402

from cg_hardware import safety_gate_node  # noqa: E402
from cg_hardware.safety_gate_node import SafetyGateNode  # noqa: E402
from cg_interfaces.domains import own_domain  # noqa: E402
from cg_interfaces.ros import LATCHED_QOS, SENSOR_QOS, to_nanoseconds, to_stamp  # noqa: E402

pytestmark = pytest.mark.alone


class Bench:
    """A gate, and a peer that asks, measures and listens."""

    def __init__(self, **settings):
        self.gate = SafetyGateNode(parameter_overrides=[
            Parameter(name, value=value)
            for name, value in {'torque_limit': 10.0, **settings}.items()
        ])  # fmt: skip
        self.peer = Node('peer')
        self.commands, self.reports = [], []
        self.peer.create_subscription(
            JointState, '/torque_command', self.commands.append, SENSOR_QOS
        )
        self.peer.create_subscription(
            DiagnosticArray, '/diagnostics', lambda m: self.reports.extend(m.status), 10
        )
        self.publisher = self.peer.create_publisher(JointState, '/torque_request', SENSOR_QOS)
        self.imu = self.peer.create_publisher(Imu, '/imu', SENSOR_QOS)
        self.applied = self.peer.create_publisher(JointState, '/applied_torque', SENSOR_QOS)
        self.state = self.peer.create_publisher(JointState, '/state', SENSOR_QOS)
        self.button = self.peer.create_publisher(Bool, '/emergency_stop', 10)
        self.stages = []
        self.peer.create_subscription(
            String, '/robot_state', lambda m: self.stages.append(m.data), LATCHED_QOS
        )
        self.executor = EventsExecutor()
        for node in (self.gate, self.peer):
            self.executor.add_node(node)
        self.until(
            lambda: (
                (settings.get('owners') or self.publisher.get_subscription_count())
                and self.imu.get_subscription_count()
                and self.gate.publisher.get_subscription_count()
                and self.gate.diagnostics.get_subscription_count()
            )
        )

    def until(self, condition):
        deadline = time.monotonic() + 20.0
        while not condition():
            assert time.monotonic() < deadline
            self.executor.spin_once(timeout_sec=min(self.gate.poll(), 0.005))

    def measure(self, nanoseconds):
        message = Imu()
        message.header.stamp = to_stamp(nanoseconds)
        self.imu.publish(message)
        self.until(lambda: self.gate._measured_ns == nanoseconds)

    def call(self, what):
        """A person asks; the answer."""
        client = self.peer.create_client(Trigger, f'/safety_gate/{what}')
        self.until(client.service_is_ready)
        future = client.call_async(Trigger.Request())
        self.until(future.done)
        return future.result()

    def live(self, seconds, torque=2.0, lean=0.0):
        """So long a robot whose controller asks for a torque; what the last request came to."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            now = time.time_ns()
            imu, applied, state = Imu(), JointState(name=['hip'], effort=[0.0]), JointState()
            state.header.frame_id, state.name, state.position = (
                'outer_foot',
                ['inner', 'outer'],
                [9.0, lean],
            )
            for message in (imu, applied, state):
                message.header.stamp = to_stamp(now)
            self.imu.publish(imu)
            self.applied.publish(applied)
            self.state.publish(state)
            # A request that overtakes its measurement is dated ahead.
            self.until(lambda now=now: self.gate._measured_ns == now)
            self.publisher.publish(request(torque, now))
            self.until(lambda now=now: now in answers_to(self.commands[-20:]))
        return answers_to(self.commands[-20:])[now]

    def __iter__(self):
        return iter((self.gate, self.publisher, self.commands, self.until))

    def close(self):
        for node in (self.gate, self.peer):
            self.executor.remove_node(node)
            node.destroy_node()


@contextmanager
def running(**settings):
    with own_domain():
        rclpy.init()
        bench = Bench(**settings)
        yield bench
        bench.close()
        rclpy.try_shutdown()


@pytest.fixture
def bench():
    with running() as bench:
        yield bench


@pytest.fixture
def robot(monkeypatch):
    """A gate that a person arms."""
    monkeypatch.setattr(safety_gate_node, 'SILENCE', 5.0)
    # As patient as a busy host needs: what is shown here is no matter of milliseconds.
    with running(arming=True, fall_angle=0.6, stale_after=0.5) as bench:
        yield bench


def request(torque, nanoseconds):
    message = JointState(name=['hip'], effort=[torque])
    message.header.stamp = to_stamp(nanoseconds)
    return message


def answers_to(commands):
    """The first answer to each request, by stamp in ns; silence repeats a stamp with zero."""
    answers = {}
    for message in commands:
        answers.setdefault(to_nanoseconds(message.header.stamp), message.effort[0])
    return answers


def test_requests_pass_within_limits_and_keep_their_stamp(bench):
    _, publisher, commands, until = bench
    for index, torque in enumerate((2.0, 50.0, math.nan), start=1):
        publisher.publish(request(torque, index))
        until(lambda index=index: index in answers_to(commands))
    assert answers_to(commands) == {1: 2.0, 2: 10.0, 3: 0.0}


def test_silence_gives_one_zero_in_the_place_of_the_last_request(bench):
    _, publisher, commands, until = bench
    publisher.publish(request(2.0, 5))
    until(lambda: len(commands) >= 2)
    assert commands[-1].effort[0] == 0.0
    assert to_nanoseconds(commands[-1].header.stamp) == 5


@pytest.mark.parametrize('measured', [False, True], ids=['by the wall clock', 'by measurements'])
@pytest.mark.parametrize('ahead', [0.015, 3.0, 3600.0])
def test_a_request_dated_ahead_goes_nowhere(bench, measured, ahead):
    gate, publisher, commands, until = bench
    now = time.time_ns()
    if measured:
        now = 10**9
        bench.measure(now)
    publisher.publish(request(7.0, now + round(ahead * 1e9)))
    until(lambda: gate.doubts)
    publisher.publish(request(2.0, now))
    until(lambda: commands)
    assert set(answers_to(commands)) == {now}
    assert max(message.effort[0] for message in commands) == 2.0


def test_an_old_request_is_answered_with_zero(bench):
    _, publisher, commands, until = bench
    bench.measure(10**9)
    publisher.publish(request(7.0, 10**9 - 30_000_000))
    until(lambda: commands)
    assert commands[0].effort[0] == 0.0


@pytest.mark.parametrize('names', [[], ['knee'], ['hip', 'hip']])
def test_a_request_must_name_its_joint(bench, names):
    _, publisher, commands, until = bench
    message = request(7.0, 1)
    message.name = names
    publisher.publish(message)
    until(lambda: commands)
    assert commands[0].effort[0] == 0.0


def test_a_second_publisher_is_an_error_and_nobody_gets_torque(bench):
    gate, publisher, commands, until = bench
    rival = bench.peer.create_publisher(JointState, '/torque_request', SENSOR_QOS)
    until(lambda: gate.requests[''].get_publisher_count() == 2)
    for stamp, speaker in enumerate((publisher, rival, publisher), start=1):
        speaker.publish(request(2.0, stamp))
        until(lambda stamp=stamp: stamp in answers_to(commands))
    assert answers_to(commands) == {1: 0.0, 2: 0.0, 3: 0.0}
    until(lambda: any('2 publishers' in status.message for status in bench.reports))
    assert bench.reports[-1].level == DiagnosticStatus.ERROR
    bench.peer.destroy_publisher(rival)
    until(lambda: gate.requests[''].get_publisher_count() == 1)
    publisher.publish(request(2.0, 4))
    until(lambda: 4 in answers_to(commands))
    assert answers_to(commands)[4] == 2.0


def test_limits_can_be_changed_while_it_runs_and_nonsense_is_refused(bench):
    gate, publisher, commands, until = bench
    (result,) = gate.set_parameters([Parameter('torque_limit', value=1.0)])
    assert result.successful
    (result,) = gate.set_parameters([Parameter('torque_limit', value=-1.0)])
    assert not result.successful
    (result,) = gate.set_parameters([Parameter('mechanism', value='pendulum')])
    assert 'mechanism cannot change' in result.reason
    publisher.publish(request(2.0, 5))
    until(lambda: commands)
    assert commands[0].effort[0] == 1.0


def test_no_torque_before_a_person_arms(robot):
    assert robot.live(0.3) == 0.0
    assert robot.stages[-1] == 'idle'
    assert robot.call('arm').success
    assert robot.live(0.3) == 2.0
    assert robot.stages[-1] == 'active'
    assert robot.call('disarm').success
    assert robot.live(0.2) == 0.0
    assert robot.stages[-1] == 'idle: disarmed'


@pytest.mark.parametrize(
    ('what', 'said'),
    [
        (lambda r: r.button.publish(Bool(data=True)), 'fault: emergency stop'),
        (lambda r: r.call('stop'), 'fault: emergency stop'),
        (lambda r: r.live(0.1, torque=math.nan), 'fault: torque of hip is nan'),
        (lambda r: r.live(0.1, lean=0.7), 'fault: the robot has fallen'),
        (lambda r: r.until(lambda: r.stages[-1] != 'active'), 'fault: torque requests stopped'),
    ],
    ids=['button', 'stop', 'nan', 'fallen', 'silence'],
)
def test_a_fault_is_told_and_stays_until_a_person_resets_and_arms(robot, what, said):
    robot.live(0.3)
    robot.call('arm')
    robot.live(0.3)
    assert robot.stages[-1] == 'active'
    what(robot)
    robot.until(lambda: robot.stages[-1].startswith(said))
    assert robot.live(0.3) == 0.0
    refused = robot.call('arm')
    assert not refused.success
    assert 'only an idle robot can be armed' in refused.message
    assert robot.call('reset').success
    assert robot.live(0.2) == 0.0
    assert robot.call('arm').success
    assert robot.live(0.3) == 2.0


def test_a_hand_over_is_one_change_and_leaves_no_gap():
    with running(owners=['balance', 'walk'], owner='balance') as bench:
        gate, _, commands, until = bench
        speakers = {
            name: bench.peer.create_publisher(JointState, f'/torque_request/{name}', SENSOR_QOS)
            for name in ('balance', 'walk')
        }
        until(lambda: all(s.get_subscription_count() for s in speakers.values()))

        def both(stamp):
            for torque, speaker in zip((1.0, 2.0), speakers.values(), strict=True):
                speaker.publish(request(torque, stamp))
            until(lambda: stamp in answers_to(commands))

        both(1)
        (result,) = gate.set_parameters([Parameter('owner', value='walk')])
        assert result.successful
        both(2)
        assert answers_to(commands) == {1: 1.0, 2: 2.0}
        (result,) = gate.set_parameters([Parameter('owner', value='stranger')])
        assert "owner is 'stranger'; owners has balance, walk" in result.reason
