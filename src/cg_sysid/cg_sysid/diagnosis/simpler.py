"""The simpler effect that a cause has turned into, where its numbers end there.

Of a flexible drive with a share of friction on the motor's side, which ends at none, a flexible
drive is left. It has the same minimum, but its own starts need not lead there: torques or a first
look may have kept it from whole records.
"""

from dataclasses import replace

from cg_dynamics.effects import LIBRARY
from cg_dynamics.model import Model
from cg_sysid.diagnosis.workspace import Workspace
from cg_sysid.search import settings
from cg_sysid.search.outcome import Outcome, parameters_of
from cg_sysid.search.standings import title_of
from cg_sysid.search.starts import started_from
from cg_sysid.search.task import Task


def simplified(work: Workspace, o: Outcome) -> Outcome:
    """The same with simpler causes, where these do as well."""
    for label in sorted(work.added(o)):
        turned = turned_into(o, label)
        if turned is None:
            continue
        simpler, model = turned
        bounds = {n: b for n, b in o.task.bounds.items() if not n.startswith(f'{label}.')}
        start = started_from(o.train, model, bounds)
        task = Task(model, events=o.events, bounds=bounds, warm_starts=(start,))
        title = f'{title_of(work.added(o))}, with {simpler}'
        found = work.halving.fit([task], title)[0]
        if isinstance(found, Outcome):
            found = replace(found, label=simpler if o.label == label else o.label)
            gained = work.selection.compare(found, [o]).ranked[0][0].evidence
            o = found if gained < settings.SELECTION.earned else o
    return o


def turned_into(o: Outcome, label: str) -> tuple[str, Model] | None:
    """Label of the simpler effect that a cause is, as its numbers stand, and the model with it.

    None where no number of it is nothing to within its uncertainty, or no effect has just the
    others, or the model has that effect already.
    """
    effect, sure = o.model.effect(label), parameters_of(o, label)
    values = {p.name: o.train.model.values[f'{label}.{p.name}'] for p in effect.parameters}
    gone = {
        p.name for p in effect.parameters if 'lower' in p.ends and p.name in sure
        and values[p.name] - p.lower <= settings.SELECTION.too_small * sure[p.name][1]
    }  # fmt: skip
    left = {n: v for n, v in values.items() if n not in gone}
    without = o.model.without_effect(label)
    for name in effect.contains if gone else ():
        simpler = LIBRARY[name](without.mechanism, effect.at).label
        if simpler in (other.label for other in without.effects):
            continue
        if {p.name for p in LIBRARY[name].parameters} == left.keys():
            return simpler, without.with_effect(name, at=effect.at, **left)
    return None
