"""Screen, fit, select: the library in competition on top of one base."""

from dataclasses import replace

import numpy as np

from cg_dynamics.effects import LIBRARY
from cg_sysid.diagnosis.free_shapes import compared_with_free_shapes
from cg_sysid.diagnosis.thorough import finished
from cg_sysid.diagnosis.workspace import Workspace
from cg_sysid.errors import Failure
from cg_sysid.identification import torque_error
from cg_sysid.search import settings
from cg_sysid.search.look import first_seconds, rival_of
from cg_sysid.search.model_selection import Comparison, settled
from cg_sysid.search.nuisance import SOUND_LAWS, nuisances
from cg_sysid.search.outcome import Outcome, chi2
from cg_sysid.search.ranking import per_output
from cg_sysid.search.standings import title_of
from cg_sysid.search.successive_halving import Effects
from cg_sysid.search.task import Task, candidates_for
from cg_sysid.search.torque_screening import KEPT, scores

FEWEST_JOINTS = 2  # from which looks at all effects at all joints take too long


def compare(
    work: Workspace, base: Outcome, beaten: Outcome | None = None, idle: Effects = ()
) -> Comparison:
    """The library, less what is idle, in competition on top of a base and with what is beaten."""
    added = work.added(base)
    key = added, bool(base.task.bounds)
    if key not in work.comparisons:
        title = f'effects on top of {title_of(added)}'
        work.under_way = base
        effects = beside_imitation(work, base, worth_a_look(work, base, idle))
        base, task = led_deeper(work, base, effects, title)
        if not added:
            work.selection.without_cause(base)
        error = np.inf
        if beaten is not None:
            error, task = beaten.train.normalised_error, replace(task, rival=rival_of(beaten))
        work.under_way = base
        outcomes, aside = in_competition(work, base, task, effects, title, error)
        comparison = less_shapes(work, work.selection.compare(base, outcomes))
        comparison = compared_with_free_shapes(work, comparison)
        work.comparisons[key] = replace(comparison, aside=tuple(aside))
    return work.comparisons[key]


def in_competition(
    work: Workspace, base: Outcome, task: Task, effects: Effects, title: str, beaten: float
) -> tuple[list[Outcome], list[str]]:
    """Fits of the effects to whole records, and labels of those that were not worth one."""
    if done(work, base):
        return [], []
    if work.selection.only_beliefs(base):
        return work.halving.run_by_belief(task, effects, title, beaten)
    earned = work.selection.to_be_earned(base)
    judged = base.held.normalised_error
    return work.halving.run(task, effects, title, beaten, earned, judged)


def less_shapes(work: Workspace, comparison: Comparison) -> Comparison:
    """Without those candidates that only give the law of a cause another shape.

    Friction that turns otherwise than its law says leaves something that a second law of friction
    there can take, with numbers that no record determines. It is not a second cause.
    """
    base = comparison.base
    laws = {
        (effect.family, effect.at): label
        for label in sorted(work.added(base))
        if (effect := base.model.effect(label)).family
    }
    for candidate, o in comparison.ranked:
        tried = next((e for e in o.model.effects if e.label == candidate.label), None)
        cause = laws.get((tried.family, tried.at)) if tried else None
        loose = [n for n in o.train.undetermined if n.startswith(f'{candidate.label}.')]
        if cause and cause != candidate.label and loose and not candidate.reason:
            comparison = comparison.less(
                candidate.label, f'{loose[0]} is not determined: it gives the law of {cause} '
                'another shape'
            )  # fmt: skip
    return comparison


def worth_a_look(work: Workspace, base: Outcome, idle: Effects = ()) -> Effects:
    """What can be tried on top of a base less what is idle, and what torques rule out."""
    effects = [effect for effect in effects_on(work, base) if effect not in idle]
    if len(base.model.mechanism.coordinates) < FEWEST_JOINTS:
        return effects
    key = work.added(base), bool(base.task.bounds)
    if idle and key not in work.torques and len(effects) <= KEPT:
        return effects
    said = work.torques.get(key)
    if key not in work.torques:
        missed = dict(zip(base.model.mechanism.outputs, per_output(base.train), strict=True))
        said = scores(
            base.model, work.train, effects, base.task.bounds, work.carry_out, work.held, missed
        )
        if not idle:
            work.torques[key] = said
    return effects if said is None else said.worth(effects)


def beside_imitation(work: Workspace, base: Outcome, effects: Effects) -> Effects:
    """Less what moves by itself, where small faults come to the noise and leave half of it white.

    Not even what of it they cannot imitate is there, and its fits take most of the time.
    That a small cause may hide behind them is told.
    """
    white = work.selection.whiteness(base) > settings.NOISE.half_white
    if not (work.selection.imitated(base) and white):
        return effects
    return [
        (name, at) for name, at in effects
        if name in SOUND_LAWS or not LIBRARY[name](base.model.mechanism, at).states
    ]  # fmt: skip


def effects_on(work: Workspace, base: Outcome) -> Effects:
    """All that can be tried on top of a base."""
    recorded = {name for data_set in work.train for name in data_set.input_names}
    small = nuisances(base.model, base.task.bounds)
    return candidates_for(base.model, work.setups(), work.options.effects, recorded, small)


def led_deeper(
    work: Workspace, base: Outcome, effects: Effects, title: str
) -> tuple[Outcome, Task]:
    """A base, or the deeper minimum of it that effects on top of it showed; and its task."""
    task_alone = alone(work, base)
    for _ in range(settings.DOUBT.deeper):
        warm_start = (
            None if done(work, base) else work.halving.lead_deeper(task_alone, effects, title)
        )
        if warm_start is None:
            break
        reach = base.train.normalised_error
        task = replace(task_alone, warm_starts=(warm_start,), base=None, reach=reach)
        deeper = work.halving.fit([task], f'{title_of(work.added(base))}, deeper')[0]
        if isinstance(deeper, Failure) or settings.SCREENING.same * chi2(deeper) > chi2(base):
            break
        work.halving.forget(task_alone)
        base = replace(deeper, label=base.label)
        task_alone = alone(work, base)
    return base, task_alone


def done(work: Workspace, o: Outcome) -> bool:
    """Whether there is nothing to look for on top of this.

    The law of a cause, too, is drawn roughly: where it is there, what comes to the noise with
    small faults need not be as white as where there is none.
    """
    if work.selection.nothing_material(o):
        return True
    rough = bool(work.added(o)) and work.selection.whiteness(o) > settings.NOISE.half_white
    return settled(o) and (rough or not work.selection.imitated(o))


def alone(work: Workspace, base: Outcome) -> Task:
    """The task of a base by itself, with its fits."""
    task = Task(base.model, None, base.events, base.task.bounds, base=base.train)
    return replace(task, first=first_seconds(task, work.train))


def refitted(work: Workspace, o: Outcome) -> Outcome:
    """The same structure from the file's numbers again, if that comes out better.

    What stands as the base of a round has to be as good as it can be, or the next effect is
    accepted for a better fit of this one. At the noise there is no next round. On a robot each
    candidate has set out from the file's numbers, as torques lead from there.
    """
    if settled(o) or torque_error.can(o.model) or finished(work, o):
        return o
    reach = settings.HALVING.as_good * o.train.normalised_error
    task = Task(o.model, events=o.events, bounds=o.task.bounds, reach=reach)
    again = work.halving.fit([task], f'{o.label} again')
    better = [a for a in again if isinstance(a, Outcome) and chi2(a) < chi2(o)]
    return replace(better[0], label=o.label) if better else o
