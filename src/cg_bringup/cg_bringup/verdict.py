"""Whether a run worked, in one line: what `balance` and its kin end with."""

from collections.abc import Sequence
from dataclasses import dataclass

from cg_hardware.standing import Outcome

UPRIGHT = 0.2  # rad; a stance leg that leans further at the end is about to fall


@dataclass(frozen=True)
class Verdict:
    """What is said of a run.

    Attributes:
        worked: Whether the robot did what was asked.
        line: One sentence for people.
    """

    worked: bool
    line: str


def balance_verdict(outcome: Outcome, pushes: Sequence[float] = ()) -> Verdict:
    """Of a robot that was to stand.

    Args:
        outcome: How it fared.
        pushes: Instants in s and impulses in N s, in turn.
    """
    instants, impulses = pushes[::2], pushes[1::2]
    asked = sorted(t for t, impulse in zip(instants, impulses, strict=True) if impulse)
    came = [t for t in asked if t < (outcome.fell_at or outcome.duration)]
    if _stands(outcome):
        ending = f', {len(came)} of {len(asked)} pushes survived' if asked else ''
        return Verdict(True, f'upright throughout: {_length(outcome)}{ending}')
    ending = ''
    if came:
        after = (outcome.fell_at or outcome.duration) - came[-1]
        ending = f', {after:.2f} s after push {len(came)} of {len(asked)}'
    return Verdict(False, f'{_lost(outcome)}{ending}')


def rebalance_verdict(outcome: Outcome, first: str, asked: bool = True) -> Verdict:
    """Of a robot that was to step from one leg to the other and stand there.

    Args:
        outcome: How it fared.
        first: The leg that stood at the start.
        asked: Whether a step was ordered; otherwise it may stand where it stood.
    """
    steps = ''.join(f', step at {t:.2f} s' for t in outcome.stepped_at)
    if not _stands(outcome):
        return Verdict(False, f'{_lost(outcome)}{steps}')
    if len(outcome.stepped_at) == 1:
        line = f'stepped off the {first} leg at {outcome.stepped_at[0]:.2f} s, '
        return Verdict(True, f'{line}upright throughout: {_length(outcome)}')
    if not outcome.stepped_at:
        return Verdict(not asked, f'no step, upright throughout: {_length(outcome)}')
    return Verdict(False, f'{len(outcome.stepped_at)} steps instead of one{steps}')


def recovery_verdict(outcome: Outcome, pushes: Sequence[float] = ()) -> Verdict:
    """Of a robot that was to come home, by as many steps as it takes.

    Args:
        outcome: How it fared.
        pushes: Instants in s and impulses in N s, in turn.
    """
    found = balance_verdict(outcome, pushes)
    steps = ''.join(f', step at {t:.2f} s' for t in outcome.stepped_at)
    line = found.line.replace('upright throughout', 'upright at the end', 1)
    return Verdict(found.worked, f'{line}{steps}')


def walk_verdict(outcome: Outcome, steps: int) -> Verdict:
    """Of a robot that was to walk.

    Args:
        outcome: How it fared.
        steps: Asked for, after which it was to stand; 0: it was to walk on.
    """
    made, walked = outcome.stepped_at, ''
    if len(made) > 1:
        walked = f' from {made[0]:.2f} to {made[-1]:.2f} s'
    line = f'{len(made)} steps{walked}'
    if outcome.fell_at is not None or outcome.duration == 0.0:
        return Verdict(False, f'{_lost(outcome)}, after {line}')
    if not steps:
        return Verdict(bool(made), f'walking to the end: {line}')
    if not _stands(outcome):
        return Verdict(False, f'{_lost(outcome)}, after {line}')
    if len(made) < steps:
        return Verdict(False, f'{line} of {steps} asked for, upright: {_length(outcome)}')
    return Verdict(True, f'{line}, upright at the end: {_length(outcome)}')


def _stands(outcome: Outcome) -> bool:
    return outcome.fell_at is None and outcome.last_lean < UPRIGHT and outcome.duration > 0.0


def _length(outcome: Outcome) -> str:
    return (
        f'{outcome.duration:.2f} s on the {outcome.stance} leg, '
        f'largest lean {outcome.largest_lean:.3f} rad'
    )


def _lost(outcome: Outcome) -> str:
    if outcome.duration == 0.0:
        return 'the machine waited for its controller'
    if outcome.fell_at is None:
        return (
            f'falling at the end: lean {outcome.last_lean:.3f} rad on the {outcome.stance} leg '
            f'after {outcome.duration:.2f} s'
        )
    return f'fell at {outcome.fell_at:.2f} s on the {outcome.stance} leg'
