"""What a first look takes of the records: first seconds of long ones, a few of many short ones.

Every candidate gets one before any is fitted to all that was recorded. Fits to a few of the
records and fits to all of them differ in what each record has of its own; here the one is turned
into a start for the other.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from cg_sysid.identification.data_set import DataSet
from cg_sysid.identification.fit_result import Fit
from cg_sysid.identification.unknowns import unsettled_states
from cg_sysid.search import settings


def lengths(data_sets: Sequence[DataSet]) -> list[float]:
    """Lengths of first looks that are much shorter than the records, or take few of them, in s."""
    longest = max(data_set.duration for data_set in data_sets)
    if len(few(data_sets)) < len(data_sets):
        return [longest]
    return [length for length in settings.SCREENING.lengths_s if longest >= 2 * length]


def few(data_sets: Sequence[DataSet]) -> list[int]:
    """The records that a first look takes, by their numbers: of many short ones some, else all.

    They are spread over all recordings of each set-up.
    """
    durations = [data_set.duration for data_set in data_sets]
    if max(durations) >= 2 * settings.SCREENING.lengths_s[0]:
        return list(range(len(data_sets)))
    groups: dict[str, list[int]] = {}
    for i, data_set in enumerate(data_sets):
        groups.setdefault(repr(data_set.setup), []).append(i)
    every = int(sum(durations) / settings.SCREENING.enough_s)
    taken = [
        i
        for group in groups.values()
        for i in group[:: max(1, min(every, len(group) // settings.SCREENING.fewest_records))]
    ]
    return sorted(taken) if 2 * len(taken) <= len(data_sets) else list(range(len(data_sets)))


def to_few(found: Fit, data_sets: Sequence[DataSet]) -> Fit:
    """A fit to all records as a start for one to a few of them."""
    return replace(found, motions=tuple(found.motions[i] for i in few(data_sets)))


def to_all(found: Fit, data_sets: Sequence[DataSet]) -> Fit:
    """A fit to a few of the records as a start for one to all of them.

    The others set out from their first guesses, and from what the few say of their recordings.
    """
    if len(found.motions) == len(data_sets):
        return found
    count = len(found.own)
    settled = np.zeros(len(unsettled_states(found.model)))
    priors = np.array([u.prior for u in found.own])
    common = np.array([u.each == 'recording' for u in found.own], bool)
    known = dict(zip(few(data_sets), found.motions, strict=True))
    of_recording = {data_sets[i].recording: motion[len(motion) - count :]
                    for i, motion in known.items()}  # fmt: skip
    return replace(found, motions=tuple(
        known[i] if i in known else np.array([
            *data_set.motion, *settled,
            *np.where(common, of_recording.get(data_set.recording, priors), priors),
        ])
        for i, data_set in enumerate(data_sets)
    ))  # fmt: skip
