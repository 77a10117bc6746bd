"""Successive halving: who is fitted on top of one model, in what order, and how far.

    first look (excerpt.py), the light ones before the heavy, and of these first those that the
    torques of a robot speak for
      -> those that look best are fitted to whole records, then all others within reach,
         each time the light ones first
      -> ever longer fits of those that may still win

Rungs of ever more iterations, after each of which only those go on that may still win, are
successive halving (Jamieson and Talwalkar, "Non-stochastic best arm identification and
hyperparameter optimization", AISTATS 2016), with a rule of reach in place of a half. What one
comes to is what the next are measured by: a fit out of reach that gains little is broken
off, so that a library of effects costs little more than those of them that matter.
"""

import itertools
import logging
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from cg_sysid.errors import Failure
from cg_sysid.identification import along_motion, torque_error
from cg_sysid.identification.data_set import DataSet
from cg_sysid.identification.fit_result import Fit
from cg_sysid.parallel import CarryOut
from cg_sysid.search import settings
from cg_sysid.search.events import undisturbed
from cg_sysid.search.look import Screening, deeper, led_on, rival_of, screen, torque_fits
from cg_sysid.search.model_selection import samples
from cg_sysid.search.nuisance import nuisances
from cg_sysid.search.outcome import Outcome, chi2
from cg_sysid.search.ranking import per_output
from cg_sysid.search.starts import starts_of
from cg_sysid.search.task import EffectAt, Task, effect_of, eventful, label_of
from cg_sysid.search.whole_fit import try_candidate

log = logging.getLogger(__name__)


Effects = Sequence[EffectAt]


