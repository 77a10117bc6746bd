"""Following a trajectory: u = u0(s) - K(s) (x - x0(s)), and what happens around an impact.

The clock of TVLQR is its weakness (thesis, 4.5): gains and reference belong to an instant, and
if the robot lands earlier or later they belong to the wrong leg. The remedies differ in s:

    clock   s = t, whatever leg stands: the plain controller; it can meet positive feedback
    blank   s = t, no feedback within `window` of a nominal impact: the thesis's remedy
    event   the phase is that of the leg that stands; at the impact s jumps to the nominal one.
            Until a late impact the reference goes on as the model would
    phase   as event, and s follows the robot: it runs faster or slower towards the point of the
            reference that is closest in the metric of the cost to go

After the end the balance controller of the last leg takes over.
"""

import math
from dataclasses import dataclass

import numpy as np

from cg_control.collocation import planning_model
from cg_control.friction import FrictionCompensation
from cg_control.trajectory import Phase, Trajectory
from cg_dynamics.assemble import parameter_vector
from cg_dynamics.compiled import compile_model
from cg_dynamics.model import Model
from cg_dynamics.rig import STANCES, Setup
from cg_dynamics.settings import Settings, setting

REMEDIES = ('clock', 'blank', 'event', 'phase')
LATE_KNOT = 0.01  # s between knots of the reference beyond a late impact


@dataclass(frozen=True)
class TrackingSettings(Settings):
    """How a trajectory is followed."""

    remedy: str = setting(
        'event', 'what is done about impacts off their time', choices=REMEDIES, live=True
    )
    window: float = setting(
        0.08, 'blank: time before and after a nominal impact without feedback', unit='s',
        minimum=0.0, maximum=1.0, live=True,
    )  # fmt: skip
    late: float = setting(
        0.3, 'event, phase: how long the reference goes on while an impact is late', unit='s',
        minimum=0.0, maximum=1.0, live=True,
    )  # fmt: skip
    pull: float = setting(
        5.0, 'phase: rate at which the phase is drawn to the closest point', unit='1/s',
        minimum=0.0, maximum=100.0, live=True,
    )  # fmt: skip
    fastest: float = setting(
        2.0, 'phase: largest rate of the phase, and the inverse of the least', minimum=1.0,
        maximum=10.0, live=True,
    )  # fmt: skip
    feedback: bool = setting(True, 'off: the nominal torque alone, played back', live=True)


