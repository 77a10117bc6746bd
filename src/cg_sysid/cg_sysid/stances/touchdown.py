"""Touchdowns: where in a record the leg that stands changes.

A touchdown shows three times over. Both feet are on the ground, the swing foot away from the other
and coming down; both rates jump, which no torque can make them do; and what follows is the motion
of a robot pinned at the foot that landed, no more at the other one. The first two are cheap and
name candidates, the third decides: a leg that swings through the pose of a step, or that is hit in
it, goes on about the same foot.
"""

from dataclasses import dataclass, replace

import numpy as np

from cg_dynamics.assemble import parameter_vector
from cg_dynamics.mechanisms.compass_gait import CompassGait
from cg_dynamics.model import Model
from cg_dynamics.rig import STANCES
from cg_dynamics.rollout.compiled import compile_model
from cg_dynamics.walking.impact import other
from cg_sysid.identification.data_set import as_data_set, noise_floor
from cg_sysid.records.jumps import on_grid
from cg_sysid.records.noise import channel_noise
from cg_sysid.records.record import Record

NEEDED = ('imu_angle', 'hip_angle')
SPAN_S = 0.024  # of the parabolas on each side of an instant
FEWEST_IN_STRETCH = 6  # samples in them
JUMP = 6.0  # standard deviations of a jump of the rates
NEAR_S = 0.012  # s within which the largest jump is the instant that is meant
STEEPEST = 0.25  # rad, of ground on which anybody walks
SHORTEST_STEP = 0.03  # m between the feet
QUICKEST = 0.08  # s from one touchdown to the next
LOOK_S = 0.08  # length of the pieces by which the foot that is held is known
STRIDE_S = 0.02  # from one of them to the next
FINE_S = 0.004  # the same where the instant is sought
REPOSE_S = 0.06  # s by which an instant may be wrong
BACK_S = 0.3  # s that may pass until the foot that landed is held
ITERATIONS = 3
RATHER = 4.0  # times by which the one foot must explain such a piece better than the other


@dataclass(frozen=True)
class Touchdown:
    """The swing foot lands.

    Attributes:
        time: In s since the first row of the record, to a few samples.
        stance: Leg that stood until then.
        slope: Fall of the ground ahead in rad, in the frame of the angles, from the pose.
    """

    time: float
    stance: str
    slope: float


@dataclass(frozen=True)
class _Sides:
    """Angles and rates at the samples of a grid, as seen from before and from after each.

    Attributes:
        time: In s, shape (n,).
        q: (q_inner, q_outer) in rad, shape (n, 2).
        before: Rates in rad/s, shape (n, 2).
        jump: Largest jump of a rate over its standard deviation, shape (n,).
    """

    time: np.ndarray
    q: np.ndarray
    before: np.ndarray
    jump: np.ndarray


def find_touchdowns(record: Record, model: Model) -> list[Touchdown]:
    """The touchdowns of a record, in order; none where no step is possible.

    Args:
        record: Its set-up names the leg that stands at the start.
        model: The nominal model; it may lack what moves a robot a little differently.
    """
    known = isinstance(model.mechanism, CompassGait) and record.mechanism.name == CompassGait.name
    if not known or not record.setup.may_step:
        return []
    sides = _sides(record)
    if sides is None:
        return []
    pieces = Pieces(record, model)
    found: list[Touchdown] = []
    stance, last, usual = record.setup.stance, 0.0, []
    for start in np.arange(0.0, record.duration - LOOK_S / 2, STRIDE_S):
        if found and start < last + QUICKEST / 2:
            continue
        old = pieces.misfit(stance, start, start + LOOK_S)
        if not old > RATHER * max(1.0, pieces.misfit(other(stance), start, start + LOOK_S)):
            usual.append(old)
            continue
        limit = RATHER * max(1.0, float(np.median(usual or [1.0])))
        landed = _instant(sides, pieces, stance, start, last, limit, model.values['leg_length'])
        if landed is None:
            continue
        found.append(landed)
        stance, last, usual = other(stance), landed.time, []
    return _on_a_plane(sides, found)


