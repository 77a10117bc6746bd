"""A record: the measured signals of one experiment on one time axis.

Everything downstream (checks, identification, diagnosis) works on a `Record`. It is validated
once, here, and trusted afterwards. Its arrays are read-only.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any

import numpy as np

from cg_dynamics.rig import Setup
from cg_interfaces import channels
from cg_interfaces.stamps import NS_PER_S
from cg_sysid.errors import RecordingError

SHARED_ROW_NS = 1_000  # samples whose stamps differ by no more than this share a row


@dataclass(frozen=True)
class Record:
    """The signals of one experiment, row by row in time.

    Attributes:
        name: Short name, for tables and plots.
        stamp_ns: Union of all input and output stamps in ns, shape (N,), int64, strictly
            increasing, N >= 2.
        inputs: Channel -> value held from its stamp to the next row, shape (N,), finite.
        outputs: Channel -> measured value, shape (N,), NaN on rows without a sample of it.
        mechanism: Channels of the robot (channels.py); its name will do where it has a row there.
        setup: What was done to the rig.
        note: The recording note as read.
        source: The recording that its note names, or the path that it was read from, or the record
            that it was cut from; empty if it was made in memory.
        since: Time in s from the first row of what it was cut from to its own.
    """

    name: str
    stamp_ns: np.ndarray
    inputs: dict[str, np.ndarray]
    outputs: dict[str, np.ndarray]
    mechanism: channels.Mechanism
    setup: Setup = field(default_factory=Setup)
    note: dict[str, Any] = field(default_factory=dict)
    source: str = ''
    since: float = 0.0

    def __post_init__(self) -> None:
        if isinstance(self.mechanism, str):
            object.__setattr__(self, 'mechanism', channels.mechanism(self.mechanism))
        known = self.mechanism
        stamp = np.array(self.stamp_ns)
        if stamp.ndim != 1 or stamp.dtype.kind not in 'iu':
            raise self._error(
                f'stamp_ns has shape {stamp.shape} and type {stamp.dtype}; '
                'a vector of integer nanoseconds is needed'
            )
        if len(stamp) < 2:
            raise self._error(f'{len(stamp)} row(s); at least 2 are needed')
        backward = np.flatnonzero(np.diff(stamp) <= 0)
        if len(backward):
            k = int(backward[0]) + 1
            raise self._error(
                f'stamp_ns[{k}] = {stamp[k]} does not come after '
                f'{stamp[k - 1]}; stamps must increase strictly'
            )
        object.__setattr__(self, 'stamp_ns', _frozen(stamp.astype(np.int64)))
        allowed_inputs = (*known.input_names, *known.extra_input_names, *known.told_names)
        object.__setattr__(self, 'inputs', self._signals('input', self.inputs, allowed_inputs))
        object.__setattr__(
            self, 'outputs', self._signals('output', self.outputs, known.output_names)
        )
        missing = [name for name in known.input_names if name not in self.inputs]
        if missing:
            raise self._error(
                f'input {missing[0]} is missing; {known.name} needs {", ".join(known.input_names)}'
            )
        if not self.outputs:
            raise self._error(
                f'no output; at least one of {", ".join(known.output_names)} is needed'
            )

    def _signals(
        self, kind: str, signals: dict[str, np.ndarray], allowed: Sequence[str]
    ) -> dict[str, np.ndarray]:
        """The signals as read-only float arrays, checked."""
        checked = {}
        for name, values in signals.items():
            if name not in allowed:
                raise self._error(
                    f'unknown {kind} {name!r}; {self.mechanism.name} has {", ".join(allowed)}'
                )
            array = np.array(values, dtype=float)
            if array.shape != self.stamp_ns.shape:
                raise self._error(
                    f'{kind} {name} has shape {array.shape}, stamp_ns '
                    f'{self.stamp_ns.shape}; they must agree'
                )
            bad = np.isinf(array) if kind == 'output' else ~np.isfinite(array)
            if bad.any():
                k = int(np.flatnonzero(bad)[0])
                raise self._error(f'{kind} {name}[{k}] is {array[k]}; it must be finite')
            if np.isnan(array).all():
                raise self._error(f'{kind} {name} holds no sample')
            checked[name] = _frozen(array)
        return checked

    def _error(self, text: str) -> RecordingError:
        return RecordingError(f'record {self.name!r}: {text}')

    def __len__(self) -> int:
        return len(self.stamp_ns)

    @property
    def time(self) -> np.ndarray:
        """Time since the first row in s, shape (N,)."""
        return (self.stamp_ns - self.stamp_ns[0]) / NS_PER_S

    @property
    def dt(self) -> np.ndarray:
        """Time from each row to the next in s, shape (N - 1,)."""
        return np.diff(self.stamp_ns) / NS_PER_S

    @property
    def duration(self) -> float:
        """Time from the first row to the last in s."""
        return float(self.stamp_ns[-1] - self.stamp_ns[0]) / NS_PER_S

    def samples(self, channel: str) -> tuple[np.ndarray, np.ndarray]:
        """The samples of one output without the rows that lack it.

        Returns:
            Time since the first row in s, shape (M,), and value, shape (M,).

        Raises:
            ValueError: The record has no such output.
        """
        if channel not in self.outputs:
            msg = f'record {self.name!r} has no output {channel!r}; it has {list(self.outputs)}'
            raise ValueError(msg)
        values = self.outputs[channel]
        present = ~np.isnan(values)
        return self.time[present], values[present]

    def slice(self, start_s: float, stop_s: float) -> 'Record':
        """The rows with start_s <= time < stop_s, in s since the first row.

        Outputs without a sample in that span are left out.

        Raises:
            RecordingError: Fewer than 2 rows, or no output, lie in the span.
        """
        time = self.time
        rows = (time >= start_s) & (time < stop_s)
        name = f'{self.name}[{start_s:g}..{stop_s:g} s]'
        if rows.sum() < 2:
            msg = (
                f'record {name!r}: {rows.sum()} row(s) in the span; at least 2 are needed '
                f'(the record spans 0..{self.duration:g} s)'
            )
            raise RecordingError(msg)
        outputs = {c: v[rows] for c, v in self.outputs.items() if not np.isnan(v[rows]).all()}
        inputs = {c: v[rows] for c, v in self.inputs.items()}
        return replace(
            self, name=name, stamp_ns=self.stamp_ns[rows], inputs=inputs, outputs=outputs,
            source=self.source or self.name, since=self.since + float(time[rows][0]),
        )  # fmt: skip

    def segments(self, length_s: float) -> list['Record']:
        """The record cut into consecutive pieces of equal length; a shorter rest is dropped.

        Args:
            length_s: Length of a piece in s.

        Raises:
            ValueError: The length is not positive.
        """
        if not length_s > 0.0:
            msg = f'length_s is {length_s}; it must be positive'
            raise ValueError(msg)
        # Half a sample of grace, or else the last piece of an exact multiple would be lost.
        grace = 0.5 * float(np.median(self.dt))
        count = int((self.duration + float(np.median(self.dt)) + grace) / length_s)
        edges = np.arange(count + 1) * length_s - grace
        return [self.slice(max(a, 0.0), b) for a, b in pairwise(edges)]


def _frozen(array: np.ndarray) -> np.ndarray:
    array.setflags(write=False)
    return array


def merge_stamps(stamps: Sequence[np.ndarray], shared_row_ns: int = SHARED_ROW_NS) -> np.ndarray:
    """Row stamps of several sampled signals.

    Stamps that follow each other by no more than `shared_row_ns` become one row, which takes
    the earliest of them.

    Args:
        stamps: Increasing stamps of each signal in ns, each of shape (M_i,).
        shared_row_ns: Widest gap within one row in ns.

    Returns:
        Stamps of the rows in ns, shape (N,), strictly increasing.
    """
    every = np.unique(np.concatenate([np.asarray(s, dtype=np.int64) for s in stamps]))
    starts_row = np.concatenate([[True], np.diff(every) > shared_row_ns])
    return every[starts_row]


def row_of(stamp_ns: np.ndarray, rows_ns: np.ndarray) -> np.ndarray:
    """Index of the row that each sample belongs to.

    Args:
        stamp_ns: Stamps of the samples in ns, shape (M,).
        rows_ns: Stamps of the rows from `merge_stamps` in ns, shape (N,).

    Returns:
        Row index of each sample, shape (M,), -1 before the first row.
    """
    return np.searchsorted(rows_ns, stamp_ns, side='right') - 1


def hold(stamp_ns: np.ndarray, values: np.ndarray, rows_ns: np.ndarray) -> np.ndarray:
    """Samples carried forward to every row (zero-order hold).

    Args:
        stamp_ns: Increasing stamps of the samples in ns, shape (M,).
        values: Samples, shape (M,).
        rows_ns: Stamps of the rows in ns, shape (N,).

    Returns:
        Value acting from each row on, shape (N,), NaN before the first sample.
    """
    rows = row_of(stamp_ns, rows_ns)
    held = np.full(len(rows_ns), np.nan)
    held[rows[rows >= 0]] = values[rows >= 0]
    filled = np.maximum.accumulate(np.where(np.isnan(held), -1, np.arange(len(held))))
    return np.where(filled >= 0, held[filled], np.nan)


def place(stamp_ns: np.ndarray, values: np.ndarray, rows_ns: np.ndarray) -> np.ndarray:
    """Samples put on their rows, NaN elsewhere.

    Args:
        stamp_ns: Increasing stamps of the samples in ns, shape (M,).
        values: Samples, shape (M,).
        rows_ns: Stamps of the rows in ns, shape (N,).

    Returns:
        Values by row, shape (N,).
    """
    rows = row_of(stamp_ns, rows_ns)
    placed = np.full(len(rows_ns), np.nan)
    placed[rows[rows >= 0]] = values[rows >= 0]
    return placed
