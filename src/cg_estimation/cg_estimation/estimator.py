"""What all estimators share: the interface, the stamps, prediction and landing.

An estimator is asked once per measurement, in order,

    estimate = estimator.step(stamp_ns, torque, outputs, stance)

by the node, by a replay of a recording and by the tests: there is no other code path. The torque
is the one that the drive held since the stamp before. What can go wrong with samples is dealt with
here, by their stamps alone:

- a repeated stamp changes nothing; one older than the last is counted and ignored;
- a channel that is absent or not finite corrects nothing, the model goes on without it;
- a gap is predicted across; after a longer one than `longest_gap`, of all channels or of one of
  the angles, the estimate starts anew;
- an angle that jumps further than any motion does is left out; if the readings after it agree with
  it, its zero has moved (somebody took a new one), and the estimate starts anew;
- a new stance leg means that the swing foot has landed: the impact map (Eq. 4.11) acts on the
  estimate, then the equations are those of the other stance.
"""

import math
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from cg_dynamics.assemble import parameter_vector, stamped
from cg_dynamics.model import Model
from cg_dynamics.rig import STANCES, Setup
from cg_dynamics.rollout.compiled import compile_model
from cg_dynamics.walking.impact import impact
from cg_interfaces.stamps import NS_PER_S

RUNAWAY = 1e3  # rad, rad/s: no estimate of this robot is there
ANGLES = ('imu_angle', 'hip_angle')
FASTEST = 20.0  # rad/s: no angle of this robot changes faster
NOISE = 0.01  # rad by which a reading may be off besides
AGREED = 3  # readings in a row that make a jump a new zero

Outputs = Mapping[str, float]


@dataclass(frozen=True)
class Estimate:
    """What is believed at the instant of a measurement.

    Attributes:
        stamp_ns: The instant, ns.
        stance: Stance leg.
        x: (q_inner, q_outer), their rates, extra states of the model, shape (nx,), rad, rad/s.
        running: Time since the estimator started or started anew, s.
        blind: Time since the position that was longest not measured, s.
    """

    stamp_ns: int
    stance: str
    x: np.ndarray
    running: float
    blind: float


class Estimator(Protocol):
    """A state estimator of the compass gait."""

    state_names: tuple[str, ...]

    def step(
        self, stamp_ns: int, torque: float, outputs: Outputs, stance: str | None = None
    ) -> Estimate:
        """Take in one measurement.

        Args:
            stamp_ns: Instant of the measurement, ns.
            torque: Hip torque that the drive held since the last stamp, N m.
            outputs: Channel -> reading in SI units; channels may be absent or NaN.
            stance: Stance leg at that instant; None for the one before.
        """
        ...


class Phase:
    """The model while one leg stands, as numbers in, numbers out."""

    def __init__(self, model: Model, setup: Setup):
        self.compiled = compile_model(model, setup)
        self.p = parameter_vector(model, setup)
        self.channels = self.compiled.channels
        still, none = np.zeros(self.compiled.nx), np.zeros((1, self.compiled.nu))
        self.step = self.compiled.step_for(still, none, self.p)

    def inputs(self, torque: float, time: float) -> np.ndarray:
        """Inputs of the model, shape (nu,): switches are on, the time is set."""
        u = np.ones(self.compiled.nu)
        u[0] = torque
        return stamped(u, self.compiled.input_names, time)

    def advance(self, x: np.ndarray, u: np.ndarray, duration: float) -> None:
        """Integrate x in place with u held."""
        n = max(1, math.ceil(duration / self.step - 1e-6))
        self.compiled.advance(x, u, self.p, duration / n, n)

    def read(self, x: np.ndarray, u: np.ndarray) -> np.ndarray:
        """What the sensors would report, before any delay, shape (ny,)."""
        return self.compiled.read(x, u, self.p)