def _on_a_plane(sides: _Sides, found: list[Touchdown]) -> list[Touchdown]:
    """The same at the instants at which both feet stand on one and the same plane."""
    if len(found) < 2:
        return found
    slopes = np.array([landed.slope for landed in found])
    # Where the rates jump most the instant is surest, and the pose with it.
    jumps = [sides.jump[np.argmin(np.abs(sides.time - landed.time))] for landed in found]
    order = np.argsort(slopes)
    middle = np.searchsorted(np.cumsum(np.array(jumps)[order]), sum(jumps) / 2)
    slope = float(slopes[order][middle])
    lean, moved = sides.q.sum(axis=1) / 2 - slope, []
    for landed in found:
        near = np.flatnonzero(np.abs(sides.time[:-1] - landed.time) < REPOSE_S)
        crossed = near[lean[near] * lean[near + 1] <= 0]
        time = landed.time
        if len(crossed):
            time = float(sides.time[crossed[np.argmin(np.abs(sides.time[crossed] - time))]])
        moved.append(replace(landed, time=time, slope=slope))
    return moved


def _instant(
    sides: _Sides,
    pieces: 'Pieces',
    stance: str,
    known: float,
    last: float,
    limit: float,
    leg_length: float,
) -> Touchdown | None:
    """The touchdown after which the motion of a piece that starts at `known` turned out new.

    It is the last instant before which the old foot still explains the motion, and if the rates
    jump near it, there. None if the pose is never that of a landing.
    """
    # Of a piece that begins at the touchdown the old foot explains the first rows.
    latest = min(known + LOOK_S, float(sides.time[-1]))
    earliest = max(last + QUICKEST if last else FINE_S, known - BACK_S)
    for end in np.arange(latest, earliest, -FINE_S):
        begin = max(end - LOOK_S, last)
        old = pieces.misfit(stance, begin, end)
        # With much missing in the model the limit is wide, and a piece from after the touchdown
        # may be within it.
        if old < limit and old <= RATHER * max(1.0, pieces.misfit(other(stance), begin, end)):
            break
    else:
        return None
    near = np.flatnonzero(np.abs(sides.time - end) <= NEAR_S)
    near = near[[_lands(sides, int(k), stance, leg_length) is not None for k in near]]
    if not len(near):
        return None
    best = int(near[np.argmax(sides.jump[near])])
    if sides.jump[best] < JUMP:
        best = int(near[np.argmin(np.abs(sides.time[near] - end))])
    slope = _lands(sides, best, stance, leg_length)
    assert slope is not None, 'only landings are near'
    return Touchdown(float(sides.time[best]), stance, slope)


def _sides(record: Record) -> _Sides | None:
    if any(channel not in record.outputs for channel in NEEDED):
        return None
    times = {channel: record.samples(channel)[0] for channel in record.outputs}
    spacing = max(float(np.median(np.diff(t))) for t in times.values() if len(t) > 1)
    span = max(FEWEST_IN_STRETCH, round(SPAN_S / spacing))
    if min(len(t) for t in times.values()) < 4 * span:
        return None
    grid, signals = np.empty(0), {}
    for channel in record.outputs:
        time, values = record.samples(channel)
        if not len(grid):
            grid, signals[channel] = on_grid(time, values)
        signals[channel] = np.interp(grid, time, values)
    dt = float(grid[1] - grid[0])
    noise = {c: channel_noise(*record.samples(c)).sigma_floor for c in signals}
    hip, hip_jump = _slopes(signals['hip_angle'], span, dt, noise['hip_angle'])
    if 'imu_rate' in signals:
        inner, inner_jump = _ends(signals['imu_rate'], span, noise['imu_rate'])
    else:
        inner, inner_jump = _slopes(signals['imu_angle'], span, dt, noise['imu_angle'])
    q_inner = signals['imu_angle']
    return _Sides(
        grid,
        np.column_stack([q_inner, q_inner - signals['hip_angle']]),
        np.column_stack([inner, inner - hip]),
        np.maximum(hip_jump, inner_jump),
    )


