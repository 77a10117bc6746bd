"""How far can a recording be followed by simulation from one initial motion?

A fit simulates a record from a start that it fits. Whatever is a little wrong, the start or the
model, moves the simulation off the measured motion by an error that the motion itself carries on:

    delta x(t) = Phi(t, s) delta x(s),    growth(t, s) = |D Phi(t, s) D^-1|_2              (FOLLOW)

Phi is the sensitivity of the simulated motion x = (s, ds/dt) to where it began, along the motion
that was *measured*: the product of those of short pieces, each from its own measured start.
The nominal model need not follow the record to say how errors grow in it. D weighs coordinates 1
and rates 1/omega, omega the frequency of the motion, so that growth has no unit.

Where friction and gravity hold the motion growth stays near one for any length. Upright it is
exponential, and a record is followed only for a while: it is cut into windows there, each with a
start of its own.
"""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cg_dynamics.assemble import parameter_vector
from cg_dynamics.errors import DynamicsError
from cg_dynamics.model import Model
from cg_dynamics.rollout.compiled import compile_model
from cg_sysid.identification import torque_error
from cg_sysid.identification.data_set import DataSet, measured_motion, prepare
from cg_sysid.records.record import Record

# A model that is right to one per cent, which is as right as an identified one is, is wrong by the
# whole of the motion where errors have grown by so much.
FOLLOWED = 100.0
LEAST_FOLLOWED = 5.0  # growth over which any record is followed that holds a motion at all
SHORTEST_WINDOW = 0.5  # s; less holds no motion to compare
PIECE_S = 0.1  # of which sensitivities are chained; a measured start carries as far anywhere
FEWEST_AT_START = 3  # samples of some channel from which a start is measured
NUDGE = 1e-6  # rad, rad/s (m, m/s): of central differences, far below friction's corner
SLOWEST, FASTEST = 1.0, 30.0  # rad/s: a motion's frequency, where rest or noise would say others


@dataclass(frozen=True)
class Followed:
    """How far one record is followed.

    Attributes:
        name: Of the record.
        growth: Largest growth of an error from the start of the record, [1].
        cuts: Instants in s at which it is cut, the start left out; none if it is followed whole.
    """

    name: str
    growth: float
    cuts: tuple[float, ...] = ()

    @property
    def whole(self) -> bool:
        """Whether it is followed to its end."""
        return not self.cuts


@dataclass(frozen=True)
class Windows:
    """What records are integrated as, and who says so.

    Attributes:
        records: Each record, as far as it is followed.
        chosen: Length in s of windows that a person asked for; None where the data say.
    """

    records: tuple[Followed, ...] = ()
    chosen: float | None = None

    @property
    def text(self) -> str:
        """What is told, a sentence."""
        lost = [f for f in self.records if not f.whole]
        if self.chosen is not None:
            able = len(self.records) - len(lost)
            return (
                f'records are cut into windows of {self.chosen:g} s, chosen by you; whole, '
                f'{able} of {len(self.records)} could be followed, and judge whole where held out'
            )
        if not lost:
            return 'every record is fitted and judged whole'
        told = '; '.join(
            f'{f.name} in {len(f.cuts) + 1} windows, as an error at its start '
            f'grows {_times(f.growth)}'
            for f in lost
        )
        others = len(self.records) - len(lost)
        rest = f', the other {others} whole' if others else ''
        return f'cut where the whole cannot be followed: {told}{rest}'


NOT_CUT = Windows()


def _times(growth: float) -> str:
    if growth < 1e6:
        return f'{growth:.0f} times'
    return f'by 10^{math.log10(growth):.0f}' if math.isfinite(growth) else 'beyond all bounds'


def followed(model: Model, records: Sequence[Record]) -> tuple[Followed, ...]:
    """How far each record is followed along a model; to its end if the model cannot say.

    Of a robot of a URDF the model is one that its torques agree with (torque_error.py): friction
    that the file does not know would hold the motion, or let it go. And what share of the torques
    it leaves is how wrong it is: errors may grow by the inverse of that.
    """
    data_sets = prepare(model, records) if records else []
    most = FOLLOWED
    found = (
        torque_error.fit_by_torque(model, data_sets)
        if data_sets and torque_error.can(model)
        else None
    )
    if found is not None:
        model = model.with_values(found.values)
        wrong = float(np.nanmax(found.relative, initial=0.0))
        most = float(np.clip(1 / max(wrong, 1e-12), LEAST_FOLLOWED, FOLLOWED))
    return tuple(_followed(model, data_set, most) for data_set in data_sets)