class SuccessiveHalving:
    """Fits of candidates on the data sets of one diagnosis.

    Args:
        train: Data sets to fit.
        held: Data sets held out.
        carry_out: Does independent pieces of work: (function, arguments of each, what) -> results.
    """

    def __init__(self, train: Sequence[DataSet], held: Sequence[DataSet], carry_out: CarryOut):
        self.train, self.held, self.carry_out = train, held, carry_out
        self.screenings: dict[tuple, Screening | Failure] = {}  # by _structure

    def fit(self, tasks: Sequence[Task], what: str) -> list[Outcome | Failure]:
        """Fits to whole records, in the order of the tasks; a sentence for one that failed."""
        return self.carry_out(try_candidate, [(t, self.train, self.held) for t in tasks], what)

    def screen(self, tasks: Sequence[Task], what: str) -> list[Screening]:
        """First looks, without those that failed; what was looked at is known.

        Those at the same beside other small faults lead the way.
        """
        new, led = [], []
        for task in tasks:
            if _structure(task) in self.screenings:
                continue
            same = self._known_beside(task)
            if same and not same.task.warm_starts:  # ruled out
                self.screenings[_structure(task)] = same
                continue
            new.append(task)
            led.append(replace(task, warm_starts=same.task.warm_starts) if same else task)
        screenings = self.carry_out(screen, [(task, self.train) for task in led], what)
        for task, screening in zip(new, screenings, strict=True):
            self.screenings[_structure(task)] = screening
            if isinstance(screening, Failure):
                log.info('%s: %s', task.effect, screening)
        known = [self.screenings[_structure(task)] for task in tasks]
        return [screening for screening in known if isinstance(screening, Screening)]

    def screen_beside(self, tasks: Sequence[Task], what: str) -> list[Screening]:
        """First looks, or what is known of the same effects beside other small faults."""
        known = [screening for task in tasks if (screening := self._known_beside(task))]
        effects = {screening.task.effect for screening in known}
        return [*known, *self.screen([t for t in tasks if t.effect not in effects], what)]

    def _known_beside(self, task: Task) -> Screening | None:
        """A look at the same effect on the same causes, as one for this task."""
        for screening in self.screenings.values():
            if not isinstance(screening, Screening) or screening.task.effect != task.effect:
                continue
            if _causes(screening.task) != _causes(task):
                continue
            if screening.task.warm_starts:
                return led_on(screening, task)
            if np.isinf(screening.error) and task.rival is not None:
                return replace(screening, task=task)  # to torques small faults change little
        return None

    def far_behind(self, base: Task, label: str) -> set[EffectAt]:
        """Effects that were out of reach of one of them at a first look.

        On the causes of this base, without small faults.
        """
        looks = [
            s for s in self.screenings.values()
            if isinstance(s, Screening) and not s.task.bounds and _causes(s.task) == _causes(base)
        ]  # fmt: skip
        own = next((_known(look) for look in looks if look.label == label), np.inf)
        limit = settings.HALVING.in_reach * max(own, 1.0)
        return {look.task.effect for look in looks if look.task.effect and look.error > limit}

    def run(
        self,
        base: Task,
        effects: Effects,
        what: str,
        beaten: float = np.inf,
        earned: float = np.inf,
        judged: float = np.inf,
    ) -> tuple[list[Outcome], list[str]]:
        """Fit every effect on top of a base.

        Args:
            base: The task of the base, with its fits.
            effects: Effects and places.
            what: For the progress.
            beaten: chi2/N that is to be beaten, or nearly so.
            earned: chi2/N that has to be come to (ModelSelection.to_be_earned).
            judged: chi2/N of the base on records held out.

        Returns:
            Outcomes of fits to whole records, and labels of others that were not worth one.
        """
        tasks = _on_top(base, effects)
        events = [task for task in tasks if eventful(task)]
        others = [task for task in tasks if not eventful(task)]
        looking = f'first look at {what}'
        screenings = self.screen(_light(others), looking)
        found: dict[str, Outcome] = {}
        if events and _nothing_helps(base, screenings) and self._happened(base, what):
            found, events = self._fitted(events, f'{what}, events'), []
        heavy = _heavy(others, screenings, base, _to_come_to(screenings, base, beaten, found))
        heavy, waiting = self._spoken_for(heavy, base, f'what torques say of {what}')
        screenings += self.screen(_longest_first(heavy), looking)
        tried: set[str] = set()
        found = self._worth_a_fit(screenings, found, tried, base, beaten, earned, what)
        if waiting and np.isinf(_clear(_best(found), base.base)):
            # Who was spoken for explains little: it was none of these.
            screenings += self.screen(_longest_first(waiting), looking)
            found = self._worth_a_fit(screenings, found, tried, base, beaten, earned, what)
            waiting = []
        # To seek events in every record takes long: first what explains most of the error.
        # In records held out, too: something may have happened there and in no other.
        before = _error(base.base)
        if beaten > _most_of(before) and not any(
            o.train.normalised_error <= _most_of(before)
            and o.held.normalised_error <= _most_of(judged)
            for o in found.values()
        ):
            found |= self._fitted(events, f'{what}, events')
        found |= self._in_more_depth(found, base.base, beaten, earned, what)
        return list(found.values()), [
            *map(label_of, waiting), *(s.label for s in screenings if s.label not in tried),
        ]  # fmt: skip

    def run_by_belief(
        self, base: Task, effects: Effects, what: str, beaten: float = np.inf
    ) -> tuple[list[Outcome], list[str]]:
        """The same where nothing but numbers that nobody believes is at stake.

        Then errors do not tell candidates apart, and all that come near are fitted to whole
        records. A rotor that moves by itself and leaves no error cannot be told from one that does
        not (Effect.without_states), and no event is sought.
        """
        tasks = [task for task in _on_top(base, effects) if not eventful(task)]
        elastic = [task for task in tasks if (e := effect_of(task)) is not None and e.elastic]
        others = [task for task in tasks if task not in elastic]
        looking = f'first look at {what}'
        screenings = self.screen(_light(others), looking)
        reach = min(_to_come_to(screenings, base, beaten, {}), _at_stake(base.first))
        heavy = _heavy(others, screenings, base, reach)
        screenings += self.screen(_longest_first(heavy), looking)
        limit = min(settings.HALVING.near * _smallest(screenings), _at_stake(base.first))
        heat = [screening for screening in screenings if not screening.error > limit]
        most, reach = settings.HALVING.rungs[-1], _at_stake(base.base)
        found = self._fitted(
            [replace(look.task, iterations=most, reach=reach) for look in heat], what
        )
        left = [look.label for look in screenings if look not in heat]
        return list(found.values()), [*map(label_of, elastic), *left]

    def _spoken_for(
        self, tasks: Sequence[Task], base: Task, what: str
    ) -> tuple[list[Task], list[Task]]:
        """Those that motion and torques speak for or know nothing of, and those that can wait.

        What moves by itself moves its own joint most. Of what acts there the torques say in
        seconds what a look takes half a minute for. What they explain far worse than another is
        not there, or shows when that one stands.
        """
        if base.base is None or not torque_error.can(base.model):
            return list(tasks), []
        joint = _standing_out(base.base)
        elsewhere = [task for task in tasks if joint is not None and _moves_another(task, joint)]
        tasks = [task for task in tasks if task not in elsewhere]
        new = [
            task for task in tasks
            if task.rival is None and _structure(task) not in self.screenings
            and self._known_beside(task) is None
        ]  # fmt: skip
        said = self.carry_out(torque_fits, [(task, self.train) for task in new], what)
        told = {
            _structure(task): replace(task, torques=fits)
            for task, fits in zip(new, said, strict=True)
        }
        tasks = [told.get(_structure(task), task) for task in tasks]
        limit = min(map(_deviance, tasks), default=np.inf) + settings.SCREENING.clearly
        worse = [task for task in tasks if task.torques and _deviance(task) > limit]
        return [task for task in tasks if task not in worse], [*worse, *elsewhere]

    def _worth_a_fit(
        self,
        screenings: Sequence[Screening],
        found: Mapping[str, Outcome],
        tried: set[str],
        base: Task,
        beaten: float,
        earned: float,
        what: str,
    ) -> dict[str, Outcome]:
        """Fits to whole records of looks within reach, the best and the lightest first.

        To those found are added what else is worth it, and to those tried their labels.
        """
        found = dict(found)
        favoured = _favoured(_smallest(screenings))
        for limit, of_heavy in itertools.product((favoured, np.inf), (False, True)):
            best = _best(found)
            reach = min(
                _reach(best),
                settings.HALVING.as_good * beaten,
                worth_having(best, base.base),
                earned,
            )
            # Looks may mislead. But once one fit is at the noise, only others there can rival it.
            undecided = np.isinf(beaten) and best > settings.NOISE.much_wrong
            fewest = settings.HALVING.fewest if undecided and not of_heavy else 0
            heat = [screening for screening in _worth_more(screenings, reach, base.first, fewest)
                    if screening.label not in tried and _known(screening) <= limit
                    and _is_heavy(screening.task) == of_heavy]  # fmt: skip
            tried.update(screening.label for screening in heat)
            found |= self._fitted(
                [replace(screening.task, reach=reach) for screening in heat], what
            )
        return found

    def _in_more_depth(
        self,
        found: Mapping[str, Outcome],
        base: Fit | None,
        beaten: float,
        earned: float,
        what: str,
    ) -> dict[str, Outcome]:
        """Ever longer fits of those that may still win."""
        found, beaten = dict(found), min(beaten, _error(base))
        gained: dict[str, float] = {}
        for iterations in settings.HALVING.rungs[1:]:
            limit = min(earned, worth_having(_best(found), base))
            going = [o for o in _may_still_win(found, gained, beaten, limit)
                     if not eventful(o.task) or _has_taken_half(o, base)]  # fmt: skip
            again = self._fitted(
                [replace(o.task, warm_starts=(o.train,), iterations=iterations) for o in going],
                f'{what}, in more depth',
            )
            gained = {n: chi2(found[n]) - chi2(o) for n, o in again.items()}
            found |= {n: again[n] for n, gain in gained.items() if gain > 0}
        return found

    def lead_deeper(self, base: Task, effects: Effects, what: str) -> Fit | None:
        """Where the base's own numbers come to in the first seconds, with one effect more or none.

        An effect more may be no more than a way out of a local minimum of the base: play has
        many, and whatever is put on top of it would seem to help.

        Args:
            base: The task of the base, with its fits.
            effects: Effects and places.
            what: For the progress.

        Returns:
            A fit of the base alone to go on from, if one lies deeper than its own. Not one that
            is hopeless beside the best look: what is missing there is an effect.
        """
        if base.first is None:
            return None
        if _error(base.first) < settings.NOISE.settled < _error(base.base):
            return base.first
        light = _light(_on_top(base, effects))
        found: list[Fit] = []
        # Many lead the same way: the first few may do.
        for tasks in (light[-settings.HALVING.first_few :], light[: -settings.HALVING.first_few]):
            screenings = self.screen(tasks, f'first look at {what}')
            limit = base.first.normalised_error / settings.SCREENING.same
            best = sorted((k for k in screenings if _known(k) < limit), key=_known)[
                : settings.SCREENING.followed
            ]
            arguments = [(base, screening.task.warm_starts[0], self.train) for screening in best]
            found += filter(None, self.carry_out(deeper, arguments, f'{what}, and without them'))
            if any(fit.normalised_error < settings.NOISE.settled for fit in found):
                break
        looks = [s for task in light if isinstance(s := self.screenings.get(_structure(task)),
                                                   Screening)]  # fmt: skip
        limit = settings.SCREENING.hopeless * _smallest(looks)
        found = [fit for fit in found if fit.normalised_error < limit]
        return min(found, key=lambda fit: fit.normalised_error, default=None)

    def forget(self, base: Task) -> None:
        """Looks at what stands on top of a base, which set out from its values."""
        self.screenings = {
            key: screening for key, screening in self.screenings.items() if key[:2] != _of(base)
        }

    def _happened(self, base: Task, what: str) -> bool:
        """Whether few pieces of the records are spoilt and all others are as they should be."""
        arguments = [(base.model, self.train, base.bounds)]
        return self.carry_out(undisturbed, arguments, f'{what}, piece by piece')[0] is not None

    def _fitted(self, tasks: Iterable[Task], what: str) -> dict[str, Outcome]:
        found, tasks = {}, _longest_first(tasks)
        for task, outcome in zip(tasks, self.fit(tasks, what), strict=True):
            if isinstance(outcome, Failure):
                log.info('%s: %s', task.effect, outcome)
            else:
                found[outcome.label] = outcome
        return found


