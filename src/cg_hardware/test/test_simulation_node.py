"""The simulated hardware on real topics: lock-step, real time, refusals, watchdogs."""

import dataclasses
import math
import time

import numpy as np
import pytest

rclpy = pytest.importorskip('rclpy')

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus  # noqa: E402
from lifecycle_msgs.msg import State, Transition  # noqa: E402
from lifecycle_msgs.srv import ChangeState  # noqa: E402
from rcl_interfaces.msg import ParameterType  # noqa: E402
from rcl_interfaces.srv import DescribeParameters  # noqa: E402
from rclpy.experimental.events_executor import EventsExecutor  # noqa: E402
from rclpy.node import Node  # noqa: E402
from rclpy.parameter import Parameter  # noqa: E402
from sensor_msgs.msg import Imu, JointState  # noqa: E402
from std_msgs.msg import String  # noqa: E402

from cg_description.paths import model_path  # noqa: E402
from cg_hardware.safety_gate_node import SafetyGateNode  # noqa: E402
from cg_hardware.simulation import SimulationSettings  # noqa: E402
from cg_hardware.simulation_node import SimulationNode  # noqa: E402
from cg_interfaces.domains import own_domain  # noqa: E402
from cg_interfaces.ros import LATCHED_QOS, SENSOR_QOS, to_nanoseconds, to_stamp  # noqa: E402

pytestmark = pytest.mark.alone

PATIENCE = 20.0  # s; discovery on a busy machine


@pytest.fixture
def bench():
    with own_domain():
        rclpy.init()
        bench = Bench()
        yield bench
        bench.close()
        rclpy.try_shutdown()


class Bench:
    """A machine and a controller in one executor."""

    def __init__(self):
        self.executor = EventsExecutor()
        self.nodes = []
        self.controller = self.add(Node('controller'))
        self.applied, self.measured, self.notes = [], [], []
        self.answer = None
        controller = self.controller
        self.command = controller.create_publisher(JointState, '/torque_command', SENSOR_QOS)
        self.hearing = controller.create_subscription(
            JointState, '/applied_torque', self.applied.append, 1000
        )
        controller.create_subscription(Imu, '/imu', self.on_imu, 1000)
        controller.create_subscription(String, '/experiment', self.notes.append, LATCHED_QOS)

    def add(self, node):
        self.nodes.append(node)
        self.executor.add_node(node)
        return node

    def machine(self, **parameters):
        overrides = [Parameter(name, value=value) for name, value in parameters.items()]
        return self.add(SimulationNode(parameter_overrides=overrides))

    def hears_all(self):
        machines = [node for node in self.nodes if isinstance(node, SimulationNode)]
        return self.hearing.get_publisher_count() and not any(
            '/applied_torque' in machine.sensors.unheard(1) for machine in machines
        )

    def on_imu(self, message):
        self.measured.append(message)
        # The first measurement of a lock-step run is repeated until it is answered.
        torque = self.answer(message) if self.answer is not None and self.hears_all() else None
        if torque is not None:
            self.send(torque, message.header.stamp)

    def send(self, torque, stamp=None, name='hip'):
        message = JointState(name=[name], effort=[torque])
        if stamp is not None:
            message.header.stamp = stamp
        self.command.publish(message)

    def until(self, condition, patience=PATIENCE):
        deadline = time.monotonic() + patience
        while not condition():
            assert time.monotonic() < deadline, (
                f'condition not met: phases {[getattr(n, "phase", "") for n in self.nodes]}, '
                f'{len(self.measured)} measured, {len(self.applied)} applied'
            )
            wait = min([getattr(node, 'poll', lambda: 0.01)() for node in self.nodes] + [0.01])
            self.executor.spin_once(timeout_sec=max(wait, 0.0))
            for _ in range(8):  # several nodes live here: answers must not queue up
                self.executor.spin_once(timeout_sec=0.0)

    def close(self):
        for node in self.nodes:
            self.executor.remove_node(node)
            node.destroy_node()


def stamps(messages):
    return [to_nanoseconds(message.header.stamp) for message in messages]


