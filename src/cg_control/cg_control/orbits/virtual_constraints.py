"""Virtual constraints: the swing leg is a function of the stance leg (hybrid zero dynamics).

On an orbit whose stance leg only moves forward the swing angle is h(q_st), one function for each
leg that stands. The torque makes what differs from it die out as that of a spring and damper:

    y = q_sw - h(q_st),   d2y/dt2 = -w^2 y - 2 w dy/dt                                 (VC)

No clock and no phase are in it. theory.md, "Virtual constraints", has what follows from it.
"""

import functools
from dataclasses import dataclass

import casadi as ca
import numpy as np
import scipy

from cg_control.friction import friction_parameters, friction_torque
from cg_control.trajectories.collocation import planning_model
from cg_control.trajectories.trajectory import Phase, Trajectory, TrajectoryError
from cg_dynamics.assemble import parameter_vector
from cg_dynamics.model import Model
from cg_dynamics.rig import STANCES, Setup
from cg_dynamics.rollout.compiled import CompiledModel, compile_model

BANDWIDTH = 20.0  # 1/s
LEAST_GRIP = 0.05  # of what 1 N m does to d2y/dt2 on the orbit: below this the torque is nothing


@dataclass(frozen=True)
class Constraint:
    """h of one stance leg.

    Attributes:
        h: Swing angle over stance angle, twice differentiable, rad.
        slope: dh/dq_st.
        curvature: d2h/dq_st^2, 1/rad.
        begin: Stance angle at which the phase begins, rad; before it h is straight,
        end: and likewise beyond the angle at which it ends.
    """

    h: scipy.interpolate.BPoly
    slope: scipy.interpolate.BPoly
    curvature: scipy.interpolate.BPoly
    begin: float
    end: float

    @classmethod
    def of(cls, phase: Phase) -> 'Constraint':
        """The constraint that a phase keeps, exact at its knots.

        Raises:
            TrajectoryError: The stance leg does not move forward all the time.
        """
        st = STANCES.index(phase.stance)
        angle, forward = phase.states[:, st], phase.states[:, 2 + st]
        if not (forward > 0).all():
            raise TrajectoryError(
                f'the {phase.stance} leg stops or turns back: its angle tells no phase'
            )
        slope = phase.states[:, 3 - st] / forward
        curvature = (phase.rates[:, 3 - st] - slope * phase.rates[:, 2 + st]) / forward**2
        knots = np.column_stack([phase.states[:, 1 - st], slope, curvature])
        h = scipy.interpolate.BPoly.from_derivatives(angle, knots)
        return cls(h, h.derivative(), h.derivative(2), float(angle[0]), float(angle[-1]))

    def at(self, angle: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """h, dh/dq_st and d2h/dq_st^2 at stance angles (n,), rad."""
        within = np.clip(angle, self.begin, self.end)
        slope = self.slope(within)
        inside = within == angle
        return (
            self.h(within) + slope * (angle - within), slope, self.curvature(within) * inside,
        )  # fmt: skip


class VirtualConstraints:
    """The torque that keeps the virtual constraints of an orbit.

    Args:
        trajectory: Phases, one of each leg.
        model: The robot: its torque limit, and the friction that is given back.
        bandwidth: w of (VC), 1/s.

    Raises:
        TrajectoryError: if a stance leg does not move forward all the time, or the torque cannot
            move the output somewhere.
    """

    def __init__(self, trajectory: Trajectory, model: Model, bandwidth: float = BANDWIDTH):
        trajectory.require_model(model)
        self.constraints = {phase.stance: Constraint.of(phase) for phase in trajectory.phases}
        self.bandwidth, self.limit = bandwidth, model.torque_limit
        self.design = planning_model(model, friction=False)
        self._friction, self._friction_p = friction_torque(model), friction_parameters(model)
        for phase in trajectory.phases:
            idle, pushed = self._rates(phase.stance, phase.states)
            grip = _grip(phase.stance, self._slope(phase.stance, phase.states), pushed - idle)
            if np.abs(grip).min() < LEAST_GRIP or np.ptp(np.sign(grip)):
                raise TrajectoryError(
                    f'on the {phase.stance} leg there is a point where the torque cannot move '
                    'the swing leg against its constraint'
                )

    def output(self, stance: str, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Y in rad and dy/dt in rad/s at states (n, 4), shape (n,) each."""
        st = STANCES.index(stance)
        h, slope, _ = self.constraints[stance].at(x[:, st])
        return x[:, 1 - st] - h, x[:, 3 - st] - slope * x[:, 2 + st]

    def demanded(
        self, stance: str, x: np.ndarray, idle: np.ndarray, pushed: np.ndarray
    ) -> np.ndarray:
        """The torque of (VC), neither limited nor with friction, N m, shape (n,).

        Args:
            stance: Leg that stands.
            x: States, shape (n, 4).
            idle: dx/dt there without torque, shape (n, 4).
            pushed: dx/dt there with 1 N m, shape (n, 4).
        """
        st = STANCES.index(stance)
        h, slope, curvature = self.constraints[stance].at(x[:, st])
        y, dy = x[:, 1 - st] - h, x[:, 3 - st] - slope * x[:, 2 + st]
        wanted = -(self.bandwidth**2) * y - 2 * self.bandwidth * dy
        drift = idle[:, 3 - st] - slope * idle[:, 2 + st] - curvature * x[:, 2 + st] ** 2
        grip = _grip(stance, slope, pushed - idle)
        # Far from the orbit the torque may lose its grip: what is left is bounded by the limit.
        grip = np.copysign(np.maximum(np.abs(grip), LEAST_GRIP), grip)
        return (wanted - drift) / grip

    def torque(self, stance: str, x: np.ndarray) -> float:
        """Hip torque in N m at a state (4,): limited, with friction given back."""
        row = np.asarray(x, float)[None, :4]
        u = self.demanded(stance, row, *self._rates(stance, row)).item()
        angle, rate = row[0, 0] - row[0, 1], row[0, 2] - row[0, 3]
        u += float(self._friction(angle, rate, self._friction_p))
        return min(max(u, -self.limit), self.limit)

    def command(self, t: float, stance: str, x: np.ndarray) -> np.ndarray:
        """`torque` as `walk` asks for it, shape (1,)."""
        return np.array([self.torque(stance, x)])

    def _slope(self, stance: str, x: np.ndarray) -> np.ndarray:
        return self.constraints[stance].at(x[:, STANCES.index(stance)])[1]

    def _rates(self, stance: str, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """dx/dt at states (n, 4) without torque and with 1 N m, (n, 4) each."""
        setup = Setup(stance=stance)
        function = _function(compile_model(self.design, setup))
        p = parameter_vector(self.design, setup)
        idle, pushed = (np.asarray(function(x.T, u, p)).T for u in (0.0, 1.0))
        return idle, pushed


def _grip(stance: str, slope: np.ndarray, by_torque: np.ndarray) -> np.ndarray:
    """What 1 N m does to d2y/dt2, shape (n,)."""
    st = STANCES.index(stance)
    return by_torque[:, 3 - st] - slope * by_torque[:, 2 + st]


@functools.cache
def _function(compiled: CompiledModel) -> ca.Function:
    e = compiled.equations
    return ca.Function('rates', [e.x, e.u, e.p], [ca.densify(e.rates)])
