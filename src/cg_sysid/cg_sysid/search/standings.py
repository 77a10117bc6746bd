"""What a diagnosis knows before it has ended: who leads, and what was not come to."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from cg_sysid.deadline import Deadline
from cg_sysid.search.look import Screening
from cg_sysid.search.nuisance import nuisances
from cg_sysid.search.outcome import Outcome
from cg_sysid.search.task import Task
from cg_sysid.text import listed, number, off_by

NAMED = 3  # candidates that a sentence names
Base = tuple[frozenset[str], bool]  # labels of effects, whether small faults are allowed for


@dataclass(frozen=True)
class Standing:
    """How one candidate stands.

    Attributes:
        label: Label of the effect; of a base alone what it adds to the nominal model.
        in_noise: RMS error that is left with it, in standard deviations of the noise.
        whole: Whether whole records were fitted; otherwise their first seconds.
    """

    label: str
    in_noise: float
    whole: bool

    def __str__(self) -> str:
        where = '' if self.whole else ' in the first seconds'
        return f'{self.label}, {off_by(self.in_noise**2)}{where}'


@dataclass(frozen=True)
class Unfinished:
    """What a diagnosis that was broken off had not come to.

    Attributes:
        why: What ended it, in words.
        seconds: How long it had worked, in s.
        ranking: Candidates for what comes next, the best first.
        not_fitted: Labels of those that were not fitted to whole records.
        not_tried: Labels of those that were not even looked at.
        steps: What else was not done, in words.
        by_torques: Labels of those that were not looked at but torques speak for, with the nats
            that a torque fit gains, the best first (torque_screening.py).
    """

    why: str
    seconds: float
    ranking: tuple[Standing, ...]
    not_fitted: tuple[str, ...]
    not_tried: tuple[str, ...]
    steps: tuple[str, ...]
    by_torques: tuple[tuple[str, float], ...] = ()

    @property
    def text(self) -> str:
        """What a person should know of it, in two or three sentences."""
        text = f'This is the best answer so far: the search was {self.why}.'
        if self.ranking:
            best = '; '.join(map(str, self.ranking[:NAMED]))
            text += f' Candidates for what is left, the best first: {best}.'
        if self.by_torques:
            best = '; '.join(f'{label}, {number(n)} nats' for label, n in self.by_torques[:NAMED])
            text += f' Torques alone, without a simulation, speak for {best}.'
        missing = [
            f'{what} of {_few(labels)}'
            for what, labels in (('whole fits', self.not_fitted), ('first looks', self.not_tried))
            if labels
        ]
        return f'{text} Not done: {"; ".join([*missing, *self.steps])}.'


def left_undone(deadline: Deadline, step: str) -> Unfinished:
    """A search that its deadline kept from this step alone."""
    return Unfinished(deadline.why, deadline.passed, (), (), (), (step,))


class SoFar:
    """Fits and first looks as they come in.

    Args:
        stated: Labels of the effects that the nominal model has.
    """

    def __init__(self, stated: frozenset[str]):
        self._stated = stated
        self._all_screened: dict[Base, dict[str, Screening]] = {}
        self._outcomes: dict[Base, dict[str, Outcome]] = {}
        # By what they add to the nominal model; first looks come after fits to whole records.
        self._standings: dict[str, tuple[bool, float]] = {}

    def note(self, result: Any) -> None:
        """Take in one more result; others than fits and looks say nothing here."""
        if isinstance(result, Outcome):
            if result.task.effect is not None:
                known = self._outcomes.setdefault(base_of(result.task), {})
                before = known.get(result.label)
                if before is None or result.train.squares < before.train.squares:
                    known[result.label] = result
            added = frozenset(effect.label for effect in result.model.effects)
            added -= self._stated | nuisances(result.model, result.task.bounds)
            self._lead(False, result.train.normalised_error, added)
        elif isinstance(result, Screening):
            self._all_screened.setdefault(base_of(result.task), {})[result.label] = result
            if result.error > 0:
                added = frozenset(effect.label for effect in result.task.model.effects)
                self._lead(True, result.error, (added - self._stated) | {result.label})

    def _lead(self, looked: bool, error: float, added: frozenset[str]) -> None:
        label = title_of(added)
        self._standings[label] = min(self._standings.get(label, (True, np.inf)), (looked, error))

    @property
    def best(self) -> str:
        """Who leads, and who follows, in words."""
        order = sorted(self._standings.items(), key=lambda item: item[1])[:NAMED]
        if not order:
            return ''
        (label, (looked, error)), *others = order
        text = str(Standing(label, error**0.5, not looked))
        following = ', '.join(f'{label} ({error**0.5:.3g})' for label, (_, error) in others)
        return f'{text}; then {following}' if others else text

    def fitted(self, base: Task) -> list[Outcome]:
        """Candidates on top of a base that were fitted to whole records."""
        return list(self._outcomes.get(base_of(base), {}).values())

    def screened(self, base: Task) -> list[Screening]:
        """Candidates on top of a base that were looked at."""
        return list(self._all_screened.get(base_of(base), {}).values())

    def ranking(self, base: Task) -> tuple[Standing, ...]:
        """Candidates on top of a base, the best first; whole fits before first looks."""
        fitted = {
            o.label: Standing(o.label, o.train.normalised_error**0.5, True)
            for o in self.fitted(base)
        }
        screenings = [
            Standing(screening.label, screening.error**0.5, False)
            for screening in self.screened(base)
            if screening.error >= 0 and screening.label not in fitted
        ]
        return tuple(
            standing for some in (fitted.values(), screenings)
            for standing in sorted(some, key=lambda s: s.in_noise)
        )  # fmt: skip


def base_of(task: Task) -> Base:
    """What tells bases apart: their effects, and whether small faults are allowed for."""
    return frozenset(effect.label for effect in task.model.effects), bool(task.bounds)


def title_of(added: frozenset[str]) -> str:
    """The nominal model and what was put on top of it, in words."""
    return ' + '.join(['nominal', *sorted(added)])


def _few(labels: Sequence[str]) -> str:
    if len(labels) <= NAMED + 1:
        return listed(list(labels))
    return f'{", ".join(labels[:NAMED])} and {len(labels) - NAMED} more'
