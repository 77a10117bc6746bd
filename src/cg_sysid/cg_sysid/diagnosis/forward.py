"""Forward selection: one effect after the other, until nothing more is earned."""

from cg_sysid.diagnosis.comparing import compare, done, refitted
from cg_sysid.diagnosis.simpler import simplified
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
from cg_sysid.search import settings
from cg_sysid.search.model_selection import above_noise, settled
from cg_sysid.search.outcome import Outcome


def extend(work: Workspace, o: Outcome) -> Outcome:
    """Accept one effect after the other, until nothing more is earned; the simplest that do."""
    work.found = o
    while len(work.added(o)) < work.options.rounds and not finished(work, o):
        plain = o
        o, winner = raced(work, with_small_faults(work, plain))
        waiting = work.faulty.get(work.added(plain))
        if winner is None and waiting is not None and no_help(o, waiting):
            # They were to wait for a cause, and none was found without them.
            faulty, winner = raced(work, waiting)
            if work.law is not None:
                o = faulty
        work.found = winner or o
        if work.law is not None:
            break
        if winner is not None:
            o = work.found = refitted(work, winner)
            continue
        if plain is o and o.task.bounds and not settled(o):
            # They came in before the causes did, and another cause could do without them.
            plain = bare(work, o) or o
        cause = rather_one_cause(work, plain, o)
        if cause is None:
            break
        o = cause
    work.found = simplified(work, o) if work.law is None else o
    return work.found


def raced(work: Workspace, base: Outcome) -> tuple[Outcome, Outcome | None]:
    """The library in competition on top of a base: that base, maybe deeper, and who won.

    Nobody where nothing is left to explain, or where a law that sound machines follow takes what
    is left (Workspace.law).
    """
    work.found = base
    if done(work, base):
        return base, None
    work.law = law_at_once(work, base)
    if work.law is not None:
        return base, None
    comparison = of_size(work, compare(work, base))
    work.law = sound_law(comparison)
    winner = None if work.law else comparison.winner()
    work.note(comparison, winner[0].label if winner else '')
    return comparison.base, winner[1] if winner else None


def no_help(o: Outcome, waiting: Outcome) -> bool:
    """Whether a base goes without small faults that would take a part of what is left."""
    least = settings.DOUBT.nearly_all * above_noise(o)
    return not o.task.bounds and not settled(o) and above_noise(waiting) < least
