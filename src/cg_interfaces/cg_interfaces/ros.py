"""What every node of this project shares: declared settings, stamps, the spinning loop.

The only module outside `*_node.py` that imports rclpy. A node is built on three things:

- `DeclaredSettings` declares the fields of a frozen Settings class as ROS parameters with
  description, unit and range, and keeps the present instance.
- `run` makes the node, spins it in one thread until it is told to stop, and always calls its
  `close`, while the context still stands, so that a last zero torque can go out.
- A node that has something to do between messages has `poll() -> float`: it does what is due
  and returns in how many s it wants to be asked again. One that must not lose what is on its way
  when it is told to stop has `linger`, the s for which it goes on listening. One whose `poll` may
  be due without a pause has `eagerness`, the messages that it takes from one to the next.
"""

import dataclasses
import gc
import inspect
import os
import sys
import time
import typing
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import rclpy
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rclpy.duration import Duration
from rclpy.exceptions import ParameterException
from rclpy.experimental.events_executor import EventsExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import remove_ros_args

from cg_dynamics.stop_request import StopRequest, end_at_once, end_with_parent
from cg_interfaces.localhost import keep_to_localhost
from cg_interfaces.priority import take_priority
from cg_interfaces.settings import Settings, describe, table
from cg_interfaces.stamps import NS_PER_S

SENSOR_QOS = QoSProfile(depth=10, reliability=ReliabilityPolicy.RELIABLE)
# A publisher keeps a second of its samples: a listener that a busy machine held up gets them all.
MACHINE_QOS = QoSProfile(depth=500, reliability=ReliabilityPolicy.RELIABLE)
LATCHED_QOS = QoSProfile(
    depth=1,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)
IDLE_POLL = 0.05  # s
FAREWELL = 0.3  # s that listeners are given to receive the last words of a node
EXECUTABLE = 'node'  # rcl expects the name of the program first
LARGEST_DOUBLE = sys.float_info.max
LARGEST_INTEGER = 2**63 - 1

PARAMETER_TYPES = {
    bool: Parameter.Type.BOOL,
    int: Parameter.Type.INTEGER,
    float: Parameter.Type.DOUBLE,
    str: Parameter.Type.STRING,
    tuple[float, ...]: Parameter.Type.DOUBLE_ARRAY,
    tuple[str, ...]: Parameter.Type.STRING_ARRAY,
}


S = typing.TypeVar('S', bound=Settings)


class DeclaredSettings(typing.Generic[S]):
    """The settings of a node, declared as ROS parameters and kept up to date.

    Attributes:
        values: The present, valid instance of the Settings class.
    """

    def __init__(
        self,
        node: Node,
        kind: type[S],
        at_work: Callable[[], bool] = lambda: True,
    ):
        """Declare every field of `kind` on the node.

        Args:
            node: Gets the parameters.
            kind: The Settings class.
            at_work: Tells whether settings that are not live must be refused now.

        Raises:
            ValueError: A value given at the start is not allowed.
        """
        hints = typing.get_type_hints(kind)
        given = {}
        for field in dataclasses.fields(kind):
            given[field.name] = _declare(node, field, PARAMETER_TYPES[hints[field.name]])
        self.values: S = kind(**given)
        self._at_work = at_work
        node.add_on_set_parameters_callback(self._judge)
        node.add_post_set_parameters_callback(self._adopt)

    def _mine(self, parameters: list[Parameter]) -> dict[str, Any]:
        names = {field.name for field in dataclasses.fields(self.values)}
        return {p.name: p.value for p in parameters if p.name in names}

    def _judge(self, parameters: list[Parameter]) -> SetParametersResult:
        changes = self._mine(parameters)
        for name in changes:
            if self._at_work() and not self.values.field(name).metadata['live']:
                return SetParametersResult(
                    successful=False, reason=f'{name} cannot change while the node is at work'
                )
        try:
            dataclasses.replace(self.values, **changes)
        except ValueError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _adopt(self, parameters: list[Parameter]) -> None:
        self.values = dataclasses.replace(self.values, **self._mine(parameters))


def _declare(node: Node, field: dataclasses.Field, type_: Parameter.Type) -> Any:
    """Declare one parameter; its value, which is the default unless one was given."""
    name, default, descriptor = field.name, field.default, _descriptor(field, type_)
    if default != ():
        value = list(default) if isinstance(default, tuple) else default
        return node.declare_parameter(name, value, descriptor).value
    # rclpy takes an empty list for bytes, unless it is told the type apart from the value.
    declared = node.declare_parameter(name, type_, descriptor)
    if declared.type_ == Parameter.Type.NOT_SET:
        node.set_parameters([Parameter(name, type_, [])])
        return []
    return declared.value


def _descriptor(field: dataclasses.Field, type_: Parameter.Type) -> ParameterDescriptor:
    low, high = field.metadata['minimum'], field.metadata['maximum']
    descriptor = ParameterDescriptor(
        name=field.name, type=type_.value, description=describe(field)
    )
    if low is None and high is None:
        return descriptor
    if type_ == Parameter.Type.DOUBLE:
        descriptor.floating_point_range = [
            FloatingPointRange(
                from_value=-LARGEST_DOUBLE if low is None else float(low),
                to_value=LARGEST_DOUBLE if high is None else float(high),
            )
        ]
    if type_ == Parameter.Type.INTEGER:
        descriptor.integer_range = [
            IntegerRange(
                from_value=-LARGEST_INTEGER if low is None else int(low),
                to_value=LARGEST_INTEGER if high is None else int(high),
            )
        ]
    return descriptor


