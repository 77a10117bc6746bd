"""A robot on wires, live, and a person beside it: for tests and benches."""

import contextlib
import os
import signal
import tempfile
import time
from pathlib import Path

import rclpy
from emulated_robot import Emulated
from rclpy.node import Node
from std_msgs.msg import String
from std_srvs.srv import Trigger

from cg_bringup.robot_run import RobotOptions, robot_nodes
from cg_bringup.supervisor import supervised
from cg_interfaces.domains import own_domain
from cg_interfaces.ros import LATCHED_QOS

PATIENCE = 60.0  # s for nodes to be there


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


@contextlib.contextmanager
def connected(nodes, folder, *words):
    """Emulated robot, person and processes by name, while the context lasts."""
    with own_domain(), Emulated(folder, *words) as robot, supervised(nodes) as supervisor:
        rclpy.init()
        person = Person()
        try:
            yield robot, person, supervisor.processes
        finally:
            person.node.destroy_node()
            rclpy.try_shutdown()


def options_in(folder) -> RobotOptions:
    """The wires that end in a folder."""
    return RobotOptions(
        imu=str(folder / 'imu'), interface='slcan', channel=str(folder / 'can'), epsilon=0.02
    )


def held_nodes(folder):
    """Of a robot in a stand: nobody balances it, and a busy host has less to do."""
    nodes = robot_nodes(options_in(folder))
    del nodes['balance'], nodes['observer']
    return nodes


@contextlib.contextmanager
def standing():
    """The same of a robot that balances, started as a person does it."""
    with tempfile.TemporaryDirectory(prefix='cg_wires_') as directory:
        folder = Path(directory)
        words = ('--state', '0.03', '0.03', '0', '0')
        with connected(robot_nodes(options_in(folder)), folder, *words) as (robot, person, nodes):
            begin(robot, person)
            yield robot, person, nodes


def begin(robot, person):
    """As a person does it."""
    person.until(lambda: person.stage == 'idle')
    person.until(lambda: person.press('/drive/zero').success)
    person.wait(1.0)  # the observer has found the foot that stands
    # The observer has got over the new zero of the encoder.
    person.until(lambda: person.press('/safety_gate/arm').success)
    person.until(lambda: person.stage == 'active')
    assert person.press('/drive/enable').success
    person.until(lambda: robot.report()['state'] == 'operation enabled')
    person.wait(2.0)


FAULTS = {
    'imu_silent': lambda robot, nodes: robot.ask('imu_silent'),
    'imu_unplugged': lambda robot, nodes: robot.ask('imu_unplug'),
    'drive_fault': lambda robot, nodes: robot.ask('drive_fault 0x2310'),
    'bus_unplugged': lambda robot, nodes: robot.ask('can_unplug'),
    'bus_silent': lambda robot, nodes: robot.ask('can_silent'),
    **{
        f'{name}_killed': lambda robot, nodes, name=name: os.kill(
            nodes[name].pid, signal.SIGKILL)
        for name in ('drive', 'imu', 'observer', 'balance', 'safety_gate')
    },
    'balance_stopped': lambda robot, nodes: os.kill(nodes['balance'].pid, signal.SIGSTOP),
}  # fmt: skip
