"""Processes that speak out of turn on a robot's topics, told by their standard input.

python bench/wires_rivals.py rival     a second publisher of a torque
    speak TOPIC LISTENERS HZ           publish TORQUE there, at 0 Hz as fast as it can; says
                                       the ns at which it has found so many listeners
    quiet                              is no publisher any more
python bench/wires_rivals.py relay     between a controller on ASKED and the gate
    well | nan | joint | old S | ahead S     what becomes of the requests from now on
"""

import math
import select
import sys
import time

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.experimental.events_executor import EventsExecutor
from rclpy.node import Node
from sensor_msgs.msg import JointState

from cg_bringup.robot_run import OWNERS
from cg_interfaces import topics
from cg_interfaces.ros import SENSOR_QOS, to_nanoseconds, to_stamp

REQUESTED = f'{topics.TORQUE_REQUEST}/{OWNERS[0]}'  # what the gate listens to
ASKED = '/asked'  # the topic of a controller that is relayed
TORQUE = 7.0  # N m that no controller here asks for by itself
PATIENCE = 10.0  # s until listeners are found


def told() -> bool:
    """Whether somebody has written a line."""
    return bool(select.select([sys.stdin], [], [], 0.0)[0])


def say(line: object) -> None:
    """Answer."""
    print(line, flush=True)


def rival(node: Node) -> None:
    """A second publisher, while it is told to be one."""
    say('ready')
    while line := sys.stdin.readline():
        word, *rest = line.split()
        if word == 'speak':
            speak(node, rest[0], int(rest[1]), float(rest[2]))
        say('quiet')


def speak(node: Node, topic: str, listeners: int, hz: float) -> None:
    """Publish until something is said."""
    publisher = node.create_publisher(JointState, topic, SENSOR_QOS)
    command = JointState(name=['hip'], effort=[TORQUE])
    deadline = time.monotonic() + PATIENCE
    while publisher.get_subscription_count() < listeners and time.monotonic() < deadline:
        time.sleep(5e-4)
    say(time.time_ns())
    while not told():
        command.header.stamp = to_stamp(time.time_ns())
        publisher.publish(command)
        if hz:
            time.sleep(1.0 / hz)
    sys.stdin.readline()
    node.destroy_publisher(publisher)


class Relay:
    """Passes requests on, as it was told to spoil them."""

    def __init__(self, node: Node):
        self.how, self.seconds = 'well', 0.0
        self.publisher = node.create_publisher(JointState, REQUESTED, SENSOR_QOS)
        node.create_subscription(JointState, ASKED, self.on_request, SENSOR_QOS)

    def on_request(self, request: JointState) -> None:
        """Spoil it."""
        if self.how == 'nan':
            request.effort = [math.nan]
        elif self.how == 'joint':
            request.name = ['knee']
        elif self.how in ('old', 'ahead'):
            shift = self.seconds if self.how == 'ahead' else -self.seconds
            stamp = max(0, to_nanoseconds(request.header.stamp) + round(1e9 * shift))
            request.header.stamp = to_stamp(stamp)
        self.publisher.publish(request)


def relay(node: Node) -> None:
    """Between a controller and the gate."""
    between, executor = Relay(node), EventsExecutor()
    executor.add_node(node)
    say('ready')
    while True:
        executor.spin_once(timeout_sec=0.01)
        if told():
            line = sys.stdin.readline().split()
            if not line:
                return
            between.how, between.seconds = line[0], float(line[1]) if line[1:] else 0.0
            say(between.how)


def main() -> None:
    rclpy.init()
    try:
        {'rival': rival, 'relay': relay}[sys.argv[1]](Node(sys.argv[1]))
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    rclpy.try_shutdown()


if __name__ == '__main__':
    main()