class StampedEstimator(ABC):
    """Base of the estimators: deals with stamps, absent channels, gaps and landings.

    A subclass moves `self._x` on in `_predict` and weighs a measurement in `_correct`.

    Args:
        model: Gives the impact map and where the coordinates are in the readings.
        setup: The set-up; its stance is the one at the start.
        longest_gap: Gap in s after which the estimate starts anew.
    """

    def __init__(self, model: Model, setup: Setup | None = None, longest_gap: float = 0.1):
        setup = setup or Setup()
        if model.mechanism.name != 'compass_gait' or setup.fixture != 'none':
            raise ValueError('an estimator is of a compass gait with both legs free')
        self.model, self.setup, self.longest_gap = model, setup, longest_gap
        self.phases = {s: Phase(model, replace(setup, stance=s)) for s in STANCES}
        self.state_names = self.phases[setup.stance].compiled.state_names
        self.channels = self.phases[setup.stance].channels
        self.ignored = 0  # samples older than the one before
        self.restarts = 0
        self.reset()

    def reset(self) -> None:
        """Forget everything but the count of restarts."""
        self.stance = self.setup.stance
        self._estimate: Estimate | None = None
        self._x = np.zeros(0)

    def step(
        self, stamp_ns: int, torque: float, outputs: Outputs, stance: str | None = None
    ) -> Estimate:
        """Take in one measurement: see `Estimator.step`."""
        y = np.array([outputs.get(channel, math.nan) for channel in self.channels])
        y[~np.isfinite(y)] = math.nan
        torque = torque if math.isfinite(torque) else 0.0
        stance = stance or self.stance
        last = self._estimate
        gap = 0.0 if last is None else (stamp_ns - last.stamp_ns) / NS_PER_S
        if last is None or abs(gap) > self.longest_gap:
            return self._start(stamp_ns, torque, y, stance)
        if gap <= 0.0:
            self.ignored += gap < 0.0
            return last
        if not self._believes(stamp_ns, y):
            return self._start(stamp_ns, torque, y, stance)
        self._predict(gap, torque)
        if stance != self.stance:
            self._land(stance)
        self._correct(y, gap)
        if not (np.abs(self._x[:4]) < RUNAWAY).all():
            return self._start(stamp_ns, torque, y, stance)
        return self._conclude(stamp_ns, y, last.running + gap)

    def _believes(self, stamp_ns: int, y: np.ndarray) -> bool:
        """Leave out angles that jump; False if one has a new zero, or was away for too long."""
        now = (stamp_ns - self._start_ns) / NS_PER_S
        for k, channel in enumerate(self.channels):
            if channel not in ANGLES or math.isnan(y[k]):
                continue
            if now - self._seen[channel] > self.longest_gap:
                return False
            jumps = self._jumps[channel]
            if _follows(y[k], now, *self._believed[channel]):
                jumps.clear()
                continue
            if jumps and not _follows(y[k], now, *jumps[-1]):
                jumps.clear()
            jumps.append((float(y[k]), now))
            if len(jumps) >= AGREED:
                return False
            y[k] = math.nan
        return True

    def _start(self, stamp_ns: int, torque: float, y: np.ndarray, stance: str) -> Estimate:
        """At the measured pose; of the rates only the one that the gyro tells is known."""
        self.restarts += self._estimate is not None
        self.stance = stance
        reading = dict(zip(self.channels, np.where(np.isnan(y), 0.0, y), strict=True))
        lean, hip = reading['imu_angle'], reading['hip_angle']
        rate = reading.get('imu_rate', 0.0)
        self._start_ns = stamp_ns
        self._seen = dict.fromkeys(self.channels, -math.inf)
        # Angle -> its last reading and when that was, s; readings that jumped since.
        self._believed: dict[str, tuple[float, float]] = {}
        self._jumps: dict[str, list[tuple[float, float]]] = {c: [] for c in ANGLES}
        # A stance leg that does not turn, a swing leg that goes with it.
        outer = rate if stance == 'inner' else 0.0
        self._begin(np.array([lean, lean - hip, rate, outer]), torque)
        return self._conclude(stamp_ns, y, 0.0)

    def _conclude(self, stamp_ns: int, y: np.ndarray, running: float) -> Estimate:
        now = (stamp_ns - self._start_ns) / NS_PER_S
        for channel, value in zip(self.channels, y, strict=True):
            if not math.isnan(value):
                self._seen[channel] = now
                self._believed[channel] = float(value), now
        blind = max(now - self._seen['imu_angle'], now - self._seen['hip_angle'])
        self._estimate = Estimate(stamp_ns, self.stance, self._x.copy(), running, blind)
        return self._estimate

    def forward(self, outputs: Outputs, late: Mapping[str, float]) -> Outputs:
        """Readings brought forward to the stamp by the rates that are believed now.

        Args:
            outputs: Channel -> reading.
            late: Channel -> age of a reading in s; only the hip angle can be late.
        """
        if not late or self._estimate is None:
            return outputs
        rate = self._x[2] - self._x[3]
        return {**outputs, 'hip_angle': outputs['hip_angle'] + late['hip_angle'] * rate}

    @abstractmethod
    def _begin(self, motion: np.ndarray, torque: float) -> None:
        """Set `self._x` from measured angles and first guesses of the rates, shape (4,)."""

    @abstractmethod
    def _predict(self, duration: float, torque: float) -> None:
        """Move `self._x` on by `duration` s during which the drive held `torque`."""

    @abstractmethod
    def _correct(self, y: np.ndarray, duration: float) -> None:
        """Weigh readings, shape (ny,), NaN where absent, `duration` s after the last ones."""

    def _land(self, stance: str) -> None:
        """The swing foot has landed and is stance now."""
        self._x[:4] = impact(self.model, self.stance, self._x).x_plus[:4]
        self.stance = stance