def _structure(task: Task) -> tuple:
    """What tells first looks apart: the base, and what is tried on top of it."""
    return *_of(task), task.effect


def _of(base: Task) -> tuple:
    """What tells bases apart: their effects and small faults."""
    return frozenset(effect.label for effect in base.model.effects), frozenset(base.bounds)


def _causes(base: Task) -> frozenset[str]:
    """Labels of a base's effects, less small faults."""
    labels = frozenset(effect.label for effect in base.model.effects)
    return labels - nuisances(base.model, base.bounds)


def _on_top(base: Task, effects: Effects) -> list[Task]:
    return [
        replace(base, effect=effect, iterations=settings.HALVING.rungs[0]) for effect in effects
    ]


def _light(tasks: Iterable[Task]) -> list[Task]:
    """Those that are looked at before the heavy ones, the longest first."""
    return _longest_first(t for t in tasks if not eventful(t) and not _is_heavy(t))


def _is_heavy(task: Task) -> bool:
    """Whether it waits for the light ones: what those come to shows how far it may go."""
    return _cost_of(task) >= settings.HALVING.heavy


def _to_come_to(
    screenings: Sequence[Screening], base: Task, beaten: float, found: Mapping[str, Outcome]
) -> float:
    """chi2/N that matters to looks at heavy ones: on top of a base they have to come below it."""
    smallest = _smallest(screenings)
    return min(
        settings.HALVING.near * min(_best(found), smallest),
        settings.HALVING.as_good * beaten,
        worth_having(_clear(smallest, base.first), base.first),
    )


