"""A data set: one record made ready for simulation beside it.

Arrays in the order of the model's channels, standard deviations that say how well each channel
can be matched at all, and a first guess of the motion at the first row.
"""

import functools
import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import casadi as ca
import numpy as np

from cg_dynamics.effects.effect import SESSION_TIME, TIME
from cg_dynamics.effects.position_control import PositionControl
from cg_dynamics.mechanisms import Mechanism
from cg_dynamics.model import Model
from cg_dynamics.rig import Setup
from cg_interfaces import channels
from cg_interfaces.stamps import NS_PER_S
from cg_sysid.records.noise import measure_noise
from cg_sysid.records.record import Record

LEAD_IN_S = 0.1  # of each record, not judged
LEAD_IN_SHARE = 0.05  # of a short record
LATEST = 0.02  # s by which sensors may report late
FASTEST = 50.0  # rad/s^2 or m/s^2, acceleration of a lively start
START_WINDOW = 0.03  # s of data behind the first guess of the initial motion
# A floor below the noise that is stated or measured would let rounding decide.
SMALLEST_SIGMA = {'rad': 1e-6, 'rad/s': 1e-5, 'm': 1e-6, 'm/s': 1e-5}


@dataclass(frozen=True)
class DataSet:
    """A record as arrays.

    Attributes:
        name: Name of the record.
        recording: What the record was cut from; its own name if from nothing.
        time: Stamps of the rows in s from the first, shape (n,).
        since: Time in s from the start of the recording to the first row.
        session: Time in s from the start of the session to that of the recording.
        inputs: Held inputs, shape (n, nu), in the order of `input_names`.
        input_names: Input channels.
        outputs: Measured outputs, NaN where there is no sample, shape (n, ny).
        sigma: Noise floor of each output (white noise and rounding), shape (ny,).
        setup: The set-up.
        motion: First guess of the free coordinates and rates at the first row, shape (2m,).
        motion_sigma: How far the guess may be off, one standard deviation, shape (2m,).
        motion_noise: Covariance that the noise of its samples gives the guess, shape (2m, 2m).
    """

    name: str
    recording: str
    time: np.ndarray
    inputs: np.ndarray
    input_names: tuple[str, ...]
    outputs: np.ndarray
    sigma: np.ndarray
    setup: Setup
    motion: np.ndarray
    motion_sigma: np.ndarray
    since: float = 0.0
    session: float = 0.0
    motion_noise: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))

    def inputs_for(self, names: Sequence[str]) -> np.ndarray:
        """Inputs in the order that a model wants, shape (n, len(names)).

        `time` is the time of the recording, as warming and drift go on through all pieces of one,
        and `session_time` that of the session. Both are held from row to row like any input: at
        the middle of that interval, or what happens at an instant would come half a sample late.
        A switch that was not recorded (`drive_enabled`)
        counts as on.
        """
        if tuple(names) == self.input_names:
            return self.inputs
        recorded = dict(zip(self.input_names, self.inputs.T, strict=True))
        held = np.diff(self.time)
        time = self.since + self.time + np.append(held, held[-1]) / 2
        known = {TIME: time, SESSION_TIME: self.session + time, **recorded}
        ones = np.ones(len(self.time))
        return np.column_stack([known.get(name, ones) for name in names])

    @property
    def duration(self) -> float:
        """Length in s."""
        return float(self.time[-1])


def prepare(model: Model, records: Sequence[Record]) -> list[DataSet]:
    """Data sets of records that belong to one model's machine.

    The noise of a channel is what the model file states or what the records show, whichever is
    larger, one value for all records: a sensor does not change from one record to the next.
    Their recordings are one session.

    Raises:
        ValueError: if a record is of another robot.
    """
    require_same_robot(model, records)
    sigma = noise_floor(model, records)
    starts = session_starts(records)
    return [
        replace(as_data_set(model.mechanism, record, sigma), session=starts[recording_of(record)])
        for record in records
    ]


def require_same_robot(model: Model, records: Sequence[Record]) -> None:
    """Let records pass that are of the robot of a model.

    Raises:
        ValueError: One is of another robot.
    """
    for record in records:
        reason = other_robot(record.mechanism, model) or _other_drives(record, model)
        if reason:
            raise ValueError(f'{recording_of(record)}: {reason}')