def _slopes(values, span: int, dt: float, noise: float) -> tuple[np.ndarray, np.ndarray]:
    """Slope before each sample, and its jump there over the noise."""
    return _edges(values, span, noise, order=1, scale=1 / dt)


def _ends(values, span: int, noise: float) -> tuple[np.ndarray, np.ndarray]:
    """Value before each sample, and its jump there over the noise."""
    return _edges(values, span, noise, order=0, scale=1.0)


def _edges(values, span, noise, order, scale) -> tuple[np.ndarray, np.ndarray]:
    # A sample on each side is left out: a landing takes a moment.
    at = np.arange(span) + 1.5
    weights = np.linalg.pinv(np.vander(at, 3, increasing=True))[order] * scale
    sign = -1.0 if order else 1.0
    before, after = np.full(len(values), np.nan), np.full(len(values), np.nan)
    first, last = span + 1, len(values) - span - 1
    windows = np.lib.stride_tricks.sliding_window_view(values, span)
    before[first:last] = windows[: last - first] @ (sign * weights[::-1])
    after[first:last] = windows[first + 1 : last + 1] @ weights
    sigma = max(noise, 1e-9) * np.sqrt(2.0) * float(np.linalg.norm(weights))
    return before, np.nan_to_num(np.abs(after - before) / sigma)


def _lands(sides: _Sides, k: int, stance: str, leg_length: float) -> float | None:
    """Slope of the ground if this can be a landing of the swing foot; None if it cannot."""
    standing = STANCES.index(stance)
    lean, swing = sides.q[k, standing], sides.q[k, 1 - standing]
    slope, half = (lean + swing) / 2, (lean - swing) / 2
    # The swing foot's height over that slope falls by l sin(half) times the sum of the rates.
    falls = np.sign(half) * sides.before[k].sum() > 0
    apart = 2 * leg_length * abs(np.sin(half)) > SHORTEST_STEP
    return float(slope) if falls and apart and abs(slope) < STEEPEST else None


class Pieces:
    """Short pieces of a record, and how well a model explains them about either foot.

    Args:
        record: The record.
        model: The model.
    """

    def __init__(self, record: Record, model: Model):
        self.record, self.model = record, model
        self.sigma = noise_floor(model, [record])
        self.time = record.time

    def misfit(self, stance: str, start: float, stop: float) -> float:
        """chi2/N of the model, its start free, from start to stop in s.

        Infinite where it runs away, NaN where there is too little to say.
        """
        rows = (self.time >= start) & (self.time < stop)
        outputs = {
            c: v[rows] for c, v in self.record.outputs.items() if np.isfinite(v[rows]).any()
        }
        seen = (np.isfinite(outputs.get(c, np.empty(0))).sum() for c in NEEDED)
        if min(seen) < FEWEST_IN_STRETCH:
            return np.nan
        piece = replace(
            self.record,
            stamp_ns=self.record.stamp_ns[rows],
            inputs={c: v[rows] for c, v in self.record.inputs.items()},
            outputs=outputs,
            setup=replace(self.record.setup, stance=stance),
        )
        data_set = as_data_set(self.model.mechanism, piece, self.sigma)
        compiled = compile_model(self.model, data_set.setup)
        p, u = (
            parameter_vector(self.model, data_set.setup),
            data_set.inputs_for(compiled.input_names),
        )
        columns = np.full(len(compiled.free), -1)
        motion, belief = data_set.motion, np.diag(1 / data_set.motion_sigma**2)
        # So short a motion depends on its start almost linearly.
        for _ in range(ITERATIONS):
            x0, by_motion, _ = compiled.initial_sensitivity(motion, u[0], p)
            normal, _, _ = compiled.normal(
                data_set.time, u, x0, by_motion, p, columns, data_set.outputs, 1 / data_set.sigma
            )
            if normal.rows < len(data_set.time) or not np.isfinite(normal.hessian).all():
                return np.inf
            error = float(normal.sse.sum() / normal.count.sum())
            away = data_set.motion - motion
            motion = motion - np.linalg.solve(
                normal.hessian + belief, normal.gradient - belief @ away
            )
        return error