def _heavy(
    tasks: Sequence[Task], screenings: Sequence[Screening], base: Task, reach: float
) -> list[Task]:
    """Those that take long, with what they have to come up to: a light one that leaves little."""
    heavy = [replace(task, reach=reach) for task in tasks if _is_heavy(task)]
    ahead = min(screenings, key=_known, default=None)
    if base.rival is None and ahead and _leaves_little(ahead, base.first):
        return [replace(task, rival=rival_of(ahead)) for task in heavy]
    return heavy


def _deviance(task: Task) -> float:
    """What torques leave with the best start of an effect; infinite where they say nothing."""
    return min((said.deviance for said in task.torques), default=np.inf)


def _standing_out(found: Fit) -> str | None:
    """The joint whose motion a fit of a robot misses far more than that of any other, if any."""
    outputs = found.model.mechanism.outputs
    missed = sorted(
        ((float(error), output.removesuffix('_position'))
         for output, error in zip(outputs, per_output(found), strict=True)
         if output.endswith('_position')),
        reverse=True,
    )  # fmt: skip
    if len(missed) < 2 or missed[0][0] < settings.HALVING.stands_out * missed[1][0]:
        return None
    return missed[0][1]


def _moves_another(task: Task, joint: str) -> bool:
    """Whether what an effect moves by itself is at another joint."""
    effect = effect_of(task)
    return (
        effect is not None and along_motion.follows(effect) and effect.site not in (joint, 'all')
    )


def _longest_first(tasks: Iterable[Task]) -> list[Task]:
    """Or the last of them would be waited for."""
    return sorted(tasks, key=_cost_of, reverse=True)


def _cost_of(task: Task) -> int:
    """Candidates of higher rank take longer to fit: more starts, states, records of their own."""
    effect = effect_of(task)
    assert effect is not None
    swept = any(p.swept for p in effect.parameters)
    return 100 * eventful(task) + 10 * bool(effect.states) + 10 * swept + len(starts_of(effect))


def _known(screening: Screening) -> float:
    """Its error; infinite where the first seconds cannot tell."""
    return screening.error if np.isfinite(screening.error) else np.inf


