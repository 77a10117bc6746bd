"""What an experimenter does with a real robot: the checklist, or an experiment. No ROS."""

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from cg_bringup import wired_experiment
from cg_bringup.wired_experiment import RecordedRobot, WiredExperiment, identities
from cg_description.paths import NOMINAL_MODEL, model_path
from cg_dynamics.model import Model
from cg_hardware.checklist import record
from cg_hardware.checklist.plan import Plan
from cg_hardware.checklist.robot import Refused, Robot
from cg_hardware.checklist.sensing import DEVICES
from cg_hardware.checklist.steps import NAMES, STEPS
from cg_hardware.checklist.walk import FAILED, Result, walk
from cg_hardware.simulation import read_setup
from cg_interfaces.dates import iso_now
from cg_interfaces.settings import Settings, setting
from cg_sysid.experiments.catalogue import load_experiment

TASKS = 'checklist', 'experiment'
HEARD_S = 1.5  # s in which /diagnostics come
# Node -> settings that a record of the checklist keeps.
KEPT = {
    'imu': ('rate_hz', 'axis', 'sign'),
    'drive': ('sample_rate_hz', 'sign', 'gear', 'counts_per_turn', 'torque_limit', 'stale_after'),
    'safety_gate': ('torque_limit', 'stale_after', 'rate_limit', 'fall_angle'),
}


@dataclass(frozen=True)
class TaskSettings(Settings):
    """What the experimenter is told."""

    task: str = setting('checklist', 'what the experimenter does', choices=TASKS)
    model_file: str = setting('', 'what the robot is believed to be; empty: the nominal one')
    checklists: str = setting('checklists', 'folder of the records of checklists')
    setup: str = setting(
        'fixture: inner_fixed', 'checklist: what holds the robot, YAML text or a file'
    )
    torque: float = setting(
        4.0, 'checklist: the small torque', unit='N m', minimum=0.1, maximum=20.0
    )
    steps: tuple[str, ...] = setting((), f'checklist: these only, of {", ".join(NAMES)}')
    without_torque: bool = setting(False, 'checklist: leave out what torques the hip')
    go_on: bool = setting(False, 'checklist: go on after a step that failed')
    experiment: str = setting('', 'experiment: a name or a .yaml file')
    duration: float = setting(
        0.0, 'experiment: length, 0 for its own', unit='s', minimum=0.0, maximum=3600.0
    )
    seed: int = setting(1, 'experiment: seed of the excitation', minimum=0)

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in self.steps:
            if name not in NAMES:
                raise ValueError(f'steps has {name!r}; there are {", ".join(NAMES)}')


class LiveRobot(RecordedRobot, Protocol):
    """The live robot, of which it must first be found out whether it is emulated."""

    def find_hands(self) -> None:
        """See whether the robot is emulated."""


def carry_out(robot: LiveRobot, settings: TaskSettings) -> int:
    """Do what the settings say.

    Returns:
        Exit status: 0 if all went well.

    Raises:
        Refused: The robot does not do what it must.
        ValueError: A model, set-up or experiment that cannot be read.
    """
    robot.find_hands()
    if settings.task == 'checklist':
        return go_through(robot, settings)
    experiment = load_experiment(settings.experiment)
    wired_experiment.carry_out(robot, WiredExperiment(
        experiment, settings.duration or experiment.duration, settings.seed,
        model_path(settings.model_file or NOMINAL_MODEL), Path(settings.checklists),
    ))  # fmt: skip
    return 0


def go_through(robot: Robot, settings: TaskSettings) -> int:
    """Go through the checklist, and keep what comes of it after each step."""
    path = model_path(settings.model_file or NOMINAL_MODEL)
    plan = Plan(Model.load(path), read_setup(settings.setup), settings.torque)
    steps = [
        step for step in STEPS
        if (not settings.steps or step.name in settings.steps)
        and not (step.torque and settings.without_torque)
    ]  # fmt: skip
    begun = begin(robot, path, plan)
    file = record.path_in(Path(settings.checklists), begun['date'])
    results: list[Result] = []

    def so_far() -> record.Record:
        complete = len(results) == len(steps)
        return record.Record(**begun, complete=complete, steps=tuple(results))

    def keep(result: Result) -> None:
        results.append(result)
        robot.say(f'{len(results)}/{len(steps)} {result.line}')
        so_far().save(file)

    so_far().save(file)
    walk(robot, plan, steps, settings.go_on, keep)
    robot.say(f'{so_far().line}\n{file}')
    return 1 if any(result.verdict == FAILED for result in results) else 0


def begin(robot: Robot, path: Path, plan: Plan) -> dict[str, Any]:
    """What a record says of robot and model before the first step."""
    robot.listen(HEARD_S)
    devices = {name: device for name in DEVICES if (device := robot.device(name)) is not None}
    return {
        'date': iso_now(), 'emulated': robot.emulated, 'devices': identities(devices),
        'settings': settings_of(robot, KEPT), 'model_file': path.name,
        'model_sha256': hashlib.sha256(path.read_bytes()).hexdigest(),
        'setup': plan.setup.to_dict(),
    }  # fmt: skip


def settings_of(robot: Robot, kept: Mapping[str, Sequence[str]]) -> dict[str, Any]:
    """Settings of the nodes that are there."""
    found: dict[str, Any] = {}
    for node, names in kept.items():
        for name in names:
            try:
                found[f'{node}.{name}'] = robot.setting(node, name)
            except Refused as refused:
                robot.say(str(refused))
                break
    return found
