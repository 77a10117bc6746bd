"""The simulated machine: a model with a fine integrator, held inputs, and real sensors.

It stands where the hardware would stand. Unlike the rollouts of identification it integrates at a
tenth of a millisecond or less, lets a delayed torque act at its exact instant, and reports what
sensors report: noisy, late, in counts. A compass gait that is not on blocks walks: its swing foot
lands (hybrid.py, (GUARD)), and the leg that stands changes; where its model says so, the foot
bounces and slides (contact.py).
"""

import bisect
import itertools
from collections.abc import Mapping
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np
import scipy

from cg_dynamics.assemble import parameter_vector, stamped
from cg_dynamics.errors import ModelError, SimulationError
from cg_dynamics.mechanisms.compass_gait import CompassGait
from cg_dynamics.model import Model
from cg_dynamics.rig import Setup
from cg_dynamics.rollout.compiled import compile_model
from cg_dynamics.walking.contact import contact_law
from cg_dynamics.walking.hybrid import INSTANT, Leg, Walker, WalkOptions, swing_foot
from cg_dynamics.walking.impact import impact, other

FINE_STEP = 1e-4
CONTACT_STEP = 5e-4  # where feet slide and fly, whose steps cost more and whose events are located


@dataclass(frozen=True)
class Measurement:
    """What the sensors report at one instant.

    Attributes:
        time_ns: Simulated time, integer nanoseconds from the start.
        outputs: Channel -> reported value: noisy, late, quantised; SI units.
        counts: Channel -> integer count, for the channels that have a resolution.
        applied: Torques that the drive has latched, N m, shape (nu,).
        contact: Leg -> vertical ground reaction in N (compass gait only).
        state: True state, for tests and plots; no sensor reports it.
    """

    time_ns: int
    outputs: dict[str, float]
    counts: dict[str, int]
    applied: np.ndarray
    contact: dict[str, float]
    state: np.ndarray