def test_lockstep_answers_are_applied_at_the_stamp_they_answer(bench):
    bench.answer = lambda message: 1.0 + 1e-9 * (to_nanoseconds(message.header.stamp) - 10**9)
    machine = bench.machine(mode='lockstep', duration=0.1)
    bench.until(lambda: machine.phase == 'off' and len(bench.applied) >= 50)
    assert stamps(bench.applied) == [10**9 + 2_000_000 * k for k in range(50)]
    assert [m.effort[0] for m in bench.applied] == pytest.approx(
        [1.0 + 0.002 * k for k in range(50)]
    )
    assert sorted(set(stamps(bench.measured))) == stamps(bench.applied)
    assert 'compass_gait' in bench.notes[0].data


def test_lockstep_peer_that_falls_silent_ends_the_run_with_zero_torque(bench):
    def answer_ten(message):
        return 5.0 if len(set(stamps(bench.measured))) <= 10 else None

    bench.answer = answer_ten
    machine = bench.machine(mode='lockstep', answer_timeout=0.3)
    bench.until(lambda: machine.exit_status == 1 and bench.applied[-1].effort[0] == 0.0)
    assert machine.phase == 'off'
    assert [m.effort[0] for m in bench.applied] == [5.0] * 10 + [0.0]


def test_lockstep_first_answer_may_take_as_long_as_a_peer_that_starts(bench):
    machine = bench.machine(mode='lockstep', duration=0.01, answer_timeout=0.05)
    begun = time.monotonic()
    bench.until(lambda: time.monotonic() > begun + 0.2)
    assert machine.phase == 'running'
    bench.answer = lambda message: 1.0
    bench.until(lambda: machine.phase == 'off' and len(bench.applied) >= 5)
    assert machine.exit_status == 0


def test_lockstep_works_through_the_safety_gate(bench):
    bench.add(SafetyGateNode(parameter_overrides=[Parameter('torque_limit', value=2.0)]))
    bench.controller.destroy_publisher(bench.command)
    bench.command = bench.controller.create_publisher(JointState, '/torque_request', SENSOR_QOS)
    bench.answer = lambda message: 1.0 if len(bench.applied) < 10 else 3.0
    machine = bench.machine(mode='lockstep', duration=0.04)
    bench.until(lambda: machine.phase == 'off' and len(bench.applied) >= 20)
    assert machine.exit_status == 0
    assert [m.effort[0] for m in bench.applied] == [1.0] * 10 + [2.0] * 10


def test_real_time_can_wait_for_the_controller_with_its_first_measurement(bench):
    machine = bench.machine(await_answer=True, duration=0.1, initial_state=[0.2, 0.2, 0.0, 0.0])
    bench.until(lambda: len(bench.measured) >= 4)
    assert len(set(stamps(bench.measured))) == 1
    assert machine.plant.state[0] == 0.2
    bench.answer = lambda message: 0.0
    bench.until(lambda: machine.phase == 'off' and len(bench.applied) >= 50)
    assert machine.plant.state[0] > 0.2  # it has begun to fall


@pytest.mark.parametrize(('torque', 'applied'), [(math.nan, 0.0), (100.0, 40.0), (-55.0, -40.0)])
def test_lockstep_bad_commands_never_reach_the_motor(bench, torque, applied):
    bench.answer = lambda message: torque
    machine = bench.machine(mode='lockstep', duration=0.01)
    bench.until(lambda: machine.phase == 'off' and len(bench.applied) >= 5)
    assert {m.effort[0] for m in bench.applied} == {applied}


@pytest.mark.parametrize(
    ('model', 'joints'),
    [('dfki_double_pendulum', ['shoulder', 'elbow']), ('sydney_pendulum', ['joint'])],
)
def test_other_mechanisms_speak_joint_states(bench, model, joints):
    def answer(message):
        assert message.name == joints
        assert len(message.position) == len(joints)
        if not bench.hears_all():
            return
        reply = JointState(name=joints[::-1], effort=[0.1 * k for k in range(len(joints))][::-1])
        reply.header.stamp = message.header.stamp
        bench.command.publish(reply)

    bench.controller.create_subscription(JointState, '/joint_states', answer, 10)
    machine = bench.machine(
        model_file=str(model_path(model)), mode='lockstep', duration=0.02, exit_when_done=True
    )
    bench.until(lambda: machine.finished and len(bench.applied) >= 10)
    assert machine.exit_status == 0
    for message in bench.applied:
        assert message.name == joints
        assert list(message.effort) == [0.1 * k for k in range(len(joints))]