class Tracker:
    """A trajectory under feedback. The same object runs in the nodes, the benches and the tests.

    Args:
        trajectory: With gains.
        model: The robot as the controller knows it: its torque limit, its friction, and the motion
            of the reference beyond a late impact.
        balance: Gain of the balance controller on the last leg, shape (4,); None takes the last
            gain of the trajectory.
        settings: May be replaced between steps.
    """

    def __init__(
        self,
        trajectory: Trajectory,
        model: Model,
        balance: np.ndarray | None = None,
        settings: TrackingSettings | None = None,
    ):
        trajectory.require_model(model)
        self.trajectory, self.settings = trajectory, settings or TrackingSettings()
        self.limit = model.torque_limit
        self.balance = trajectory.phases[-1].gains[-1] if balance is None else balance
        compensate = trajectory.provenance.get('friction') == 'to be compensated'
        self._friction = FrictionCompensation(model) if compensate else None
        self._phases = [
            _extended(phase, model, trajectory, self.settings.late)
            for phase in trajectory.phases[:-1]
        ] + [trajectory.phases[-1]]
        self.reset()

    def reset(self) -> None:
        """Begin anew at the next step."""
        self._index = 0
        self._begun: float | None = None
        self._last = 0.0
        self.s = self.trajectory.phases[0].start

    @property
    def done(self) -> bool:
        """Whether the end of the trajectory has been reached."""
        return self.s >= self.trajectory.phases[-1].end

    def torque(self, t: float, stance: str, x: np.ndarray) -> float:
        """Hip torque in N m; zero for a state that is not finite.

        Args:
            t: Any clock in s; the first call is the start of the trajectory.
            stance: The leg that stands.
            x: (q_inner, q_outer) and rates, shape (4,).
        """
        x = np.asarray(x, float)[:4]
        if not np.isfinite(x).all():
            return 0.0
        if self._begun is None:
            self._begun = self._last = t
        self._advance(t, stance, x)
        self._last = t
        if self.done:
            return self._limited(-float(self.balance @ x) + self._taken(x[2] - x[3]))
        point = self._phases[self._index].at(self.s)
        wanted = point.torque + self._taken(point.state[2] - point.state[3])
        if self.settings.feedback and not self._blanked():
            wanted -= float(point.gain @ (x - point.state))
        return self._limited(wanted)

    def _taken(self, rate: float) -> float:
        return self._friction.taken(rate) if self._friction else 0.0

    def _limited(self, torque: float) -> float:
        return min(max(torque, -self.limit), self.limit)

    def _blanked(self) -> bool:
        return self.settings.remedy == 'blank' and any(
            abs(self.s - t) <= self.settings.window for t in self.trajectory.impact_times
        )

    def _advance(self, t: float, stance: str, x: np.ndarray) -> None:
        """Move the phase on to the instant t."""
        phases = self.trajectory.phases
        elapsed = t - self._last
        if self.settings.remedy in ('clock', 'blank') or not self.settings.feedback:
            self.s = phases[0].start + t - (self._begun or 0.0)
            self._index = self.trajectory.index_at(self.s)
            return
        following = self._index + 1
        if following < len(phases) and stance == phases[following].stance:
            self._index, self.s = following, phases[following].start
            return
        rate = self._rate(x) if self.settings.remedy == 'phase' else 1.0
        self.s = min(self.s + rate * elapsed, self._phases[self._index].end)

    def _rate(self, x: np.ndarray) -> float:
        """ds/dt that brings the reference nearer to the closest point: Newton's step, limited."""
        phase = self._phases[self._index]
        point, step = phase.at(self.s), 1e-3
        ahead, behind = phase.at(self.s + step), phase.at(self.s - step)
        span = min(self.s + step, phase.end) - max(self.s - step, phase.start)
        tangent = (ahead.state - behind.state) / span
        S = point.cost_to_go
        # At rest every phase is equally close: there the clock alone counts.
        length = tangent @ S @ tangent + 1e-3 * np.trace(S)
        offset = tangent @ S @ (x - point.state) / length
        rate = 1.0 + self.settings.pull * offset
        return min(max(rate, 1 / self.settings.fastest), self.settings.fastest)


def _extended(phase: Phase, model: Model, trajectory: Trajectory, late: float) -> Phase:
    """A phase that goes on beyond its impact, as the model would under its last torque."""
    if late < LATE_KNOT:
        return phase
    planned = planning_model(model, trajectory.provenance.get('friction') == 'planned')
    setup = Setup(stance=phase.stance)
    compiled, p = compile_model(planned, setup), parameter_vector(planned, setup)
    n = math.ceil(late / LATE_KNOT)
    time, states, rates = [], [], []
    x, u = phase.states[-1].copy(), np.array([phase.torque[-1]])
    for k in range(1, n + 1):
        compiled.advance(x, u, p, LATE_KNOT / 5, 5)
        if np.abs(x[:2]).max() > 1.0:
            break
        time.append(phase.end + k * LATE_KNOT)
        states.append(x.copy())
        rates.append(np.asarray(compiled.f(x, u, p)).ravel())
    n = len(time)
    if n == 0:
        return phase
    return Phase(
        phase.stance,
        np.concatenate([phase.time, time]),
        np.vstack([phase.states, states]),
        np.vstack([phase.rates, rates]),
        np.concatenate([phase.torque, np.full(n, phase.torque[-1])]),
        np.vstack([phase.gains, np.tile(phase.gains[-1], (n, 1))]),
        np.concatenate([phase.cost_to_go, np.tile(phase.cost_to_go[-1], (n, 1, 1))]),
    )


def wrong_leg(trajectory: Trajectory, stance: str) -> str:
    """Why a trajectory cannot begin while this leg stands; empty if it can."""
    if stance not in STANCES:
        return f'stance is {stance!r}; allowed are {", ".join(STANCES)}'
    if stance != trajectory.modes[0]:
        return f'the trajectory begins on the {trajectory.modes[0]} leg, but {stance} stands'
    return ''