def _error(found: Fit | None) -> float:
    return np.inf if found is None else found.normalised_error


def _smallest(screenings: Iterable[Screening]) -> float:
    return min(map(_known, screenings), default=np.inf)


def _best(found: Mapping[str, Outcome]) -> float:
    return min((o.train.normalised_error for o in found.values()), default=np.inf)


def _reach(best: float) -> float:
    """chi2/N within which a fit may still win over one that came to `best`."""
    return (
        settings.HALVING.near if best < settings.NOISE.nothing_left else settings.HALVING.in_reach
    ) * best


def _most_of(error: float) -> float:
    """chi2/N down to which most of an error is explained."""
    return max(settings.NOISE.nothing_left, error / settings.HALVING.mostly)


def _has_taken_half(o: Outcome, base: Fit | None) -> bool:
    """Whether events have taken half of the error above the noise that they have to take."""
    most = (1 + settings.SELECTION.mishap) / 2 * (_error(base) - 1)
    return o.train.normalised_error - 1 < most


def _favoured(best: float) -> float:
    """chi2/N up to which a look is as good as one that came to `best`."""
    return max(settings.SCREENING.same * best, 1 + settings.HALVING.favoured * (best - 1))


def worth_having(best: float, base: Fit | None) -> float:
    """chi2/N that a fit on top of a base has to come to, if another came to `best`.

    It has to be below the base's. What explains next to nothing of what another explains can wait
    for the next round.
    """
    error = _error(base)
    return error - settings.HALVING.idle * (error - best) if best < error < np.inf else error


def _at_stake(base: Fit | None) -> float:
    """chi2/N up to which a fit may cost more error than a base, as numbers nobody believes do.

    What beliefs can gain is no more than what they cost the base.
    """
    if base is None:
        return np.inf
    return base.normalised_error + settings.HALVING.belief * base.belief / float(base.count.sum())


def _clear(best: float, first: Fit | None) -> float:
    """The error of the best look, if that explains most of what is above the noise there.

    The first seconds of records are not all of them: what explains a little more there says
    nothing about the others.
    """
    return best if best - 1 < (_error(first) - 1) / settings.HALVING.mostly else np.inf


def _leaves_little(screening: Screening, first: Fit | None) -> bool:
    """Whether a look comes near the noise, or leaves next to nothing of what the base does."""
    of_base = 0.0 if first is None else first.normalised_error / settings.SCREENING.hopeless
    return _known(screening) < max(settings.NOISE.quick, of_base)


def _nothing_helps(base: Task, screenings: Sequence[Screening]) -> bool:
    """Whether much is wrong that nothing explains in the first seconds."""
    if (
        base.base is None
        or base.first is None
        or base.base.normalised_error < settings.NOISE.much_wrong
    ):
        return False
    return (
        base.first.normalised_error < settings.NOISE.much_wrong
        or _smallest(screenings) > settings.NOISE.much_wrong
    )


def _worth_more(
    screenings: Sequence[Screening], reach: float, first: Fit | None, fewest: int
) -> list[Screening]:
    """Looks within reach of the best, and those that cannot tell."""
    errors = sorted(filter(np.isfinite, map(_known, screenings)))
    if not errors:
        return list(screenings)
    reach = min(
        reach, settings.HALVING.in_reach * errors[0], worth_having(_clear(errors[0], first), first)
    )
    if fewest:
        at_least = errors[min(fewest, len(errors)) - 1]
        reach = max(reach, min(at_least, settings.SCREENING.hopeless * errors[0]))
    return [screening for screening in screenings if not screening.error > reach]


def _may_still_win(
    found: Mapping[str, Outcome], gained: Mapping[str, float], beaten: float, worth: float
) -> list[Outcome]:
    """Unfinished fits that are near the best, and do not come nearer too slowly."""
    best = min(map(chi2, found.values()), default=0.0)
    # What did not come below its base in eight iterations will not.
    limit = min(
        worth,
        beaten / settings.SCREENING.same if _best(found) < settings.NOISE.nothing_left else np.inf,
    )
    going = [
        o for label, o in found.items()
        if not o.train.converged
        and chi2(o) < settings.HALVING.in_reach * min(best, beaten * samples(o))
        and o.train.normalised_error < limit
        and (label not in gained or chi2(o) - best <= settings.HALVING.hope * gained[label])
    ]  # fmt: skip
    # Where nobody else is after it the best has won.
    return [] if [chi2(o) for o in going] == [best] else going