def test_real_time_keeps_its_rate_and_stamps(bench):
    machine = bench.machine(duration=1.0)
    bench.until(lambda: machine.phase == 'off' and len(bench.applied) >= 400)
    assert set(np.diff(stamps(bench.applied))) == {2_000_000}


def test_real_time_torque_is_zero_again_soon_after_the_last_command(bench):
    machine = bench.machine(stale_after=0.02)
    bench.until(lambda: machine.phase == 'running' and bench.measured)
    bench.answer = lambda message: 3.0
    bench.until(lambda: any(m.effort[0] == 3.0 for m in bench.applied))
    bench.answer = None
    last_answer = time.monotonic()
    bench.until(lambda: bench.applied[-1].effort[0] == 0.0)
    assert time.monotonic() - last_answer < 0.5
    # In the machine's own time, of which no load takes anything: at most 20 ms and one sample.
    driven = [to_nanoseconds(m.header.stamp) for m in bench.applied if m.effort[0] == 3.0]
    answered = stamps(bench.measured)
    assert driven[-1] - max(s for s in answered if s <= driven[-1]) <= 22_000_000


def test_real_time_command_for_another_joint_is_refused(bench):
    machine = bench.machine()
    bench.until(lambda: machine.phase == 'running' and bench.measured)
    bench.send(3.0, to_stamp(time.time_ns()), name='knee')
    count = len(bench.applied)
    bench.until(lambda: len(bench.applied) > count + 50)
    assert {m.effort[0] for m in bench.applied} == {0.0}


@pytest.mark.parametrize('ahead', [15_000_000, 3_000_000_000, 3600 * 10**9])
def test_real_time_command_dated_ahead_neither_acts_nor_shadows(bench, ahead):
    machine = bench.machine()
    bench.until(lambda: machine.phase == 'running' and bench.measured)
    bench.send(7.0, to_stamp(time.time_ns() + ahead))
    bench.until(lambda: machine._faults)
    count = len(bench.applied)
    bench.until(lambda: len(bench.applied) > count + 30)
    assert {m.effort[0] for m in bench.applied} == {0.0}
    bench.answer = lambda message: 3.0
    bench.until(lambda: bench.applied[-1].effort[0] == 3.0, patience=1.0)


@pytest.mark.parametrize('mode', ['real_time', 'lockstep'])
@pytest.mark.parametrize('names', [[], ['knee']])
def test_a_command_must_name_its_joint(bench, mode, names):
    machine = bench.machine(mode=mode, duration=0.02, await_answer=False)

    def answer(message):
        command = JointState(name=names, effort=[3.0])
        command.header.stamp = message.header.stamp
        bench.command.publish(command)

    bench.answer = answer
    bench.until(lambda: machine.phase == 'off' and len(bench.applied) >= 10)
    assert {m.effort[0] for m in bench.applied} == {0.0}
    assert machine.exit_status == 0


@pytest.mark.parametrize('mode', ['real_time', 'lockstep'])
def test_two_publishers_get_no_torque_until_one_is_left(bench, mode):
    bench.answer = lambda message: 3.0
    machine = bench.machine(mode=mode)
    reports = []
    bench.controller.create_subscription(
        DiagnosticArray, '/diagnostics', lambda m: reports.extend(m.status), 10
    )
    bench.until(lambda: bench.applied and bench.applied[-1].effort[0] == 3.0)
    rival = bench.controller.create_publisher(JointState, '/torque_command', SENSOR_QOS)
    bench.until(lambda: machine.command.get_publisher_count() == 2)
    count = len(bench.applied)
    bench.until(
        lambda: any(r.level == DiagnosticStatus.ERROR and '2 publ' in r.message for r in reports)
    )
    # The one on its way when the second publisher came was latched before.
    assert {m.effort[0] for m in bench.applied[count + 2 :]} == {0.0}
    bench.controller.destroy_publisher(rival)
    bench.until(lambda: bench.applied[-1].effort[0] == 3.0)


