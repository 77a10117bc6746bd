"""The simpler effect that a winner has turned into, where its numbers end there.

Of a flexible drive with a share of friction on the motor's side, which ends at none, a flexible
drive is left. Torques or a first look may have kept that from whole records: it has the same
minimum, but its own starts need not lead there.
"""

from dataclasses import replace

from cg_dynamics.effects import LIBRARY
from cg_dynamics.model import Model
from cg_sysid.diagnosis.free_shapes import PURE
from cg_sysid.diagnosis.workspace import Workspace
from cg_sysid.search.candidates import Outcome, started_from
from cg_sysid.search.model_selection import Comparison
from cg_sysid.search.standings import title_of


def with_simpler_one(work: Workspace, comparison: Comparison) -> Comparison:
    """The comparison with what its winner has turned into, if that was not fitted to it."""
    winner = comparison.winner()
    turned = winner and turned_into(winner[1])
    if not turned or comparison.of(turned[0]):
        return comparison
    (label, model), won, base = turned, winner[1], comparison.base
    bounds = {n: b for n, b in won.task.bounds.items() if not n.startswith(f'{won.label}.')}
    effect, start = model.effect(label), started_from(won.train, model, bounds)
    task = replace(won.task, effect=(effect.name, effect.at), bounds=bounds, warm_starts=(start,))
    title = f'{label} on top of {title_of(work.added(base))}'
    found = [o for o in work.halving.fit([task], title) if isinstance(o, Outcome)]
    return work.selection.compare(base, [*(o for _, o in comparison.ranked), *found])


def turned_into(o: Outcome) -> tuple[str, Model] | None:
    """Label and model of the simpler effect that the tried one is, as its numbers stand.

    None where no number of it ends its range at nothing, or no effect has just the others.
    """
    effect = o.model.effect(o.label)
    values = {p.name: o.train.model.values[f'{o.label}.{p.name}'] for p in effect.parameters}
    gone = {
        p.name for p in effect.parameters
        if 'lower' in p.ends and p.free
        and values[p.name] - p.lower < PURE * (p.upper - p.lower)
    }  # fmt: skip
    for name in effect.contains if gone else ():
        if {p.name for p in LIBRARY[name].parameters} == values.keys() - gone:
            left = {n: v for n, v in values.items() if n not in gone}
            model = o.train.model.without_effect(o.label).with_effect(name, at=effect.at, **left)
            return model.effects[-1].label, model
    return None
