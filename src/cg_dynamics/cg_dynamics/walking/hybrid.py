"""Hybrid simulation: stance phases joined by impacts, each located in time.

The swing foot, relative to the stance foot, is at r = l (d(q_st) - d(q_sw)); over ground that
falls by `slope` ahead its height is

    phi(q) = r_z + r_x tan(slope)                                                (GUARD)

An impact is where phi falls through zero while the foot is ahead of the stance foot (behind it,
where the robot walks backwards). The legs are equally long, so phi also touches zero when they
pass each other: there the real robot has its feet retracted, and the guard must not fire. It
cannot: it asks for r_x > minimum_step.

A foot that lands sticks, unless the model's effects say otherwise (contact.py): then it may slide
or fly a little before it is held, and while friction holds it, it may begin to slide.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
import scipy

from cg_dynamics.assemble import parameter_vector, stamped
from cg_dynamics.effects.effect import ContactLaw
from cg_dynamics.errors import SimulationError
from cg_dynamics.model import Model
from cg_dynamics.rig import STANCES, Setup
from cg_dynamics.rollout.compiled import CompiledModel, compile_model
from cg_dynamics.walking.contact import FreeFoot, Ground, contact_law, free_foot, land, rebound
from cg_dynamics.walking.impact import Impact, other

# Instants are found to this many seconds: far below what a step of integration errs.
INSTANT = 1e-12
# A flight is looked at from so many seconds after its start on: there the foot is still down.
LIFTED = 1e-8

Command = Callable[[float, str, np.ndarray], np.ndarray]


@dataclass(frozen=True)
class WalkOptions:
    """How to walk.

    Attributes:
        slope: Fall of the ground ahead in rad, in the frame of the angles. A model with the effect
            `ground_slope` has its angles from the ground, so it wants 0 here.
        step: Runge-Kutta step in s.
        sample_time: Time from one command to the next in s; commands are held.
        minimum_step: Distance in m that the swing foot must be ahead for an impact.
        backwards: The robot walks backwards: its swing foot lands behind the other one.
        clearance: Retraction of the swing foot in m. Where the extended foot would be deeper in
            the ground, the real one scuffs. Infinite: feet pass through the ground.
        stop_on_scuff: End at the first scuff.
        fall_angle: Lean of the stance leg in rad that counts as a fall.
        swing_angle: Angle of the swing leg in rad that counts as one, too.
        largest_steps: End after so many impacts.
    """

    slope: float = 0.0
    step: float = 0.001
    sample_time: float = 0.002
    minimum_step: float = 0.02
    backwards: bool = False
    clearance: float = math.inf
    stop_on_scuff: bool = False
    fall_angle: float = 1.0
    swing_angle: float = math.inf
    largest_steps: int = 1000

    def __post_init__(self):
        for name in ('step', 'sample_time', 'clearance', 'fall_angle', 'swing_angle'):
            if not getattr(self, name) > 0:
                raise ValueError(f'{name} must be positive, got {getattr(self, name)}')
        if not abs(self.slope) < math.pi / 2:
            raise ValueError(f'slope must be within a quarter turn, got {self.slope} rad')


@dataclass(frozen=True)
class Event:
    """Something that happened at one instant.

    Attributes:
        kind: 'impact', 'scuff' or 'fall'; of the foot that stands 'bounce' (it lands again),
            'slip', 'stick' or 'lift' (it leaves the ground while sliding).
        time: In s.
        stance: Stance leg until then.
        x: State until then.
        impact: What an impact or a bounce did; None for other kinds.
        step_length: Distance in m from the old to the new stance foot along the ground, negative
            backwards; 0 for other kinds.
    """

    kind: str
    time: float
    stance: str
    x: np.ndarray
    impact: Impact | None = None
    step_length: float = 0.0


@dataclass(frozen=True)
class Arc:
    """One stance phase, or the part of one in which its foot sticks, slides or flies.

    Attributes:
        stance: The leg pair that stands.
        time: Instants in s, first and last included, shape (n,).
        states: States there, shape (n, nx).
        inputs: Torque that acts from each instant on, shape (n, nu), N m.
        mode: What the foot of that leg does: 'stick', 'slide' or 'flight'.
        foot: Its place from where it landed, in m, and its velocity in m/s, (x, z) each, shape
            (n, 4).
    """

    stance: str
    time: np.ndarray
    states: np.ndarray
    inputs: np.ndarray
    mode: str
    foot: np.ndarray


@dataclass(frozen=True)
class Walk:
    """A hybrid motion.

    Attributes:
        arcs: Stance phases, in order.
        events: What happened, in order.
        outcome: Why it ended: 'time', 'steps', 'fall' or 'scuff'.
    """

    arcs: tuple[Arc, ...]
    events: tuple[Event, ...]
    outcome: str

    @property
    def impacts(self) -> tuple[Event, ...]:
        """The impacts among the events."""
        return tuple(event for event in self.events if event.kind == 'impact')

    @property
    def stance(self) -> str:
        """Stance leg at the end."""
        return self.arcs[-1].stance

    @property
    def state(self) -> np.ndarray:
        """State at the end, shape (nx,)."""
        return self.arcs[-1].states[-1]

    @property
    def time(self) -> float:
        """End in s."""
        return float(self.arcs[-1].time[-1])


def swing_foot(q, stance: str, leg_length: float) -> tuple[float, float]:
    """Position (x, z) in m of the swing foot relative to the stance foot."""
    standing, swinging = (q[0], q[1]) if stance == 'inner' else (q[1], q[0])
    return (
        leg_length * (math.sin(standing) - math.sin(swinging)),
        leg_length * (math.cos(standing) - math.cos(swinging)),
    )


@dataclass
class Leg:
    """A stance phase while it is being simulated.

    Attributes:
        place: Of the foot from where it landed, in m; and `rate`, in m/s.
        sense: Sign of the slip of a foot that slides.
    """

    stance: str
    compiled: CompiledModel
    mode: str = 'stick'
    place: np.ndarray = field(default_factory=lambda: np.zeros(2))
    rate: np.ndarray = field(default_factory=lambda: np.zeros(2))
    sense: float = 0.0
    time: list[float] = field(default_factory=list)
    states: list[np.ndarray] = field(default_factory=list)
    inputs: list[np.ndarray] = field(default_factory=list)
    foot: list[np.ndarray] = field(default_factory=list)

    def add(self, t: float, x: np.ndarray, u: np.ndarray) -> None:
        """Keep an instant, its state and the inputs that act from it on."""
        self.time.append(t)
        self.states.append(x)
        self.inputs.append(u)
        self.foot.append(np.concatenate([self.place, self.rate]))

    def forget(self) -> None:
        """Keep nothing of what was so far."""
        for kept in (self.time, self.states, self.inputs, self.foot):
            kept.clear()

    def arc(self) -> Arc:
        """The phase as far as it was kept."""
        return Arc(
            self.stance, np.array(self.time), np.array(self.states), np.array(self.inputs),
            self.mode, np.array(self.foot),
        )  # fmt: skip


def walk(
    model: Model,
    stance: str,
    x0: np.ndarray,
    duration: float,
    command: Command | None = None,
    options: WalkOptions | None = None,
    law: ContactLaw | None = None,
    torques: Sequence[tuple[float, float]] = (),
) -> Walk:
    """Simulate until time is over, the robot falls, or enough steps are done.

    Args:
        model: A compass gait.
        stance: Stance leg at the start, 'inner' or 'outer'.
        x0: State at the start: (q_inner, q_outer) and rates, extra states optional.
        duration: In s.
        command: (time, stance, x) -> torque (1,), asked every `sample_time` and held; it acts
            late by the model's input delay. None: no torque. Extra inputs of effects are
            switches that are on, and the time.
        options: How to walk.
        law: How the ground receives a foot, instead of what the model's effects say.
        torques: Recorded torques instead of a command: instant in s from which each acts, in
            order, and its value in N m. Before the first, none does.

    Raises:
        SimulationError: if the state runs away.
    """
    walker = Walker(model, options or WalkOptions(), command, law)
    return walker.run(stance, np.asarray(x0, float), duration, torques)


class Walker:
    """A robot that walks: what happens from one instant to the next; arguments as in `walk`."""

    def __init__(
        self,
        model: Model,
        options: WalkOptions,
        command: Command | None,
        law: ContactLaw | None = None,
    ):
        self.model, self.options = model, options
        self.command = command
        self.compiled = {s: compile_model(model, Setup(stance=s)) for s in STANCES}
        self.p = parameter_vector(model, Setup())
        self.leg_length = model.values['leg_length']
        self.law, self.ground = law or contact_law(model), Ground(options.slope)
        self.ahead = -1.0 if options.backwards else 1.0
        self.tangent = math.tan(options.slope)
        self.step = min(options.step, *(c.largest_step for c in self.compiled.values()))
        self.delay = self.compiled['inner'].delays(self.p)[0]
        self._root = scipy.optimize.brentq  # loaded now: no landing must wait for it
        self.falls = False  # end the walk; `move` goes on, and would find them again and again
        self.events: list[Event] = []
        self.scuffed = False
        self.free: dict[str, FreeFoot] = {}
        self.asked: tuple[str, bytes, bytes] | None = None
        self.answer = math.inf

    def run(
        self,
        stance: str,
        x: np.ndarray,
        duration: float,
        torques: Sequence[tuple[float, float]] = (),
    ) -> Walk:
        """A whole walk: see `walk`."""
        compiled, self.falls = self.compiled[stance], True
        # Torques on their way: (instant at which it acts, torque).
        latches = [(instant, self.inputs(torque)) for instant, torque in torques]
        u = self.inputs(0.0)
        while latches and latches[0][0] <= INSTANT:
            u = latches.pop(0)[1]
        if len(x) != compiled.nx:
            x = compiled.initial_state(x[:4], u, self.p)
        leg, arcs, outcome = Leg(stance, compiled), [], 'time'
        t, tick = 0.0, 0
        while t < duration - INSTANT and outcome == 'time':
            if self.command is not None:
                wanted = self.command(t, leg.stance, x.copy())
                latches.append((t + self.delay, self.inputs(wanted)))
            tick += 1
            end = min(tick * self.options.sample_time, duration)
            while t < end - INSTANT and outcome == 'time':
                while latches and latches[0][0] <= t + INSTANT:
                    u = latches.pop(0)[1]
                until = min(end, latches[0][0]) if latches else end
                u = stamped(u, leg.compiled.input_names, t)
                steps = max(1, math.ceil((until - t) / self.step - 1e-9))
                t, x, event = self._one_step(leg, t, x, u, (until - t) / steps)
                if event is None:
                    continue
                self.events.append(event)
                outcome = self._outcome(event)
                if event.kind not in ('scuff', 'fall'):
                    leg.add(t, x, u)
                    arcs.append(leg.arc())
                    leg, x = self._after(event, leg, x, u)
        leg.add(t, x, u)
        return Walk((*arcs, leg.arc()), tuple(self.events), outcome)

    def stand(self, stance: str) -> 'Leg':
        """A stance phase that begins, its foot held."""
        return Leg(stance, self.compiled[stance])

    def move(
        self, leg: 'Leg', x: np.ndarray, u: np.ndarray, duration: float, begin: float | None = None
    ) -> tuple['Leg', np.ndarray]:
        """Move on with inputs held; nothing of it is kept but the end.

        Args:
            leg: The phase so far.
            x: State, shape (nx,).
            u: Inputs that act, shape (nu,).
            duration: In s.
            begin: Instant at which it begins in s, for the clocks of effects; None leaves them
                as they stand in u.

        Returns:
            The phase then, which may be another one, and its state.
        """
        t = 0.0
        while t < duration - INSTANT:
            if begin is not None:
                u = stamped(u, leg.compiled.input_names, begin + t)
            steps = max(1, math.ceil((duration - t) / self.step - 1e-9))
            t, x, event = self._one_step(leg, t, x, u, (duration - t) / steps)
            if event is not None and event.kind not in ('scuff', 'fall'):
                leg, x = self._after(event, leg, x, u)
            leg.forget()
        return leg, x

    def inputs(self, torque) -> np.ndarray:
        """The inputs (nu,) for a torque in N m: what effects ask for besides is on."""
        extra = self.compiled['inner'].nu - 1
        return np.concatenate([np.array(torque, float).reshape(1), np.ones(extra)])

    def _outcome(self, event: Event) -> str:
        if event.kind == 'fall' or (event.kind == 'scuff' and self.options.stop_on_scuff):
            return event.kind
        impacts = sum(e.kind == 'impact' for e in self.events)
        return 'steps' if impacts >= self.options.largest_steps else 'time'

    def _after(
        self, event: Event, leg: Leg, x: np.ndarray, u: np.ndarray
    ) -> tuple[Leg, np.ndarray]:
        """The phase that an event begins, and its state."""
        t = self.ground.tangent
        if event.impact is not None:
            landed = event.impact
            place = (leg.place @ t) * t
            if event.kind == 'impact':
                self.scuffed, place = False, np.zeros(2)
            rate = landed.landing_velocity
            if landed.mode != 'flight':
                rate = (rate @ t) * t
            new = Leg(
                landed.stance, self.compiled[landed.stance], landed.mode, place, rate,
                float(np.sign(rate @ t)),
            )  # fmt: skip
            return new, landed.x_plus.copy()
        # Sliding keeps the foot on the ground but for rounding: take that away.
        place, slip = (leg.place @ t) * t, (leg.rate @ t) * t
        if event.kind == 'lift':
            return Leg(leg.stance, leg.compiled, 'flight', place, slip), x
        if event.kind == 'slip':
            sense = -float(np.sign(self._force(leg, x, u) @ t))
            return Leg(leg.stance, leg.compiled, 'slide', place, np.zeros(2), sense), x
        return Leg(leg.stance, leg.compiled, 'stick', place), x

    def _force(self, leg: Leg, x: np.ndarray, u: np.ndarray) -> np.ndarray:
        return np.asarray(self._free(leg.stance).force(x, u, self.p)).ravel()

    def _free(self, stance: str) -> FreeFoot:
        if stance not in self.free:
            self.free[stance] = free_foot(self.model, stance)
        return self.free[stance]

    def _cone(self, leg: Leg, x: np.ndarray, u: np.ndarray) -> float:
        """How far inside the cone of friction the force on a held foot is, in N."""
        if math.isinf(self.law.friction):
            return math.inf
        # The end of one step is the start of the next.
        asked = (leg.stance, x.tobytes(), u.tobytes())
        if asked != self.asked:
            force = self._force(leg, x, u)
            self.asked = asked
            self.answer = float(
                self.law.friction * (force @ self.ground.normal) - abs(force @ self.ground.tangent)
            )
        return self.answer

    def _one_step(self, leg: Leg, t: float, x: np.ndarray, u: np.ndarray, h: float):
        """One Runge-Kutta step, cut short where something happens."""
        leg.add(t, x, u)
        after = self._stepper(leg, x, u)
        y = after(h)
        if not (np.abs(y) < 1e6).all():
            raise SimulationError(f'the state runs away at {t + h:.3f} s', t + h)
        start = np.concatenate([x, leg.place, leg.rate]) if leg.mode != 'stick' else x
        found = []
        for kind, value in self._guards(leg, u):
            first, early = start, 0.0
            if kind == 'bounce' and value(start) <= 0:
                early = min(LIFTED, h / 2)
                first = after(early)
            elif kind in ('slip', 'lift') and value(start) < 0:
                # A new torque, or a landing, asks for more than the ground can give.
                found.append((0.0, kind))
                continue
            if value(first) > 0 >= value(y):
                part = self._root(lambda s, value=value: value(after(s)), early, h, xtol=INSTANT)
                found.append((part, kind))
        nx = len(x)
        for part, kind in sorted(found):
            z = after(part)
            reach, _ = swing_foot(z, leg.stance, self.leg_length)
            if kind == 'impact' and self.ahead * reach <= self.options.minimum_step:
                continue
            if kind == 'scuff':
                if self.scuffed:
                    continue
                self.scuffed = True
            struck, length = None, 0.0
            if kind == 'impact':
                length = reach / math.cos(self.options.slope)
                moving = z[nx + 2 :] if leg.mode == 'slide' else None
                struck = land(self.model, leg.stance, z[:nx], self.law, self.ground, moving)
            elif kind == 'bounce':
                struck = rebound(
                    self.model, leg.stance, z[:nx], self.law, self.ground, z[nx + 2 :]
                )
            event = Event(kind, t + part, leg.stance, z[:nx], struck, length)
            leg.place, leg.rate = self._foot(leg, z, nx)
            return t + part, z[:nx], event
        leg.place, leg.rate = self._foot(leg, y, nx)
        return t + h, y[:nx], None

    def _foot(self, leg: Leg, y: np.ndarray, nx: int) -> tuple[np.ndarray, np.ndarray]:
        if leg.mode == 'stick':
            return leg.place, leg.rate
        return y[nx : nx + 2], y[nx + 2 :]

    def _stepper(self, leg: Leg, x: np.ndarray, u: np.ndarray) -> Callable[[float], np.ndarray]:
        """Time in s -> x then, with place and velocity of the foot behind it if it is free."""
        if leg.mode == 'stick':

            def pinned(part: float) -> np.ndarray:
                y = x.copy()
                leg.compiled.advance(y, u, self.p, part, 1)
                return y

            return pinned
        functions = self._free(leg.stance)
        move = functions.slide if leg.mode == 'slide' else functions.flight
        start = np.concatenate([x, leg.place, leg.rate])
        c, slope = self._grip(leg), self.options.slope
        return lambda part: np.asarray(move(start, u, self.p, part, c, slope)).ravel()

    def _grip(self, leg: Leg) -> float:
        return self.law.friction * leg.sense if leg.mode == 'slide' else 0.0

    def _guards(self, leg: Leg, u: np.ndarray):
        standing, nx = STANCES.index(leg.stance), leg.compiled.nx
        n, t = self.ground.normal, self.ground.tangent

        def height(x):
            reach, rise = swing_foot(x, leg.stance, self.leg_length)
            return rise + reach * self.tangent

        if leg.mode != 'flight':
            yield 'impact', height
            if math.isfinite(self.options.clearance):
                yield 'scuff', lambda x: height(x) + self.options.clearance
        if self.falls:
            yield 'fall', lambda x: self.options.fall_angle - abs(x[standing])
            if math.isfinite(self.options.swing_angle):
                yield 'fall', lambda x: self.options.swing_angle - abs(x[1 - standing])
        if leg.mode == 'stick' and math.isfinite(self.law.friction):
            yield 'slip', lambda x: self._cone(leg, x, u)
        elif leg.mode == 'slide':
            normal = self._free(leg.stance).normal_force
            grip, slope = self._grip(leg), self.options.slope
            yield 'stick', lambda y: leg.sense * (y[nx + 2 :] @ t)
            yield 'lift', lambda y: float(normal(y, u, self.p, grip, slope))
        elif leg.mode == 'flight':
            yield 'bounce', lambda y: y[nx : nx + 2] @ n


__all__ = [
    'Arc', 'Command', 'ContactLaw', 'Event', 'Leg', 'Walk', 'WalkOptions', 'Walker', 'other',
    'swing_foot', 'walk',
]  # fmt: skip
