"""Forward selection: one effect after the other, until nothing more is earned."""

from cg_sysid.diagnosis.comparing import compare, done, refitted
from cg_sysid.diagnosis.small_faults import (
    bare,
    law_at_once,
    of_size,
    rather_one_cause,
    sound_law,
    with_small_faults,
)
from cg_sysid.diagnosis.thorough import finished
from cg_sysid.diagnosis.workspace import Workspace
from cg_sysid.search.candidates import Outcome
from cg_sysid.search.model_selection import settled


def extend(work: Workspace, o: Outcome) -> Outcome:
    """Accept one effect after the other, until nothing more is earned."""
    work.found = o
    while len(work.added(o)) < work.options.rounds and not finished(work, o):
        plain = o
        o = work.found = with_small_faults(work, plain)
        winner = None
        if not done(work, o):
            work.law = law_at_once(work, o)
            if work.law is not None:
                break
            comparison = of_size(work, compare(work, o))
            work.law = sound_law(comparison)
            o, winner = comparison.base, None if work.law else comparison.winner()
            work.note(comparison, winner[0].label if winner else '')
            if work.law is not None:
                break
        if winner is not None:
            work.found = winner[1]
            o = work.found = refitted(work, winner[1])
            continue
        if plain is o and o.task.bounds and not settled(o):
            # They came in before the causes did, and another cause could do without them.
            plain = bare(work, o) or o
        cause = rather_one_cause(work, plain, o)
        if cause is None:
            break
        o = cause
    return o