class Plant:
    """A simulated machine.

    Args:
        model: Its physics, with whatever effects it has.
        setup: What was done to the rig.
        initial_state: Free coordinates and their rates at the start, shape (2m,); the extra
            states of effects settle by themselves. None: all zero.
        sample_time: Time from one measurement to the next in s.
        seed: Of the sensor noise.
        minimum_step: Not on blocks: the swing foot lands only this far ahead, m.

    Raises:
        ModelError: Its drives follow positions; it is told torques here.

    Attributes:
        stance: The leg pair that stands now.
    """

    def __init__(
        self,
        model: Model,
        setup: Setup,
        initial_state: np.ndarray | None = None,
        sample_time: float = 0.002,
        seed: int = 0,
        minimum_step: float = 0.1,
    ):
        self.model, self.setup, self.stance = model, setup, setup.stance
        self._minimum_step = minimum_step
        self._walks = isinstance(model.mechanism, CompassGait) and not (
            setup.on_blocks or setup.springs or setup.fixture != 'none'
        )
        if self._walks:
            self._root = scipy.optimize.brentq  # loaded now: no landing must wait for it
        self.sample_ns = round(sample_time * 1e9)
        self._compiled = compile_model(model, setup)
        self._p = parameter_vector(model, setup)
        motion = np.zeros(2 * self._compiled.equations.coordinates)
        if initial_state is not None:
            motion = np.asarray(initial_state, float)
            if motion.shape != (2 * self._compiled.equations.coordinates,):
                names = self._compiled.state_names[: 2 * self._compiled.equations.coordinates]
                raise ValueError(
                    f'initial_state needs {len(names)} numbers ({", ".join(names)}), '
                    f'got shape {motion.shape}'
                )
        self._input_delay, self._output_delays, _ = self._compiled.delays(self._p)
        self._distinct_delays = set(self._output_delays) - {0.0}
        self._torques = len(model.mechanism.inputs)
        names = self._compiled.input_names
        told = [n for joint in model.mechanism.joints for n in model.mechanism.told(joint)]
        if told := [name for name in told if name in names]:
            raise ModelError(f'{model.name}: a simulated machine takes torques, not {told[0]}')
        self._applied = stamped(self._inputs(np.zeros(self._torques)), names, 0.0)
        self._latches: list[tuple[float, np.ndarray]] = [(-np.inf, self._applied)]
        self._x = self._compiled.initial_state(motion, self._applied, self._p)
        self._tick = 0
        self._past: list[tuple[float, np.ndarray]] = [(0.0, self._x.copy())]
        # One stream per channel: adding a channel must not change the noise of another.
        streams = np.random.SeedSequence(seed).spawn(len(self._compiled.channels))
        self._noise = [np.random.default_rng(stream) for stream in streams]
        self._jolt: ca.Function | None = None
        self._fine = min(FINE_STEP, self._compiled.largest_step / 4)
        self._walker: Walker | None = None
        self._leg: Leg | None = None
        if self._walks and not contact_law(model).plastic:
            options = WalkOptions(step=CONTACT_STEP, minimum_step=minimum_step)
            self._walker = Walker(model, options, None)
            self._leg = self._walker.stand(self.stance)

    @property
    def time(self) -> float:
        """Simulated time in s."""
        return self._tick * self.sample_ns * 1e-9

    @property
    def state(self) -> np.ndarray:
        """The true state now, shape (nx,)."""
        return self._x.copy()

    @property
    def state_names(self) -> tuple[str, ...]:
        """What the state holds, in order."""
        return self._compiled.state_names

    def place(self, angles: Mapping[str, float]) -> None:
        """Put the body somewhere, at rest there.

        Args:
            angles: Free coordinate, such as `q_outer`, -> its angle in rad; the others stay.
        """
        motion = np.zeros(2 * self._compiled.equations.coordinates)
        for k, name in enumerate(self.state_names[: len(motion) // 2]):
            motion[k] = angles.get(name, self._x[k])
        self._x = self._compiled.initial_state(motion, self._applied, self._p)
        self._past[-1] = (self._past[-1][0], self._x.copy())

    def latch(self, torque: np.ndarray) -> None:
        """Give the drive a new set-point in N m, shape (nu,); it holds until the next."""
        torque = np.array(torque, float)
        if torque.shape != (self._torques,) or not np.isfinite(torque).all():
            raise ValueError(f'torque must be {self._torques} finite numbers in N m, got {torque}')
        limit = self.model.torque_limit
        self._applied = self._inputs(np.clip(torque, -limit, limit))
        self._latches.append((self.time, self._applied))

    @property
    def _clock(self) -> float:
        # Effects see a clock that is held from sample to sample as the torque is. Its middle is
        # right to second order; a drifting sensor is read half a sample ahead.
        return self.time + self.sample_ns * 1e-9 / 2

    def _inputs(self, torque: np.ndarray) -> np.ndarray:
        # Extra inputs of the simulated machine are switches that are on; `stamped` sets the time.
        return np.concatenate([torque, np.ones(self._compiled.nu - self._torques)])

    def advance(self) -> None:
        """Move on by one sample time.

        Raises:
            SimulationError: if the state runs away.
        """
        start, end = self.time, (self._tick + 1) * self.sample_ns * 1e-9
        # The torque changes where a latch, late by the input delay, falls inside the interval.
        times = [t + self._input_delay for t, _ in self._latches]
        first = bisect.bisect_right(times, start + 1e-12) - 1
        edges = [start, *(t for t in times[first + 1 :] if t < end - 1e-12), end]
        for index, (begin, stop) in enumerate(itertools.pairwise(edges)):
            u = stamped(self._latches[first + index][1], self._compiled.input_names, self._clock)
            steps = max(1, int(np.ceil((stop - begin) / self._fine - 1e-9)))
            self._move(u, (stop - begin) / steps, steps)
        self._latches = self._latches[first:]
        self._tick += 1
        if not np.isfinite(self._x).all() or np.abs(self._x).max() > 1e4:
            raise SimulationError(f'the simulated machine runs away at {end:.3f} s', end)
        self._past.append((end, self._x.copy()))
        oldest = end - max(self._output_delays) - 2 * self.sample_ns * 1e-9
        while len(self._past) > 2 and self._past[1][0] <= oldest:
            self._past.pop(0)

    def _move(self, u: np.ndarray, step: float, steps: int) -> None:
        if self._walker is not None and self._leg is not None:
            self._leg, self._x = self._walker.move(self._leg, self._x, u, step * steps)
            if self._leg.stance != self.stance:
                self._stands_on(self._leg.stance)
            return
        before = self._x.copy()
        self._compiled.advance(self._x, u, self._p, step, steps)
        if not self._walks:
            return
        (reach, height), (reach_then, height_then) = self._foot(before), self._foot(self._x)
        # Legs that balance side by side pass each other all the time: none of that is a landing,
        # and each instant that is tried for one costs a step.
        if not height > 0 >= height_then or max(reach, reach_then) <= self._minimum_step:
            return
        duration = step * steps

        def after(part: float) -> np.ndarray:
            x = before.copy()
            self._compiled.advance(x, u, self._p, part / steps, steps)
            return x

        instant = self._root(lambda part: self._foot(after(part))[1], 0.0, duration, xtol=INSTANT)
        x = after(instant)
        if self._foot(x)[0] <= self._minimum_step:
            return
        landed = impact(self.model, self.stance, x)
        self._x = landed.x_plus
        self._stands_on(landed.stance)
        self._compiled.advance(self._x, u, self._p, (duration - instant) / steps, steps)

    def _stands_on(self, stance: str) -> None:
        self.stance = stance
        self._compiled = compile_model(self.model, replace(self.setup, stance=stance))
        self._jolt = None

    def _foot(self, x: np.ndarray) -> tuple[float, float]:
        # How far ahead the swing foot is and how high above the ground, m.
        return swing_foot(x, self.stance, self.model.values['leg_length'])

    def push(self, impulse: float) -> None:
        """Somebody hits the hip of a compass gait: the rates jump by M^-1 J' P at once.

        Args:
            impulse: Horizontal impulse P in N s, positive forward.
        """
        if self._jolt is None:
            e, stance = self._compiled.equations, self.stance
            m = e.coordinates
            q = e.x[:m]
            lean = q[self.model.mechanism.bodies.index(stance)]
            length = self.model.values['leg_length']
            jacobian = ca.jacobian(length * ca.sin(lean), q)
            jump = ca.solve(e.mass_matrix, jacobian.T)
            self._jolt = ca.Function('jolt', [e.x, e.p], [jump])
        m = self._compiled.equations.coordinates
        jolt = np.asarray(self._jolt(self._x, self._p)).ravel()
        self._x[m : 2 * m] += impulse * jolt
        self._past[-1] = (self._past[-1][0], self._x.copy())

    def measure(self) -> Measurement:
        """Read all sensors now."""
        outputs, counts = {}, {}
        clean = self._clean_outputs()
        for channel, value, stream in zip(
            self._compiled.channels, clean, self._noise, strict=True
        ):
            sensor = self.model.sensors.get(channel, {})
            if 'noise' in sensor:
                value += sensor['noise'].value * stream.standard_normal()
            if 'resolution' in sensor:
                counts[channel] = round(value / sensor['resolution'].value)
                value = counts[channel] * sensor['resolution'].value
            outputs[channel] = float(value)
        return Measurement(
            self._tick * self.sample_ns,
            outputs,
            counts,
            self._applied[: self._torques].copy(),
            self._contact(),
            self._x.copy(),
        )

    def _clean_outputs(self) -> np.ndarray:
        held, names = self._latches[-1][1], self._compiled.input_names
        u = stamped(held, names, self._clock)
        now = self._compiled.read(self._x, u, self._p)
        for delay in self._distinct_delays:
            late = self.time - delay
            u = stamped(held, names, late + self._clock - self.time)
            then = self._compiled.read(self._at(late), u, self._p)
            now = np.where(self._output_delays == delay, then, now)
        return now

    def _at(self, t: float) -> np.ndarray:
        # The state at an earlier instant: cubic through its two neighbours, rates from differences
        # of fine steps are not needed at sample times of milliseconds.
        times = [time for time, _ in self._past]
        u = self._latches[0][1]
        if len(times) == 1 or t <= times[0]:
            # The machine did not come into being at the first sample: it was moving on before.
            t0, x0 = self._past[0]
            return x0 + (t - t0) * np.asarray(self._compiled.f(x0, u, self._p)).ravel()
        i = min(max(bisect.bisect_right(times, t) - 1, 0), len(times) - 2)
        (t0, x0), (t1, x1) = self._past[i], self._past[i + 1]
        h, s = t1 - t0, (t - t0) / (t1 - t0)
        d0, d1 = (np.asarray(self._compiled.f(x, u, self._p)).ravel() for x in (x0, x1))
        r = 1 - s
        return (1 + 2 * s) * r**2 * x0 + (1 + 2 * r) * s**2 * x1 + h * s * r * (r * d0 - s * d1)

    def _contact(self) -> dict[str, float]:
        if self.model.mechanism.name != 'compass_gait':
            return {}
        weight = self.model.values['total_mass'] * self.model.values['gravity']
        # A switch, not a force plate: the stance foot carries the weight, dynamics left out.
        return {self.stance: weight, other(self.stance): 0.0}
