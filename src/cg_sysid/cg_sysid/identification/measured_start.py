"""Does a cause help where each record starts at the angles that were measured?

A diagnosis fits the initial motion of held-out records, as no recording states it exactly. Others
(the walking compass gait of Sydney, data.md) start from the measured angles and fit the rates
alone. A cause worth its name gains under both. Measured is what a curve through the first samples
of each channel says (data set.measured_motion), and each model starts where its sensors read that.

Measured angles are uncertain, and on a robot that falls that alone becomes an error of any size.
So a record is judged for as long as the noise of its start makes less than half of the error of
the nominal model: this is the whole record where the motion is stable.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from cg_dynamics.mechanisms.mechanism import Mechanism
from cg_sysid.identification.data_set import DataSet, sensor_matrix
from cg_sysid.identification.fit_result import Fit
from cg_sysid.identification.gain import NO_GAIN, Gain
from cg_sysid.identification.identify import predict, score
from cg_sysid.text import listed, number, scaled

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
        far = 'all of the held-out records'
        if not self.whole:
            least, most = min(self.carried.values()), max(self.carried.values())
            far = f'the first {least:.2g} to {most:.2g} s of held-out records'
        moved = [g for g in self.gains if not 1 / NO_GAIN < g.before / g.after < NO_GAIN]
        told = 'no error changes'
        if moved:
            told = f'the error of {listed([_change(g) for g in moved])}'
            if len(moved) < len(self.gains):
                told += '; other outputs stay as they are'
        text = f'over {far}, started from the measured angles, {told}'
        if self.helps:
            return text
        return (
            f'{text}. That is no gain, where fitted starts show one: what is named may '
            'stand in for something that the starts take up'
        )


def _change(gain: Gain) -> str:
    factor, unit = scaled(max(gain.before, gain.after), gain.unit)
    before, after = (number(factor * error) for error in (gain.before, gain.after))
    verb = 'falls' if gain.after < gain.before else 'grows'
    return f'{gain.channel} {verb} from {before} to {after} {unit}'


def judged(
    body: Mechanism, data_sets: Sequence[DataSet], before: Fit, after: Fit
) -> MeasuredStart | None:
    """Two models from measured angles; None where these carry nowhere.

    Args:
        body: The mechanism.
        data_sets: Records held out.
        before: Score of the nominal model on them, identified anew.
        after: Score of the extended one.

    Raises:
        IdentificationError: if a model cannot be simulated from there.
    """
    rows = carried(data_sets, before)
    if not rows:
        return None
    scores = [
        score(
            fit.model,
            from_measured_angles(body, data_sets, fit, rows),
            own=fit.own_by_name(data_sets),
        )
        for fit in (before, after)
    ]
    count = scores[0].count.sum(axis=0)
    rms = [
        np.sqrt(np.nansum(found.mse * found.count, axis=0) / np.maximum(count, 1))
        * data_sets[0].sigma for found in scores
    ]  # fmt: skip
    gains = (
        Gain(channel, unit, float(b), float(a), float(s))
        for channel, unit, b, a, s, n in zip(
            body.outputs, body.output_units, *rms, data_sets[0].sigma, count, strict=True
        )
        if n
    )
    whole = all(rows.get(data_set.name) == len(data_set.time) for data_set in data_sets)
    seconds = {t.name: float(t.time[rows[t.name] - 1]) for t in data_sets if t.name in rows}
    return MeasuredStart(tuple(gains), seconds, whole)


def carried(data_sets: Sequence[DataSet], before: Fit) -> dict[str, int]:
    """Rows for which measured angles carry each data set; without those that they carry nowhere.

    Args:
        data_sets: Records.
        before: Score on them of the model whose error says how far.
    """
    rows = {data_set.name: _carries(before, i, data_set) for i, data_set in enumerate(data_sets)}
    return {t.name: rows[t.name] for t in data_sets if rows[t.name] >= SHORTEST * len(t.time)}


def from_measured_angles(
    body: Mechanism, data_sets: Sequence[DataSet], fit: Fit, rows: Mapping[str, int]
) -> list[DataSet]:
    """The first rows of data sets, starting where the sensors of a model read what was measured.

    A model whose encoder is off, or reads late, starts beside the reading by as much.

    Args:
        body: The mechanism.
        data_sets: Records.
        fit: Score of the model on them.
        rows: Of each, how many (`carried`).
    """
    return [
        _held(data_set, rows[data_set.name], _misread(body, fit, i, data_set))
        for i, data_set in enumerate(data_sets) if data_set.name in rows
    ]  # fmt: skip


def _misread(body: Mechanism, fit: Fit, i: int, data_set: DataSet) -> np.ndarray:
    """By how much a model's sensors make the free coordinates of a start appear larger, (m,)."""
    free = len(data_set.motion) // 2
    matrix = sensor_matrix(body, data_set.setup)
    first = predict(fit.model, data_set, fit.motions[i], fit.refinement)[0]
    error = first - matrix @ fit.motions[i][: 2 * free]
    angles = np.array([not unit.endswith('/s') for unit in body.output_units])
    # Channels without samples say nothing of where it was.
    angles &= np.isfinite(data_set.outputs).any(axis=0)
    weight = 1 / data_set.sigma[angles]
    shift, *_ = np.linalg.lstsq(
        matrix[angles, :free] * weight[:, None], error[angles] * weight, rcond=None
    )
    return shift


def _held(data_set: DataSet, rows: int, misread: np.ndarray) -> DataSet:
    """The first rows of a data set, with its angles at the start as measured."""
    free = len(misread)
    motion = np.concatenate([data_set.motion[:free] - misread, data_set.motion[free:]])
    sigma = np.concatenate([np.full(free, HELD), data_set.motion_sigma[free:]])
    return replace(
        data_set,
        time=data_set.time[:rows],
        inputs=data_set.inputs[:rows],
        outputs=data_set.outputs[:rows],
        motion=motion,
        motion_sigma=sigma,
    )


def _carries(fit: Fit, i: int, data_set: DataSet) -> int:
    """Rows for which the noise of the measured angles makes less than its part of the error."""
    start = fit.motions[i]
    there = predict(fit.model, data_set, start, fit.refinement)
    error = (there - data_set.outputs) / data_set.sigma
    spread = np.zeros_like(there)
    free = len(data_set.motion) // 2
    # An encoder knows the difference of two angles far better than each of them.
    size, direction = np.linalg.eigh(data_set.motion_noise[:free, :free])
    for k in range(free):
        moved = start.copy()
        moved[:free] += np.sqrt(max(size[k], 0.0)) * direction[:, k]
        spread += (
            (predict(fit.model, data_set, moved, fit.refinement) - there) / data_set.sigma
        ) ** 2
    rows = len(data_set.time)
    while rows > 1:
        seen = np.isfinite(error[:rows])
        if spread[:rows][seen].sum() < OWN_PART**2 * (error[:rows][seen] ** 2).sum():
            return rows
        rows = int(SHORTER * rows)
    return 0