def test_a_machine_that_was_held_up_is_under_control_again_at_once(bench):
    bench.add(SafetyGateNode())
    bench.controller.destroy_publisher(bench.command)
    bench.command = bench.controller.create_publisher(JointState, '/torque_request', SENSOR_QOS)
    bench.answer = lambda message: 3.0
    machine = bench.machine()
    bench.until(lambda: bench.applied and bench.applied[-1].effort[0] == 3.0)
    for _ in range(3):
        # The machine stands still; the gate meanwhile sends zero.
        gate = bench.nodes[1]
        end = time.monotonic() + 0.3
        while time.monotonic() < end:
            bench.executor.spin_once(timeout_sec=min(gate.poll(), 0.01))
        assert gate._stale
        count = len(bench.applied)
        bench.until(lambda count=count: len(bench.applied) >= count + 200)
        torques = [m.effort[0] for m in bench.applied[count : count + 200]]
        # One watchdog time, 20 ms, is ten samples.
        assert 3.0 in torques[:10]
        assert torques[10:].count(0.0) <= 2
    assert set(np.diff(stamps(bench.applied))) == {2_000_000}
    assert machine.phase == 'running'


def test_parameters_are_refused_with_a_reason(bench):
    machine = bench.machine(mode='real_time')
    (result,) = machine.set_parameters([Parameter('seed', value=5)])
    assert not result.successful
    assert 'seed cannot change while the node is at work' in result.reason
    with pytest.raises(ValueError, match='mode'):
        bench.machine(mode='sideways')


def test_parameters_are_described_over_the_graph(bench):
    bench.machine()
    client = bench.controller.create_client(
        DescribeParameters, '/simulation_node/describe_parameters'
    )
    bench.until(client.service_is_ready)
    names = [field.name for field in dataclasses.fields(SimulationSettings)]
    future = client.call_async(DescribeParameters.Request(names=names))
    bench.until(future.done)
    described = {d.name: d for d in future.result().descriptors}
    assert all(d.description for d in described.values())
    assert '[Hz]' in described['sample_rate_hz'].description
    assert described['sample_rate_hz'].floating_point_range[0].to_value == 2000.0
    assert described['initial_state'].type == ParameterType.PARAMETER_DOUBLE_ARRAY


def test_lifecycle_services_answer(bench):
    machine = bench.machine(autostart=False)
    client = bench.controller.create_client(ChangeState, '/simulation_node/change_state')
    bench.until(client.service_is_ready)
    for transition, state in (
        (Transition.TRANSITION_CONFIGURE, State.PRIMARY_STATE_INACTIVE),
        (Transition.TRANSITION_ACTIVATE, State.PRIMARY_STATE_ACTIVE),
        (Transition.TRANSITION_DEACTIVATE, State.PRIMARY_STATE_INACTIVE),
        (Transition.TRANSITION_CLEANUP, State.PRIMARY_STATE_UNCONFIGURED),
    ):
        request = ChangeState.Request(transition=Transition(id=transition))
        future = client.call_async(request)
        bench.until(future.done)
        assert future.result().success
        assert machine._state_machine.current_state[0] == state


def test_missing_model_is_refused(bench):
    with pytest.raises(ValueError, match='could not start'):
        bench.machine(model_file='/no/such/model.yaml')


def test_lifecycle_by_hand_and_again(bench):
    machine = bench.machine(autostart=False, duration=0.02, mode='lockstep')
    bench.answer = lambda message: 1.0
    for _ in range(2):
        machine.trigger_configure()
        machine.trigger_activate()
        bench.applied.clear()
        bench.until(lambda: len(bench.applied) == 10)
        assert stamps(bench.applied)[0] == 10**9
        bench.until(lambda: machine.phase == 'off')
        machine.trigger_cleanup()
    assert machine._state_machine.current_state[0] == State.PRIMARY_STATE_UNCONFIGURED


def test_second_machine_in_one_domain_waits_and_gives_up(bench):
    first = bench.machine()
    bench.until(lambda: first.phase == 'running' and bench.measured)
    second = bench.machine(peer_timeout=1.0)
    bench.until(lambda: second.exit_status == 1)
    assert second.phase == 'off'
    assert first.phase == 'running'


def test_the_ghost_of_a_killed_machine_does_not_keep_the_next_one_waiting(bench):
    bench.controller.create_publisher(JointState, '/applied_torque', SENSOR_QOS)  # never speaks
    bench.until(lambda: bench.controller.count_publishers('/applied_torque') == 1)
    machine = bench.machine()
    bench.until(lambda: machine.phase == 'running' and bench.measured)
