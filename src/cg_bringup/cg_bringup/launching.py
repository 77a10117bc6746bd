"""What the launch files share: nodes as actions, and an end that `ros2 launch` reports.

`ros2 launch` of Jazzy exits with 1 when an exception was raised while it ran, and with 0 whatever
its nodes exit with. So the handler of a node that must not die raises: the launch says why, shuts
the others down at once and exits with 1.
"""

import atexit
import shlex
import shutil
import signal
import sys
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path

import launch.logging
from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction, RegisterEventHandler, Shutdown
from launch.event_handlers import OnProcessExit
from launch.events.process import ProcessExited
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from cg_bringup.balance_run import MACHINE, verdict_of, with_outcome
from cg_bringup.runs import NodeOf, enclave_arguments, parameter_file_text
from cg_bringup.verdict import Verdict
from cg_description.reading import parse_yaml
from cg_description.schema import ListOf, Number
from cg_dynamics.stop_request import ON_STDIN
from cg_hardware.standing import Outcome

TOLD = (0, -signal.SIGINT, -signal.SIGTERM)  # exit codes of a node that was told to end
PREFIX = f' {shlex.quote(sys.executable)} -m cg_dynamics.stop_request'
# Name -> default, description, and the values allowed or None for any.
Arguments = Mapping[str, tuple[str, str, list[str] | None]]


class RequiredProcessDied(RuntimeError):
    """A node ended that should not have, or the robot did not do what was asked."""


def description(
    arguments: Arguments, start: Callable[[dict[str, str]], list]
) -> LaunchDescription:
    """A launch description of these arguments.

    Args:
        arguments: What the user may give.
        start: Argument name -> text that was given; returns the actions.
    """

    def started(context: LaunchContext) -> list:
        return start({name: LaunchConfiguration(name).perform(context) for name in arguments})

    declared = [
        DeclareLaunchArgument(name, default_value=default, description=text, choices=choices)
        for name, (default, text, choices) in arguments.items()
    ]
    return LaunchDescription([*declared, OpaqueFunction(function=started)])


def number(given: Mapping[str, str], name: str, kind: Callable = float):
    """A number that was given as an argument.

    Raises:
        ValueError: It is none.
    """
    try:
        return kind(given[name])
    except ValueError:
        what = 'a whole number' if kind is int else 'a number'
        raise ValueError(f'{name} is {given[name]!r}; {what} is needed') from None


def pushes_of(text: str) -> list[float]:
    """Instants and impulses of a list in YAML, `[t1, P1, t2, P2, ...]`."""
    return ListOf(Number()).of(parse_yaml(text, 'pushes') or [], 'pushes')


def node_actions(
    nodes: Mapping[str, NodeOf], judge: Callable[[Outcome], Verdict] | None = None
) -> list:
    """Actions that start nodes, all of which the launch needs, until the machine has finished.

    Args:
        nodes: Node name -> what to start.
        judge: Says whether what the robot did is what was asked; None if nothing was.
    """
    directory = Path(tempfile.mkdtemp(prefix='cg_launch_'))
    atexit.register(shutil.rmtree, directory, ignore_errors=True)
    outcome = directory / 'outcome.json'
    if judge is not None:
        nodes = with_outcome(dict(nodes), outcome)
    parameters = directory / 'parameters.yaml'
    parameters.write_text(parameter_file_text(nodes), encoding='utf-8')
    actions = {
        name: Node(
            package=node.package,
            executable=node.executable,
            name=name,
            exec_name=node.executable,
            parameters=[str(parameters)],
            remappings=list(node.remappings),
            ros_arguments=enclave_arguments(name),
            output='screen',
            # `ros2 launch` keeps the other end of its nodes' standard input.
            additional_env=ON_STDIN,
            prefix=[LaunchConfiguration('launch-prefix', default=''), PREFIX],
            sigterm_timeout=str(node.ending),
            sigkill_timeout=str(node.ending),
        )
        for name, node in nodes.items()
    }

    def verdict() -> Verdict:
        if judge is None:
            return Verdict(True, 'the machine has finished')
        return verdict_of(outcome, judge)

    def on_exit(event: ProcessExited, context: LaunchContext) -> list | None:
        name = next(name for name, action in actions.items() if action is event.action)
        if context.is_shutdown and event.returncode in TOLD:
            if name == MACHINE and judge is not None:
                launch.logging.get_logger(MACHINE).info(verdict().line)
            return None
        if name != MACHINE or event.returncode != 0:
            reason = f'{name} ended with exit code {event.returncode}'
            if name == MACHINE and judge is not None:
                reason = f'{reason}: {verdict().line}'
            raise RequiredProcessDied(reason)
        found = verdict()
        if not found.worked:
            raise RequiredProcessDied(found.line)
        launch.logging.get_logger(MACHINE).info(found.line)
        return [Shutdown(reason=found.line)]

    handlers = [
        RegisterEventHandler(OnProcessExit(target_action=action, on_exit=on_exit))
        for action in actions.values()
    ]
    # Handlers first: a node may die before the next action is visited.
    return [*handlers, *actions.values()]
