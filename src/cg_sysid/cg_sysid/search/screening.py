"""What a first look takes of the records: first seconds of long ones, a few of many short ones.

Every candidate gets one before any is fitted to all that was recorded. Fits to a few of the
records and fits to all of them differ in what each record has of its own; here the one is turned
into a start for the other.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from cg_sysid.identification.data_set import Trial
from cg_sysid.identification.identify import Fit
from cg_sysid.identification.unknowns import unsettled_states

LENGTHS_S = (2.0, 5.0)  # of long records: the first of them in which the base fails
ENOUGH_S = 10.0  # of short records
FEWEST = 6  # of these, from each set-up


def lengths(trials: Sequence[Trial]) -> list[float]:
    """Lengths of first looks that are much shorter than the records, or take few of them, in s."""
    longest = max(trial.duration for trial in trials)
    if len(few(trials)) < len(trials):
        return [longest]
    return [length for length in LENGTHS_S if longest >= 2 * length]


def few(trials: Sequence[Trial]) -> list[int]:
    """The records that a first look takes, by their numbers: of many short ones some, else all.

    They are spread over all recordings of each set-up.
    """
    durations = [trial.duration for trial in trials]
    if max(durations) >= 2 * LENGTHS_S[0]:
        return list(range(len(trials)))
    groups: dict[str, list[int]] = {}
    for i, trial in enumerate(trials):
        groups.setdefault(repr(trial.setup), []).append(i)
    every = int(sum(durations) / ENOUGH_S)
    taken = [
        i for group in groups.values() for i in group[:: max(1, min(every, len(group) // FEWEST))]
    ]
    return sorted(taken) if 2 * len(taken) <= len(trials) else list(range(len(trials)))


def to_few(found: Fit, trials: Sequence[Trial]) -> Fit:
    """A fit to all records as a start for one to a few of them."""
    return replace(found, motions=tuple(found.motions[i] for i in few(trials)))


def to_all(found: Fit, trials: Sequence[Trial]) -> Fit:
    """A fit to a few of the records as a start for one to all of them.

    The others set out from their first guesses, and from what the few say of their recordings.
    """
    if len(found.motions) == len(trials):
        return found
    count = len(found.own)
    settled = np.zeros(len(unsettled_states(found.model)))
    priors = np.array([u.prior for u in found.own])
    common = np.array([u.each == 'recording' for u in found.own], bool)
    known = dict(zip(few(trials), found.motions, strict=True))
    of_recording = {trials[i].recording: motion[len(motion) - count :]
                    for i, motion in known.items()}  # fmt: skip
    return replace(found, motions=tuple(
        known[i] if i in known else np.array([
            *trial.motion, *settled,
            *np.where(common, of_recording.get(trial.recording, priors), priors),
        ])
        for i, trial in enumerate(trials)
    ))  # fmt: skip
