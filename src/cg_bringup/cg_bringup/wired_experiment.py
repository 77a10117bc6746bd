"""An experiment on a real robot that is running: pose, note, torque, and no torque. No ROS."""

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import yaml

from cg_hardware.checklist import record
from cg_hardware.checklist.measuring import Heard
from cg_hardware.checklist.plan import STATED
from cg_hardware.checklist.robot import Device, Refused, Robot
from cg_hardware.checklist.sensing import DEVICES
from cg_hardware.imu.mounting import STILL
from cg_hardware.simulation import SOFTWARE
from cg_sysid.experiments.catalogue import Experiment
from cg_sysid.experiments.excitation import ExcitationSettings, make_signal

STILL_S = 1.0  # s for which the legs must be still before it begins
PATIENCE = 60.0  # s for the legs to come to rest, and for a recorder to hear everything
RECORDER_S = 1.5  # s after which a recorder that hears everything has begun
TAIL = 0.2  # s that are recorded after the torque
EXPERIMENTER = 'experimenter: '  # before what it tells the person during an experiment
LEAST_REST = 1.5  # s of diagnostics and measurements before anything is asked


class RecordedRobot(Robot, Protocol):
    """A robot that experiments are recorded on."""

    def announce(self, note: str) -> None:
        """Publish the recording note."""

    def await_recorder(self, patience: float) -> None:
        """Wait until a recorder hears everything.

        Raises:
            Refused: None does.
        """


@dataclass(frozen=True)
class WiredExperiment:
    """What is done.

    Attributes:
        experiment: Of the catalogue.
        duration: In s.
        seed: Of the excitation.
        model_file: What the robot is believed to be.
        checklists: Folder of the records of checklists.
    """

    experiment: Experiment
    duration: float
    seed: int
    model_file: Path
    checklists: Path


def carry_out(robot: RecordedRobot, what: WiredExperiment) -> None:
    """Carry it out: the robot is held as the experiment wants it, and hears the torque.

    Raises:
        Refused: Sensors that nobody zeroed, legs that do not come to rest, a fault.
    """
    robot.listen(LEAST_REST)
    note = note_of(robot, what)
    robot.say('the legs must come to rest')
    _await_rest(robot)
    robot.announce(note)
    robot.await_recorder(PATIENCE)
    robot.listen(RECORDER_S)
    if what.experiment.excitation.get('kind') == 'none':
        robot.say('let go of the legs now')
        robot.listen(what.duration + TAIL)
        return
    try:
        if what.experiment.setup.fixture != 'none' or what.experiment.setup.springs:
            robot.change('safety_gate', 'fall_angle', 0.0)  # what is held cannot fall
        robot.take_control()
        robot.say(f'{what.duration:g} s of torque')
        _torque(robot, what)
    finally:
        robot.rest()
    robot.listen(TAIL)


def _torque(robot: Robot, what: WiredExperiment) -> None:
    settings = ExcitationSettings(
        **what.experiment.excitation, duration=what.duration, seed=what.seed
    )

    def failed(heard: Heard) -> bool:
        return robot.stage.startswith('fault') or bool(np.any(heard['enabled'].values[-1:] == 0))

    # The signal is zero after its duration: so the last command of the record is one.
    if failed(robot.listen(what.duration + TAIL, make_signal(settings), failed)):
        drive = robot.device('drive')
        raise Refused(
            f'the experiment ended early: the gate says {robot.stage}, the drive, when it was '
            f'last heard, {drive.state if drive else "nothing"}'
        )


def _await_rest(robot: Robot) -> None:
    def still(heard: Heard) -> bool:
        return all(
            heard[channel].span >= STILL_S and float(np.std(heard[channel].last(STILL_S))) < STILL
            for channel in STATED
        )

    heard = robot.listen(PATIENCE, until=still)
    if not still(heard):
        raise Refused(f'the legs do not come to rest within {PATIENCE:g} s')


def note_of(robot: Robot, what: WiredExperiment) -> str:
    """The YAML text of /experiment: interfaces.md, "The recording note".

    Raises:
        Refused: A device is not heard, or its sensor was never zeroed.
    """
    found = {name: robot.device(name) for name in DEVICES}
    devices = {name: device for name, device in found.items() if device is not None}
    for name in DEVICES:
        if name not in devices:
            raise Refused(f'the {name} is not heard on /diagnostics: is the robot running?')
    zeroed = {name: device.values.get('zeroed_at', '') for name, device in devices.items()}
    for name, at in zeroed.items():
        if not at:
            raise Refused(
                f'the {name} was not zeroed since its node started: legs upright and parallel, '
                f'call /{name}/zero'
            )
    free = what.experiment.excitation.get('kind') == 'none'
    note = {
        'format': 'cg_recording/1',
        'experiment': what.experiment.name,
        'mechanism': 'compass_gait',
        'setup': what.experiment.setup.to_dict(),
        'nominal_rate_hz': float(robot.setting('imu', 'rate_hz')),
        'sensor_zeros': {'imu_angle': devices['imu'].number('zero_rad'), 'hip_angle': 0.0},
        'zeroed_at': min(zeroed.values()),
        'initial_state': 'unknown' if free else 'rest',
        'model_file': what.model_file.name,
        'model_sha256': hashlib.sha256(what.model_file.read_bytes()).hexdigest(),
        'software': SOFTWARE,
        'closed_loop': False,
        'notes': 'emulated devices' if robot.emulated else '',
        'checklist': record.latest_reference(
            what.checklists, identities(devices), robot.emulated
        ),
    }  # fmt: skip
    return yaml.safe_dump(note, sort_keys=False, allow_unicode=True)


def identities(devices: Mapping[str, Device]) -> dict[str, str]:
    """Device -> what it says of itself."""
    return {name: device.identity or 'unknown' for name, device in devices.items()}


def pose_in_words(experiment: Experiment) -> list[str]:
    """What a person does to the robot before the experiment, a sentence each."""
    setup: Any = experiment.setup
    held = {
        'none': f'The robot stands on its {setup.stance} feet.',
        'inner_fixed': 'The inner legs are clamped upright, the outer legs hang free.',
        'outer_fixed': 'The outer legs are clamped upright, the inner legs hang free.',
        'legs_tied': 'The legs are tied parallel.',
    }
    told = [held[setup.fixture]]
    told += [
        f'A spring of {spring.stiffness:g} N/m, {spring.free_length:g} m long when slack, pulls '
        f'the {spring.body} legs {spring.point:g} m from the foot towards '
        f'x = {spring.anchor[0]:g} m, z = {spring.anchor[1]:g} m.'
        for spring in setup.springs
    ]
    if setup.on_blocks and setup.fixture == 'none':
        told.append('The stance feet stand on blocks, so that the others swing free.')
    if experiment.excitation.get('kind') == 'none':
        half = len(experiment.initial_state) // 2
        angles = ', '.join(f'{angle:g}' for angle in experiment.initial_state[:half])
        told.append(f'Hold the free legs at {angles} rad until you are told to let go.')
    else:
        told.append('The legs are at rest, and nobody touches them.')
    return told
