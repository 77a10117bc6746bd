"""Does a cause help where each record starts at the angles that were measured?

A diagnosis fits the initial motion of held-out records, as no recording states it exactly. Others
(the walking compass gait of Sydney, docs/data.md) start from the measured angles and fit the rates
alone. A cause worth its name gains under both. Measured is what a curve through the first samples
of each channel says (trial.measured_motion), and each model starts where its sensors read that.

Measured angles are uncertain, and on a robot that falls that alone becomes an error of any size.
So a record is judged for as long as the noise of its start makes less than half of the error of
the nominal model: this is the whole record where the motion is stable.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from cg_dynamics.mechanisms.mechanism import Mechanism
from cg_sysid.identification.data_set import Trial, sensor_matrix
from cg_sysid.identification.gain import NO_GAIN, Gain
from cg_sysid.identification.identify import Fit, predict, score
from cg_sysid.text import listed

OWN_PART = 0.5  # of the nominal model's error, that the noise of the start may make
SHORTEST = 0.05  # of a record; if the start carries no further, it judges nothing
SHORTER = 0.8  # times as long is tried next
HELD = 1e-9  # rad (m where a joint slides), by which a start that is held may move


@dataclass(frozen=True)
class MeasuredStart:
    """The gain on held-out records that start at the measured angles, their rates fitted.

    Attributes:
        gains: Error of each output, over all records as far as their starts carry.
        carried: Record -> s for which its start carries, of those that it carries at all.
        whole: Whether it carries to the end of every held-out record.
    """

    gains: tuple[Gain, ...]
    carried: dict[str, float]
    whole: bool

    @property
    def helps(self) -> bool:
        """Whether the error falls, all outputs together in standard deviations of their noise."""
        before, after = (
            sum((getattr(g, when) / g.noise) ** 2 for g in self.gains)
            for when in ('before', 'after')
        )
        return before > NO_GAIN**2 * after

    @property
    def text(self) -> str:
        """One sentence for people."""
        far = 'to their ends'
        if not self.whole:
            far = f'for {min(self.carried.values()):.2g} to {max(self.carried.values()):.2g} s'
        told = listed([
            f'{g.channel} from {g.before:.3g} to {g.after:.3g} {g.unit}' for g in self.gains
        ])
        head = f'from the measured angles, which carry the held-out records {far}, the error goes'
        if self.helps:
            return f'{head}: {told}'
        return (
            f'{head}: {told}. That is no gain, where fitted starts show one: what is named may '
            'stand in for something that the starts take up'
        )


def judged(
    body: Mechanism, trials: Sequence[Trial], before: Fit, after: Fit
) -> MeasuredStart | None:
    """Two models from measured angles; None where these carry nowhere.

    Args:
        body: The mechanism.
        trials: Records held out.
        before: Score of the nominal model on them, identified anew.
        after: Score of the extended one.

    Raises:
        IdentificationError: if a model cannot be simulated from there.
    """
    rows = carried(trials, before)
    if not rows:
        return None
    scores = [
        score(
            fit.model, from_measured_angles(body, trials, fit, rows), own=fit.own_by_name(trials)
        )
        for fit in (before, after)
    ]
    count = scores[0].count.sum(axis=0)
    rms = [
        np.sqrt(np.nansum(found.mse * found.count, axis=0) / np.maximum(count, 1))
        * trials[0].sigma for found in scores
    ]  # fmt: skip
    gains = (
        Gain(channel, unit, float(b), float(a), float(s))
        for channel, unit, b, a, s, n in zip(
            body.outputs, body.output_units, *rms, trials[0].sigma, count, strict=True
        )
        if n
    )
    whole = all(rows.get(trial.name) == len(trial.time) for trial in trials)
    seconds = {t.name: float(t.time[rows[t.name] - 1]) for t in trials if t.name in rows}
    return MeasuredStart(tuple(gains), seconds, whole)


def carried(trials: Sequence[Trial], before: Fit) -> dict[str, int]:
    """Rows for which measured angles carry each trial; those that they carry nowhere are left out.

    Args:
        trials: Records.
        before: Score on them of the model whose error says how far.
    """
    rows = {trial.name: _carries(before, i, trial) for i, trial in enumerate(trials)}
    return {t.name: rows[t.name] for t in trials if rows[t.name] >= SHORTEST * len(t.time)}


def from_measured_angles(
    body: Mechanism, trials: Sequence[Trial], fit: Fit, rows: Mapping[str, int]
) -> list[Trial]:
    """The first rows of trials, starting where the sensors of a model read what was measured.

    A model whose encoder is off, or reads late, starts beside the reading by as much.

    Args:
        body: The mechanism.
        trials: Records.
        fit: Score of the model on them.
        rows: Of each, how many (`carried`).
    """
    return [
        _held(trial, rows[trial.name], _misread(body, fit, i, trial))
        for i, trial in enumerate(trials) if trial.name in rows
    ]  # fmt: skip


def _misread(body: Mechanism, fit: Fit, i: int, trial: Trial) -> np.ndarray:
    """By how much a model's sensors make the free coordinates of a start appear larger, (m,)."""
    free = len(trial.motion) // 2
    matrix = sensor_matrix(body, trial.setup)
    first = predict(fit.model, trial, fit.motions[i], fit.refinement)[0]
    error = first - matrix @ fit.motions[i][: 2 * free]
    angles = np.array([not unit.endswith('/s') for unit in body.output_units])
    # Channels without samples say nothing of where it was.
    angles &= np.isfinite(trial.outputs).any(axis=0)
    weight = 1 / trial.sigma[angles]
    shift, *_ = np.linalg.lstsq(
        matrix[angles, :free] * weight[:, None], error[angles] * weight, rcond=None
    )
    return shift


def _held(trial: Trial, rows: int, misread: np.ndarray) -> Trial:
    """The first rows of a trial, with its angles at the start as measured."""
    free = len(misread)
    motion = np.concatenate([trial.motion[:free] - misread, trial.motion[free:]])
    sigma = np.concatenate([np.full(free, HELD), trial.motion_sigma[free:]])
    return replace(
        trial, time=trial.time[:rows], inputs=trial.inputs[:rows], outputs=trial.outputs[:rows],
        motion=motion, motion_sigma=sigma,
    )  # fmt: skip


def _carries(fit: Fit, i: int, trial: Trial) -> int:
    """Rows for which the noise of the measured angles makes less than its part of the error."""
    start = fit.motions[i]
    there = predict(fit.model, trial, start, fit.refinement)
    error = (there - trial.outputs) / trial.sigma
    spread = np.zeros_like(there)
    free = len(trial.motion) // 2
    # An encoder knows the difference of two angles far better than each of them.
    size, direction = np.linalg.eigh(trial.motion_noise[:free, :free])
    for k in range(free):
        moved = start.copy()
        moved[:free] += np.sqrt(max(size[k], 0.0)) * direction[:, k]
        spread += ((predict(fit.model, trial, moved, fit.refinement) - there) / trial.sigma) ** 2
    rows = len(trial.time)
    while rows > 1:
        seen = np.isfinite(error[:rows])
        if spread[:rows][seen].sum() < OWN_PART**2 * (error[:rows][seen] ** 2).sum():
            return rows
        rows = int(SHORTER * rows)
    return 0
