"""What a step of the checklist is, and what steps are told.

A step measures numbers and judges them: two functions, so that a judgement can be tried on any
numbers. Numbers of a step have their units in their names.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from cg_dynamics.model import Model
from cg_dynamics.rig import Setup
from cg_hardware.checklist.measuring import Heard
from cg_hardware.checklist.robot import Hands, Refused, Robot
from cg_hardware.imu.mounting import STILL

Numbers = dict[str, Any]

# Channel of a measurement -> node and parameter that state its rate.
STATED = {'imu_angle': ('imu', 'rate_hz'), 'hip_angle': ('drive', 'sample_rate_hz')}
WITHIN = 10.0  # s in which a person does what was asked
SETTLED_S = 0.5  # s of stillness


@dataclass(frozen=True)
class Plan:
    """What the steps are told.

    Attributes:
        model: What the robot is believed to be.
        setup: What holds it.
        torque: The small torque in N m.
    """

    model: Model
    setup: Setup = field(default_factory=lambda: Setup(fixture='inner_fixed'))
    torque: float = 4.0


@dataclass(frozen=True)
class Judged:
    """A verdict and its reason in words."""

    passed: bool
    reason: str


@dataclass(frozen=True)
class Step:
    """One step.

    Attributes:
        name: In records and on the command line.
        title: For people.
        ask: What a person has to do first; empty for nothing.
        measure: Does it and measures.
        judge: Says whether the numbers are right.
        hands: What emulated hands do instead of the person.
        needs: Steps without which this one means nothing.
        torque: Whether the hip is torqued.
    """

    name: str
    title: str
    ask: str
    measure: Callable[[Robot, Plan], Numbers]
    judge: Callable[[Numbers, Plan], Judged]
    hands: Hands = ()
    needs: tuple[str, ...] = ()
    torque: bool = False


def rounded(numbers: Mapping[str, float], prefix: str = '') -> Numbers:
    """Six digits of each, under names that begin with the prefix."""
    return {prefix + name: float(f'{value:.6g}') for name, value in numbers.items()}


def all_well(*problems: str | bool, fine: str) -> Judged:
    """Failed, for the problems that there are, or passed."""
    wrong = [problem for problem in problems if isinstance(problem, str) and problem]
    return Judged(not wrong, '; '.join(wrong) or fine)


def settle(robot: Robot) -> None:
    """Wait until the legs stand still, as long as a person may take.

    Raises:
        Refused: They do not.
    """

    def still(heard: Heard) -> bool:
        return all(
            heard[channel].span > SETTLED_S
            and float(np.std(heard[channel].last(SETTLED_S))) < STILL
            for channel in STATED
        )

    if not still(robot.listen(WITHIN, until=still)):
        raise Refused(f'the legs do not come to rest within {WITHIN:g} s')