def _follows(value: float, now: float, before: float, then: float) -> bool:
    """Whether a motion leads from one angle in rad to another, instants in s."""
    return abs(value - before) <= FASTEST * (now - then) + NOISE


class ModelEstimator(StampedEstimator):
    """An estimator that predicts with the nonlinear model, its delays included."""

    @property
    def phase(self) -> Phase:
        """The equations of the present stance."""
        return self.phases[self.stance]

    def _begin(self, motion: np.ndarray, torque: float) -> None:
        phase = self.phase
        self._input_delay, self._output_delays, _ = phase.compiled.delays(phase.p)
        self._x = phase.compiled.initial_state(motion, phase.inputs(torque, 0.0), phase.p)
        self._now = 0.0
        # Torques on their way to the motor: (instant from which it acts, torque).
        self._acting, self._latched = torque, torque
        self._under_way: deque[tuple[float, float]] = deque()
        self._past: deque[tuple[float, np.ndarray]] = deque()
        self._remember()

    def _predict(self, duration: float, torque: float) -> None:
        if torque != self._latched:
            self._under_way.append((self._now + self._input_delay, torque))
            self._latched = torque
        end = self._now + duration
        while self._under_way and self._under_way[0][0] < end - 1e-9:
            instant, following = self._under_way.popleft()
            self._advance(max(0.0, instant - self._now))
            self._acting = following
        self._advance(end - self._now)

    def _advance(self, duration: float) -> None:
        if duration > 1e-9:
            self._flow(self.phase.inputs(self._acting, self._now), duration)
            self._now += duration

    def _flow(self, u: np.ndarray, duration: float) -> None:
        """Integrate with u acting."""
        self.phase.advance(self._x, u, duration)

    def _readings(self) -> np.ndarray:
        """What the sensors should report now, late as they are, shape (ny,)."""
        expected = self.phase.read(self._x, self.phase.inputs(self._latched, self._now))
        if not self._output_delays.any():
            return expected
        times = [time for time, _ in self._past] + [self._now]
        values = np.array([value for _, value in self._past] + [expected])
        late = self._now - self._output_delays
        return np.array(
            [np.interp(t, times, column) for t, column in zip(late, values.T, strict=True)]
        )

    def _remember(self) -> None:
        """Keep what the sensors should have reported, for those that report late."""
        if self._output_delays.any():
            u = self.phase.inputs(self._latched, self._now)
            self._past.append((self._now, self.phase.read(self._x, u)))
            while self._past[0][0] < self._now - self._output_delays.max() - self.longest_gap:
                self._past.popleft()


def replay(
    estimator: Estimator,
    stamps_ns: np.ndarray,
    torque: np.ndarray,
    outputs: Mapping[str, np.ndarray],
    stance: str | None = None,
) -> np.ndarray:
    """Run an estimator over a recording.

    Args:
        estimator: Steps through it.
        stamps_ns: Stamps of the rows, ns, shape (n,).
        torque: Torque that the drive latched at each row and held until the next, N m, shape (n,).
        outputs: Channel -> readings, NaN where there is none, shape (n,).
        stance: Stance leg throughout.

    Returns:
        States, shape (n, nx).
    """
    held = np.concatenate([[0.0], np.asarray(torque, float)[:-1]])
    columns = {channel: np.asarray(values, float) for channel, values in outputs.items()}
    return np.array(
        [
            estimator.step(
                int(stamp), float(held[k]), {c: v[k] for c, v in columns.items()}, stance
            ).x
            for k, stamp in enumerate(stamps_ns)
        ]
    )