def other_robot(recorded: channels.Mechanism, model: Model) -> str:
    """Why a recording is not of the robot of a model; empty if it is.

    Robots in the table of channels.py go by their names; others must have the same channels too.
    """
    body = model.mechanism
    if recorded.name != body.name:
        return f'recorded on a {recorded.name}, but the model {model.name!r} is of a {body.name}'
    theirs, ours = (
        {channel for topic in each.topics.values() for channel in topic.channels}
        for each in (recorded, channels.interface(body))
    )
    if theirs == ours:
        return ''
    apart = ', '.join(sorted(f'{c.name} ({c.place}, {c.unit})' for c in theirs ^ ours))
    return f'its channels and those of the model {model.name!r} differ: only one has {apart}'


def _other_drives(record: Record, model: Model) -> str:
    """Why what drives were told does not fit those of a model; empty if it does."""
    joints = [e.site for e in model.effects if isinstance(e, PositionControl)]
    if not joints and not set(record.inputs) & set(record.mechanism.told_names):
        return ''
    if not set(record.inputs) & set(record.mechanism.told_names):
        return (
            f'the model {model.name!r} has position_control at {", ".join(joints)}, but no '
            'commanded positions were read: `position_control` in the note names their topic'
        )
    if missing := [joint for joint in model.mechanism.joints if joint not in joints]:
        return (
            f'its drives were told positions, but the model {model.name!r} has no '
            f'position_control at {", ".join(missing)}'
        )
    return ''


def recording_of(record: Record) -> str:
    """What a record was cut from; its own name if from nothing."""
    return record.source or record.name


def session_starts(records: Sequence[Record]) -> dict[str, float]:
    """Time in s from the start of the first recording to that of each.

    Recordings that overlap, as simulated ones do whose clocks all begin at nought, are of no one
    session: each begins its own.
    """
    spans: dict[str, tuple[int, int]] = {}
    for record in records:
        first = int(record.stamp_ns[0]) - round(record.since * NS_PER_S)
        begin, end = spans.get(recording_of(record), (first, first))
        spans[recording_of(record)] = min(begin, first), max(end, int(record.stamp_ns[-1]))
    ordered = sorted(spans.values())
    if any(after < end for (_, end), (after, _) in itertools.pairwise(ordered)):
        return dict.fromkeys(spans, 0.0)
    return {name: (begin - ordered[0][0]) / NS_PER_S for name, (begin, _) in spans.items()}


def noise_floor(model: Model, records: Sequence[Record]) -> np.ndarray:
    """Noise floor of each output channel in its unit, shape (ny,)."""
    measured: dict[str, list[float]] = {}
    for record in records:
        for channel, noise in measure_noise(record).items():
            measured.setdefault(channel, []).append(noise.sigma_floor)
    floor = []
    for channel, unit in zip(model.mechanism.outputs, model.mechanism.output_units, strict=True):
        sensor = model.sensors.get(channel, {})
        stated = np.hypot(
            sensor['noise'].value if 'noise' in sensor else 0.0,
            sensor['resolution'].value / np.sqrt(12) if 'resolution' in sensor else 0.0,
        )
        seen = np.median(measured[channel]) if channel in measured else 0.0
        floor.append(max(stated, seen, SMALLEST_SIGMA[unit]))
    return np.array(floor)


def as_data_set(body: Mechanism, record: Record, sigma: np.ndarray) -> DataSet:
    """The data set of one record, given the noise floor of each output, shape (ny,)."""
    time = record.time
    names = (*body.inputs, *(name for name in record.inputs if name not in body.inputs))
    outputs = np.column_stack(
        [record.outputs.get(channel, np.full(len(time), np.nan)) for channel in body.outputs]
    )
    motion, noise = measured_motion(body, record.setup, time, outputs, sigma)
    return DataSet(
        name=record.name,
        recording=recording_of(record),
        time=time,
        inputs=np.column_stack([record.inputs[name] for name in names]),
        input_names=names,
        outputs=outputs,
        sigma=sigma,
        setup=record.setup,
        motion=motion,
        motion_sigma=_generous(motion, noise),
        since=record.since,
        motion_noise=noise,
    )


def pieces(body: Mechanism, data_set: DataSet, length: float) -> list[tuple[float, DataSet]]:
    """The data set cut into consecutive pieces of a length in s, each with a motion of its own.

    A rest shorter than half of that is left out, and so is what begins without samples.

    Returns:
        When each begins, in s, and the piece.
    """
    cuts = np.searchsorted(data_set.time, np.arange(0.0, data_set.duration, length))
    found = []
    for a, b in itertools.pairwise([*cuts, len(data_set.time)]):
        time, outputs = data_set.time[a:b] - data_set.time[a], data_set.outputs[a:b]
        if b - a < 2 or time[-1] < length / 2 or not np.isfinite(outputs).any():
            continue
        motion, noise = data_set.motion, data_set.motion_noise
        spread = data_set.motion_sigma
        if a > 0:
            if np.isfinite(outputs[time <= START_WINDOW]).sum(axis=0).max() < 3:
                continue  # samples are missing there
            motion, noise = measured_motion(body, data_set.setup, time, outputs, data_set.sigma)
            spread = _generous(motion, noise)
        piece = replace(
            data_set, name=f'{data_set.name}[{a}:{b}]', time=time, inputs=data_set.inputs[a:b],
            outputs=outputs, motion=motion, motion_sigma=spread,
            since=data_set.since + float(data_set.time[a]), motion_noise=noise,
        )  # fmt: skip
        found.append((float(data_set.time[a]), piece))
    return found


