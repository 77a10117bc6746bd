"""The observer on real topics: one state for every measurement, none when it would be a guess."""

import math
import time

import pytest

rclpy = pytest.importorskip('rclpy')

from geometry_msgs.msg import WrenchStamped  # noqa: E402
from rclpy.experimental.events_executor import EventsExecutor  # noqa: E402
from rclpy.node import Node  # noqa: E402
from rclpy.parameter import Parameter  # noqa: E402
from sensor_msgs.msg import Imu, JointState  # noqa: E402

from cg_description.paths import model_path  # noqa: E402
from cg_estimation.observer_node import ObserverNode  # noqa: E402
from cg_interfaces.domains import own_domain  # noqa: E402
from cg_interfaces.ros import SENSOR_QOS, to_nanoseconds, to_stamp  # noqa: E402

pytestmark = pytest.mark.alone

T_NS = 2_000_000
START_NS = 1_000_000_000


class Machine(Node):
    """Publishes what the hardware would; keeps the states that come back."""

    def __init__(self):
        super().__init__('machine')
        self.states = []
        self.outlets = {
            topic: self.create_publisher(kind, topic, SENSOR_QOS)
            for kind, topic in (
                (Imu, '/imu'),
                (JointState, '/hip_encoder'),
                (JointState, '/applied_torque'),
                (WrenchStamped, '/foot_contact/inner'),
                (WrenchStamped, '/foot_contact/outer'),
            )
        }
        self.create_subscription(JointState, '/state', self.states.append, SENSOR_QOS)

    def send(self, topic, k, **fields):
        kinds = {'/imu': Imu, '/hip_encoder': JointState, '/applied_torque': JointState}
        message = kinds.get(topic, WrenchStamped)()
        message.header.stamp = to_stamp(START_NS + k * T_NS)
        for name, value in fields.items():
            setattr(message, name, value)
        self.outlets[topic].publish(message)
        return message

    def measure(self, k, lean=0.1, hip=0.3, stance='inner', encoder=True):
        for leg in ('inner', 'outer'):
            contact = WrenchStamped()
            contact.header.stamp = to_stamp(START_NS + k * T_NS)
            contact.wrench.force.z = 100.0 if leg == stance else 0.0
            self.outlets[f'/foot_contact/{leg}'].publish(contact)
        if encoder:
            self.send('/hip_encoder', k, name=['hip'], position=[hip])
        imu = Imu()
        imu.header.stamp = to_stamp(START_NS + k * T_NS)
        imu.orientation.y, imu.orientation.w = math.sin(lean / 2), math.cos(lean / 2)
        self.outlets['/imu'].publish(imu)

    def applied(self, k, torque=0.0):
        self.send('/applied_torque', k, name=['hip'], effort=[torque])


@pytest.fixture
def bench():
    with own_domain():
        rclpy.init()
        executor = EventsExecutor()
        machine, nodes = Machine(), []

        def make(**parameters):
            node = ObserverNode(
                parameter_overrides=[Parameter(n, value=v) for n, v in parameters.items()]
            )
            nodes.append(node)
            executor.add_node(node)
            until(
                lambda: (
                    node.publisher.get_subscription_count()
                    and all(p.get_subscription_count() for p in machine.outlets.values())
                )
            )
            return node

        def until(condition):
            deadline = time.monotonic() + 20.0
            while not condition():
                assert time.monotonic() < deadline
                executor.spin_once(timeout_sec=0.01)

        executor.add_node(machine)
        yield machine, make, until
        for node in (machine, *nodes):
            executor.remove_node(node)
            node.destroy_node()
        rclpy.try_shutdown()


def run(machine, until, samples, **given):
    for k in samples:
        count = len(machine.states)
        machine.measure(k, **given)
        until(lambda count=count: len(machine.states) > count)
        machine.applied(k)


def test_every_measurement_is_answered_with_its_stamp_and_stance(bench):
    machine, make, until = bench
    make()
    run(machine, until, range(5))
    run(machine, until, range(5, 8), stance='outer')
    stamps = [to_nanoseconds(state.header.stamp) for state in machine.states]
    assert stamps == [START_NS + k * T_NS for k in range(8)]
    assert [s.header.frame_id for s in machine.states] == ['inner_foot'] * 5 + ['outer_foot'] * 3
    first = machine.states[0]
    assert list(first.name) == ['inner', 'outer']
    assert first.position == pytest.approx([0.1, -0.2])


def test_a_repeated_measurement_gets_the_same_state_again(bench):
    machine, make, until = bench
    make()
    run(machine, until, range(3))
    machine.measure(2)
    until(lambda: len(machine.states) == 4)
    assert machine.states[3] == machine.states[2]


def test_no_state_without_an_encoder(bench):
    machine, make, until = bench
    node = make(longest_blind=0.006)
    run(machine, until, range(3))
    for k in range(3, 20):
        machine.measure(k, encoder=False)
        machine.applied(k)
    until(lambda: node._withheld > 5)
    last = to_nanoseconds(machine.states[-1].header.stamp)
    # The last position was at sample 2; three more may be bridged.
    assert last <= START_NS + 5 * T_NS


def test_a_reading_that_is_not_a_number_is_a_missing_one(bench):
    machine, make, until = bench
    make()
    run(machine, until, range(3))
    run(machine, until, range(3, 4), hip=math.nan)
    assert all(map(math.isfinite, machine.states[-1].velocity))


def test_epsilon_is_live_and_the_method_is_not(bench):
    _, make, _ = bench
    node = make()
    (result,) = node.set_parameters([Parameter('epsilon', value=0.05)])
    assert result.successful
    (result,) = node.set_parameters([Parameter('epsilon', value=-1.0)])
    assert not result.successful
    (result,) = node.set_parameters([Parameter('method', value='derivative')])
    assert 'method cannot change while the node is at work' in result.reason
    assert node.declared.values.epsilon == 0.05


def test_extended_model_publishes_the_rotor_too(bench):
    machine, make, until = bench
    make(model_file=str(model_path('compass_gait_flexible')))
    run(machine, until, range(2))
    assert list(machine.states[-1].name) == ['inner', 'outer', 'hip_rotor']
    # At rest the rotor stands where the joint does.
    assert machine.states[0].position[2] == pytest.approx(0.3)


def test_states_of_sensors_are_not_taken_for_a_rotor(bench):
    machine, make, until = bench
    make(model_file=str(model_path('compass_gait_imu_mount')))
    run(machine, until, range(2))
    assert list(machine.states[-1].name) == ['inner', 'outer']