def to_stamp(nanoseconds: int) -> Time:
    """ROS stamp of a time in ns."""
    seconds, rest = divmod(nanoseconds, NS_PER_S)
    return Time(sec=seconds, nanosec=rest)


def to_nanoseconds(stamp: Time) -> int:
    """Time in ns of a ROS stamp."""
    return stamp.sec * NS_PER_S + stamp.nanosec


def publish_status(
    publisher: Publisher, status: DiagnosticStatus, values: Mapping[str, Any]
) -> None:
    """Publish how a node does on /diagnostics, with figures by name."""
    status.values = [KeyValue(key=name, value=str(value)) for name, value in values.items()]
    array = DiagnosticArray(status=[status])
    array.header.stamp = to_stamp(time.time_ns())
    publisher.publish(array)


class Throttled:
    """A way to the log that takes a message at most once in so many s.

    The logger's own throttle looks for its caller in the stack first, each time: too long for a
    loop of 2 ms.
    """

    def __init__(self, log: Callable[[str], Any], period: float = 1.0):
        self._log, self._period, self._next = log, period, 0.0

    def __call__(self, message: str) -> None:
        """Log the message, or let it go."""
        now = time.monotonic()
        if now >= self._next:
            self._next = now + self._period
            self._log(message)


def run(
    make_node: Callable[[], Node],
    settings: type[Settings],
    args: list[str] | None = None,
    niceness: int = 0,
    parting: int = 0,
) -> int:
    """Make a node and spin it until it is told to stop (stop_request.py) or has `finished`.

    Args:
        make_node: The class of the node.
        settings: What it declares, for `--help`.
        args: Of the command line; those of this process if None.
        niceness: Of this process from now on, 0 to keep what it has. An ordinary user may not
            lower it; then it stays.
        parting: Niceness while it ends, where that is work that nobody waits for.

    Returns:
        Exit status: 0 for a clean end, the node's `exit_status` if it has one, 2 for arguments
        or settings that are refused.
    """
    given = sys.argv[1:] if args is None else args
    if not {'-h', '--help'}.isdisjoint(given):
        print(usage(make_node, settings))
        return 0
    strangers = remove_ros_args([EXECUTABLE, *given])[1:]
    if strangers:
        print(
            f'error: unknown argument {strangers[0]!r}; parameters are given by '
            '--ros-args -p NAME:=VALUE (--help lists them)',
            file=sys.stderr,
        )
        return 2
    # Until the node stands it has sent nothing: there is nothing that it must leave in order.
    end_at_once()
    if niceness:
        # Before anything starts a thread: threads inherit it.
        take_priority(niceness)
    end_with_parent()
    keep_to_localhost(os.environ)
    # rclpy's own handlers would shut the context down before the node can send its last torque.
    try:
        rclpy.init(args=args, signal_handler_options=SignalHandlerOptions.NO)
    except RuntimeError as error:  # arguments that rcl cannot parse
        print(f'error: {error}', file=sys.stderr)
        return 2
    try:
        try:
            node = make_node()
            stop = StopRequest()
        except (ValueError, OSError, ParameterException, rclpy_implementation.RCLError) as error:
            # The middleware's own errors have lines: no security in it, keys that it refuses.
            print(f'error: {" ".join(str(error).split())}', file=sys.stderr)
            return 2
        # What stands now stays: a search for garbage among it would cost milliseconds at a time.
        gc.freeze()
        try:
            spin(node, lambda: stop.requested)
        finally:
            if parting:
                take_priority(parting)
            getattr(node, 'close', lambda: None)()
            _see_off(node)
            node.destroy_node()
        return getattr(node, 'exit_status', 0)
    finally:
        rclpy.try_shutdown()


def _see_off(node: Node) -> None:
    """Wait until the last words of a node are received: a writer that is gone repeats none."""
    deadline = time.monotonic() + FAREWELL
    for publisher in node.publishers:
        left = max(0.0, deadline - time.monotonic())
        publisher.wait_for_all_acked(Duration(seconds=left))


def usage(make_node: Callable[[], Node], settings: type[Settings]) -> str:
    """What `--help` says: the text at the head of the node's module, and its parameters."""
    package, _, executable = make_node.__module__.partition('.')
    if make_node.__module__ == '__main__':
        executable = Path(sys.argv[0]).stem
    text = inspect.cleandoc(sys.modules[make_node.__module__].__doc__ or '')
    return '\n'.join([
        f'usage: {executable or package} [--ros-args [-p PARAMETER:=VALUE] [-r TOPIC:=OTHER] ...]',
        '', text, '',
        'parameters [default], * may change while the node is at work:', table(settings),
    ])  # fmt: skip


def spin(node: Node, stopped: Callable[[], bool]) -> None:
    """Serve a node's messages and its `poll` in this thread until `stopped` or `finished`."""
    executor = EventsExecutor()
    executor.add_node(node)
    poll = getattr(node, 'poll', lambda: IDLE_POLL)
    eagerness = getattr(node, 'eagerness', 1) - 1
    while not stopped() and not getattr(node, 'finished', False):
        # A wait without a time-out hangs in this executor.
        executor.spin_once(timeout_sec=min(max(poll(), 0.0), IDLE_POLL))
        for _ in range(eagerness):
            executor.spin_once(timeout_sec=0.0)
    deadline = time.monotonic() + getattr(node, 'linger', 0.0)
    while time.monotonic() < deadline:
        executor.spin_once(timeout_sec=0.01)
    executor.remove_node(node)