def windows_of(record: Record, found: Followed) -> list[Record]:
    """The record, or the windows between its cuts."""
    if found.whole:
        return [record]
    edges = (0.0, *found.cuts, math.nextafter(record.duration, math.inf))
    return [record.slice(a, b) for a, b in itertools.pairwise(edges)]


def _followed(model: Model, data_set: DataSet, most: float = FOLLOWED) -> Followed:
    try:
        begins, maps = sensitivities(model, data_set)
    except DynamicsError:
        return Followed(data_set.name, 1.0)
    since_start = since_cut = np.eye(len(data_set.motion))
    largest, cuts, last = 1.0, [], 0.0
    for begin, phi in zip(begins, maps, strict=True):
        with np.errstate(over='ignore', invalid='ignore'):
            since_start, since_cut = phi @ since_start, phi @ since_cut
        largest = max(largest, _norm(since_start))
        if _norm(since_cut) > most and begin - last >= SHORTEST_WINDOW:
            cuts.append(float(begin))
            since_cut, last = phi, float(begin)
    if cuts and data_set.duration - cuts[-1] < SHORTEST_WINDOW:
        cuts.pop()
    return Followed(data_set.name, largest, tuple(cuts))


def _norm(phi: np.ndarray) -> float:
    return float(np.linalg.norm(phi, 2)) if np.isfinite(phi).all() else math.inf


def sensitivities(model: Model, data_set: DataSet) -> tuple[np.ndarray, list[np.ndarray]]:
    """When each piece of a data set begins, in s, shape (k,), and its D Phi D^-1, (2m, 2m) each.

    Extra states of a model start settled in every piece.

    Raises:
        SimulationError: if the model runs away within a piece.
    """
    body, time = model.mechanism, data_set.time
    compiled = compile_model(model, data_set.setup)
    p = parameter_vector(model, data_set.setup)
    u = data_set.inputs_for(compiled.input_names)
    edges = np.searchsorted(time, np.arange(0.0, data_set.duration - PIECE_S / 2, PIECE_S))
    starts, motions = [], []
    for a in np.unique(edges):
        rows = slice(a, np.searchsorted(time, time[a] + PIECE_S, side='right'))
        if np.isfinite(data_set.outputs[rows]).sum(axis=0).max() < FEWEST_AT_START:
            continue  # samples are missing there: the piece before goes on
        starts.append(a)
        motions.append(
            measured_motion(
                body, data_set.setup, time[rows] - time[a], data_set.outputs[rows], data_set.sigma
            )[0]
        )
    found = []
    for a, b, motion in zip(starts, [*starts[1:], len(time) - 1], motions, strict=True):
        rows = slice(a, b + 1)

        def end(start: np.ndarray, rows: slice = rows) -> np.ndarray:
            x0 = compiled.initial_state(start, u[rows.start], p)
            here = time[rows] - time[rows.start]
            return compiled.simulate(here, u[rows], x0, p)[-1, : len(start)]

        nudges = NUDGE * np.eye(len(motion))
        found.append(
            np.column_stack([(end(motion + n) - end(motion - n)) / (2 * NUDGE) for n in nudges])
        )
    if not found:
        return np.zeros(0), []
    d = _weights(np.array(motions))
    return time[starts], [d[:, None] * phi / d for phi in found]


def _weights(motions: np.ndarray) -> np.ndarray:
    """Diagonal of D for motions (k, 2m)."""
    m = motions.shape[1] // 2
    spread = motions.std(axis=0)
    omega = np.clip(spread[m:].max() / max(spread[:m].max(), NUDGE), SLOWEST, FASTEST)
    return np.concatenate([np.ones(m), np.full(m, 1 / omega)])
