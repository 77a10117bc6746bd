"""Walking through a checklist with a person, one step after the other."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

from cg_hardware.checklist.plan import Plan, Step
from cg_hardware.checklist.robot import Quit, Refused, Robot, Skipped

PASSED, FAILED, SKIPPED = 'passed', 'failed', 'skipped'


@dataclass(frozen=True)
class Result:
    """What came of one step.

    Attributes:
        name: Of the step.
        title: Of the step.
        verdict: passed, failed or skipped.
        reason: In words.
        measured: Numbers, with their units in their names.
    """

    name: str
    title: str
    verdict: str
    reason: str
    measured: dict[str, Any] = field(default_factory=dict)

    @property
    def line(self) -> str:
        """For people."""
        return f'{self.title}: {self.verdict}. {self.reason}'


def walk(
    robot: Robot,
    plan: Plan,
    steps: Sequence[Step],
    go_on: bool = False,
    on_result: Callable[[Result], None] = lambda result: None,
) -> list[Result]:
    """Walk through the steps; after each the robot is at rest, without torque.

    Args:
        robot: The robot.
        plan: What the steps are told.
        steps: In order.
        go_on: Whether the steps after a failed one are carried out.
        on_result: Called after each step.

    Returns:
        One result for each step. After the end that a person or a failed step makes, the rest is
        skipped.
    """
    results: list[Result] = []
    over = ''
    for step in steps:
        verdicts = {result.name: result.verdict for result in results}
        lacking = [name for name in step.needs if verdicts.get(name, PASSED) != PASSED]
        if over or lacking:
            reason = over or f'it means nothing before {", ".join(lacking)} has passed'
            result = Result(step.name, step.title, SKIPPED, reason)
        else:
            try:
                result = carry_out(robot, plan, step)
            except Quit:
                over = 'the person ended the checklist'
                result = Result(step.name, step.title, SKIPPED, over)
        results.append(result)
        on_result(result)
        if result.verdict == FAILED and not go_on:
            over = over or f'{step.title} failed'
    return results


def carry_out(robot: Robot, plan: Plan, step: Step) -> Result:
    """Carry out one step; zero torque when it is over, however it ends.

    Raises:
        Quit: The person has had enough.
    """
    measured: dict[str, Any] = {}
    try:
        try:
            if step.ask:
                robot.ask(step.ask, step.hands)
            measured = step.measure(robot, plan)
        finally:
            robot.rest()
        judged = step.judge(measured, plan)
    except Skipped as skipped:
        return Result(step.name, step.title, SKIPPED, str(skipped))
    except Refused as refused:
        return Result(step.name, step.title, FAILED, str(refused), measured)
    verdict = PASSED if judged.passed else FAILED
    return Result(step.name, step.title, verdict, judged.reason, measured)
