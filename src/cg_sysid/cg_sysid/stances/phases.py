"""A walking record as stance phases, each a record of its own, and the landings between them.

Where a foot bounces or slides after a touchdown, or slips before the next one, the pinned model
says nothing: there short pieces are explained far worse than elsewhere in the record, and they
belong to no phase. The model is identified first, from the middles of the phases and then from a
rough cut: a robot that carries a payload is not one that slides. A record without a touchdown is
left as it is.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from cg_dynamics.errors import DynamicsError
from cg_dynamics.model import Model
from cg_dynamics.walking.impact import other
from cg_sysid.identification.data_set import prepare
from cg_sysid.identification.identify import fit
from cg_sysid.identification.unknowns import IdentificationError
from cg_sysid.records.record import Record
from cg_sysid.stances.touchdown import Pieces, Touchdown, find_touchdowns

PIECE_S = 0.08  # length of the pieces that are compared
STRIDE_S = 0.01  # from one of them to the next
GUARD_S = 0.008  # on both sides of a touchdown, whose instant is known to some samples
UPRIGHT = 0.13  # rad from the ground's normal within which almost any ground holds a foot
ROUGHLY = 12.0  # times the usual error from which a piece is not that of a foot that is held
WORSE = 4.0  # the same once the model's numbers are those of these phases
FAR = 2.0  # times that limit, far from any touchdown
AFTER_S = 0.4  # s after a touchdown in which a foot may slide, and `BEFORE_S` before the next
BEFORE_S = 0.25
FORGIVEN_S = 0.01  # s at the edge of a piece in which an error does not show
ITERATIONS = 16  # of the fit that makes its numbers so
TRIMMINGS = 4  # such fits, at most
LEFT_BEHIND = 10.0  # times the usual error of a phase
SHORTEST_S = 0.15  # of a phase that says anything


@dataclass(frozen=True)
class Landing:
    """A touchdown and the phases around it.

    Attributes:
        record: The whole record.
        touchdown: Where and which foot.
        before: Span in s of the phase before it in the record; None where it was too short.
        after: The same of the phase after it.
        end: Time in s of what follows: the next touchdown, or the end of the record.
    """

    record: Record
    touchdown: Touchdown
    before: tuple[float, float] | None
    after: tuple[float, float] | None
    end: float


@dataclass(frozen=True)
class Cut:
    """Records cut into phases.

    Attributes:
        records: Phases of those with touchdowns, the others as they were.
        landings: The landings.
        origin: Name of each of the records -> name of the one that it was cut from.
    """

    records: tuple[Record, ...]
    landings: tuple[Landing, ...]
    origin: dict[str, str]


def cut_steps(records: Sequence[Record], model: Model | None) -> Cut:
    """Cut every record at its touchdowns.

    Args:
        records: Records whose set-up names the leg that stands at the start.
        model: The nominal model; without one nothing is cut.
    """
    touchdowns = {r.name: find_touchdowns(r, model) if model else [] for r in records}
    walking = [record for record in records if touchdowns[record.name]]
    if model is None or not walking:
        return Cut(tuple(records), (), {record.name: record.name for record in records})
    middles = [_middles(record, touchdowns[record.name]) for record in walking]
    better = _identified(model, [phase for phases in middles for phase in phases])
    rough = [_cut(r, touchdowns[r.name], better, ROUGHLY)[0] for r in walking]
    better = _identified(model, [phase for phases in rough for phase in phases])
    found: list[Record] = []
    landings: list[Landing] = []
    origin: dict[str, str] = {}
    for record in records:
        instants = touchdowns[record.name]
        phases, steps = _cut(record, instants, better, WORSE) if instants else ([record], [])
        found += phases
        landings += steps
        origin |= {phase.name: record.name for phase in phases}
    return Cut(tuple(found), tuple(landings), origin)


def _middles(record: Record, touchdowns: Sequence[Touchdown]) -> list[Record]:
    """The middle of each phase: about upright the ground holds a foot if it ever does."""
    stances = [*(t.stance for t in touchdowns), other(touchdowns[-1].stance)]
    edges = [0.0, *(t.time for t in touchdowns), record.duration]
    time, inner = record.samples('imu_angle')
    _, hip = record.samples('hip_angle')
    between = np.interp(time, record.samples('hip_angle')[0], hip)
    found = []
    for stance, (a, b) in zip(stances, pairwise(edges), strict=True):
        lean = inner if stance == 'inner' else inner - between
        inside = (time > a + GUARD_S) & (time < b - GUARD_S)
        run = longest_run(inside & (np.abs(lean - touchdowns[0].slope) < UPRIGHT))
        if run is not None and time[run[1]] - time[run[0]] >= SHORTEST_S:
            found.append(_phase(record, stance, float(time[run[0]]), float(time[run[1]])))
    return found


def _identified(model: Model, phases: Sequence[Record]) -> Model:
    """The model with the numbers of these phases: what it lacks shows least in it.

    A phase that is one slide from end to end would pull all numbers its way: those that are left
    far behind are let go.
    """
    better, data_sets = model, prepare(model, phases) if phases else []
    for _ in range(TRIMMINGS if data_sets else 0):
        try:
            found = fit(model, data_sets, iterations=ITERATIONS)
        except (IdentificationError, DynamicsError, np.linalg.LinAlgError):
            return better
        better = found.model
        errors = (found.mse * found.count).sum(axis=1) / found.count.sum(axis=1)
        limit = LEFT_BEHIND * max(1.0, float(np.median(errors)))
        kept = [
            data_set for data_set, error in zip(data_sets, errors, strict=True) if error < limit
        ]
        if len(kept) == len(data_sets):
            break
        data_sets = kept
    return better


def _cut(
    record: Record, touchdowns: Sequence[Touchdown], model: Model, worse: float
) -> tuple[list[Record], list[Landing]]:
    last = touchdowns[-1]
    stances = [*(landed.stance for landed in touchdowns), other(last.stance)]
    edges = [0.0, *(landed.time for landed in touchdowns), record.duration]
    spans = _held(Pieces(record, model), stances, edges, worse)
    phases = [
        _phase(record, stance, *span)
        for stance, span in zip(stances, spans, strict=True)
        if span is not None
    ]
    landings = [
        Landing(record, landed, spans[k], spans[k + 1], edges[k + 2])
        for k, landed in enumerate(touchdowns)
    ]
    return phases, landings


def _held(
    pieces: Pieces, stances: Sequence[str], edges: Sequence[float], worse: float
) -> list[tuple[float, float] | None]:
    """The span of each phase in which its foot is held, as far as the model can tell."""
    bounds = [
        (a + GUARD_S * (a > edges[0]), b - GUARD_S * (b < edges[-1])) for a, b in pairwise(edges)
    ]
    starts = [np.arange(a, b - PIECE_S, STRIDE_S) for a, b in bounds]
    errors = [
        np.array([pieces.misfit(stance, t, t + PIECE_S) for t in begin])
        for stance, begin in zip(stances, starts, strict=True)
    ]
    found: list[tuple[float, float] | None] = []
    for k, ((a, b), begin, error) in enumerate(zip(bounds, starts, errors, strict=True)):
        alike = [e for e, s in zip(errors, stances, strict=True) if s == stances[k] and len(e)]
        # Of a robot that falls more of the time is a slide than not.
        usual = max(1.0, float(np.nanquantile(np.concatenate(alike), 0.25))) if alike else 1.0
        # What is a little wrong far from any touchdown is wrong with the model.
        far = (begin > edges[k] + AFTER_S) & (begin + PIECE_S < edges[k + 1] - BEFORE_S)
        run = longest_run(~(error > usual * np.where(far, FAR * worse, worse)))
        span = None
        # Of a phase that is a slide for the most part nothing is kept.
        if run is not None and run != (0, len(begin) - 1):
            kept = error[run[0] : run[1] + 1]
            run = None if np.median(kept) > worse * usual else run
        if run is not None:
            first, final = run
            span = (
                a if first == 0 else float(begin[first]) + FORGIVEN_S,
                b if final == len(begin) - 1 else float(begin[final]) + PIECE_S - FORGIVEN_S,
            )
        found.append(span if span is not None and span[1] - span[0] >= SHORTEST_S else None)
    return found


def longest_run(fine: np.ndarray) -> tuple[int, int] | None:
    """First and last index of the longest run of True; None where there is none."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], fine, [False]]).astype(int)))
    if not len(edges):
        return None
    runs = edges.reshape(-1, 2)
    first, stop = runs[np.argmax(runs[:, 1] - runs[:, 0])]
    return int(first), int(stop - 1)


def _phase(record: Record, stance: str, start: float, stop: float) -> Record:
    piece = record.slice(start, stop)
    setup = replace(record.setup, stance=stance)
    name = f'{record.name}[{start:.2f}..{stop:.2f} s]'
    return replace(piece, name=name, setup=setup)