@functools.cache
def sensor_matrix(body: Mechanism, setup: Setup) -> np.ndarray:
    """Outputs of ideal sensors as a matrix on (s, ds/dt), shape (ny, 2m): all are linear."""
    basis = body.kinematics(setup).basis
    m = basis.shape[1]
    s, ds = ca.SX.sym('s', m), ca.SX.sym('ds', m)
    ideal = body.sensors(ca.mtimes(basis, s), ca.mtimes(basis, ds))
    stacked = ca.vertcat(*ideal.values())
    jacobian = ca.Function('c', [s, ds], [ca.jacobian(stacked, ca.vertcat(s, ds))])
    return np.asarray(ca.DM(jacobian(np.zeros(m), np.zeros(m))))


def initial_motion(
    body: Mechanism, setup: Setup, time: np.ndarray, outputs: np.ndarray, sigma: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """First guess of free coordinates and rates at the first row, and how far it may be off."""
    motion, noise = measured_motion(body, setup, time, outputs, sigma)
    return motion, _generous(motion, noise)


def _generous(motion: np.ndarray, noise: np.ndarray) -> np.ndarray:
    # The window's polynomial is itself an approximation, and the sensors may be late.
    m = len(motion) // 2
    late = LATEST * np.concatenate([np.abs(motion[m:]), np.full(m, FASTEST)])
    least = np.concatenate([np.full(m, 1e-3), np.full(m, 1e-1)])
    return 10 * np.sqrt(np.diag(noise)) + late + least


def measured_motion(
    body: Mechanism, setup: Setup, time: np.ndarray, outputs: np.ndarray, sigma: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Free coordinates and rates at the first row by the first samples, and their noise.

    Args:
        body: The mechanism.
        setup: The set-up.
        time: Stamps in s from the first row, shape (n,).
        outputs: Measured outputs, shape (n, ny).
        sigma: Their noise, shape (ny,).

    Returns:
        Motion, shape (2m,), and the covariance that the noise of the samples gives it.
    """
    # Value and slope of each channel over a short window, then least squares on (s, ds/dt):
    # the slope of an angle is a rate, so encoders alone give rates too.
    matrix = sensor_matrix(body, setup)
    m2 = matrix.shape[1]
    m = m2 // 2
    window = time <= max(START_WINDOW, time[min(6, len(time) - 1)])
    rows, values, weights = [], [], []
    for j, unit in enumerate(body.output_units):
        here = window & np.isfinite(outputs[:, j])
        if here.sum() < 3:
            continue
        t, y = time[here], outputs[here, j]
        degree = 2 if here.sum() >= 8 else 1
        design = np.vander(t, degree + 1, increasing=True)
        coefficients, *_ = np.linalg.lstsq(design, y, rcond=None)
        spread = np.sqrt(np.diag(np.linalg.inv(design.T @ design)))
        rows.append(matrix[j])
        values.append(coefficients[0])
        weights.append(1 / (sigma[j] * spread[0]))
        if not unit.endswith('/s'):
            rows.append(np.concatenate([np.zeros(m), matrix[j, :m]]))
            values.append(coefficients[1])
            weights.append(1 / (sigma[j] * spread[1]))
    a, b, w = np.array(rows), np.array(values), np.array(weights)
    motion, *_ = np.linalg.lstsq(a * w[:, None], b * w, rcond=None)
    information = (a * w[:, None]).T @ (a * w[:, None])
    return motion, np.linalg.pinv(information)


def led_in(data_set: DataSet) -> DataSet:
    """The data set less the outputs of its first moments.

    What went before a record is an assumption of every model with a memory, as a delay; it must
    not count for or against the model.
    """
    begun = data_set.time >= min(LEAD_IN_S, LEAD_IN_SHARE * data_set.duration)
    return replace(data_set, outputs=np.where(begun[:, None], data_set.outputs, np.nan))
