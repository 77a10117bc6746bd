"""Landings simulated beside what was measured: theory.md, (LANDFIT).

A landing is simulated from a moment before the touchdown, where the phase before it says how the
robot moves, through the touchdown and whatever bouncing and sliding the law of contact makes of
it, as long as it shows. Of each landing its own are that motion and the height of the ground it
meets; the law is common to all.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from cg_dynamics.assemble import parameter_vector
from cg_dynamics.effects.effect import ContactLaw
from cg_dynamics.errors import DynamicsError
from cg_dynamics.model import Model
from cg_dynamics.rig import Setup
from cg_dynamics.rollout.compiled import CompiledModel, compile_model
from cg_dynamics.walking.hybrid import Walk, WalkOptions, swing_foot, walk
from cg_interfaces.stamps import NS_PER_S
from cg_sysid.identification.data_set import as_data_set
from cg_sysid.stances.phases import Landing

BEFORE_S = 0.02  # s before the touchdown at which the simulation sets out
LEAD_S = 0.15  # of the phase before that, from which it knows the motion
SHORTEST_LEAD_S = 0.05
AFTER_S = 0.2  # s after the touchdown that are compared
NEXT_S = 0.01  # before the next touchdown
STEP_S = 0.002  # longest step of the simulation
# What the model's own numbers leave uncertain in the motion before a landing, rad and rad/s.
MOTION_SIGMA = np.array([2e-4, 2e-4, 3e-3, 3e-3])
SLOPE_SIGMA = 4e-3  # rad, of the ground under a single step
NUDGES = np.array([1e-5, 1e-5, 1e-4, 1e-4, 1e-5])
OWN = 5  # of each landing: two angles, two rates, the slope


@dataclass(frozen=True)
class Passage:
    """A landing made ready for simulation.

    Attributes:
        name: Name of its record, and the time of the touchdown.
        stance: Leg that stands before it.
        time: Rows in s from the start of the simulation, shape (n,).
        touchdown: Time of the touchdown on that axis.
        outputs: What was measured, NaN where there is no sample, shape (n, ny).
        torque_time: Instants in s from which each torque acts, shape (k,).
        torque: Held torques in N m, shape (k,).
        start: State from which it sets out, shape (nx,).
        centre: Belief about its own: angles and rates there, and the slope, shape (5,).
        root: Square root of the information of that belief: R'R, shape (5, 5).
        backwards: The swing foot lands behind the other one.
    """

    name: str
    stance: str
    time: np.ndarray
    touchdown: float
    outputs: np.ndarray
    torque_time: np.ndarray
    torque: np.ndarray
    start: np.ndarray
    centre: np.ndarray
    root: np.ndarray
    backwards: bool


def ready(model: Model, landings: Sequence[Landing], sigma: np.ndarray) -> list[Passage]:
    """The landings that can be simulated: the phase before them is known to near their end.

    Args:
        model: The model with all causes that were found in the phases.
        landings: The landings.
        sigma: Noise floor of each output, shape (ny,).
    """
    found = (_ready(model, landing, sigma) for landing in landings)
    return [passage for passage in found if passage is not None]


def _ready(model: Model, landing: Landing, sigma: np.ndarray) -> Passage | None:
    if landing.before is None:
        return None
    touchdown, record = landing.touchdown, landing.record
    begin = min(touchdown.time - BEFORE_S, landing.before[1])
    first = max(landing.before[0], begin - LEAD_S)
    stop = min(touchdown.time + AFTER_S, landing.end - NEXT_S)
    if begin - first < SHORTEST_LEAD_S or stop - touchdown.time < BEFORE_S:
        return None
    time = record.time
    rows = (time >= begin) & (time < stop)
    origin = float(time[rows][0])
    lead = record.slice(first, origin)
    lead = replace(lead, setup=replace(record.setup, stance=touchdown.stance))
    ahead = float(record.stamp_ns[rows][0] - lead.stamp_ns[0]) / NS_PER_S
    motion = _motion(model, as_data_set(model.mechanism, lead, sigma), ahead)
    if motion is None:
        return None
    start, covariance = motion
    body = model.mechanism
    outputs = np.column_stack(
        [record.outputs.get(c, np.full(len(time), np.nan))[rows] for c in body.outputs]
    )
    whole = np.zeros((OWN, OWN))
    whole[:4, :4] = covariance + np.diag(MOTION_SIGMA**2)
    whole[4, 4] = SLOPE_SIGMA**2
    late = compile_model(model, Setup(stance=touchdown.stance)).delays(
        parameter_vector(model, Setup())
    )[0]
    known = (time >= begin - late - STEP_S) & (time < stop)
    reach, _ = swing_foot(start[:2], touchdown.stance, model.values['leg_length'])
    return Passage(
        name=f'{record.name} at {touchdown.time:.2f} s',
        stance=touchdown.stance,
        time=time[rows] - origin,
        touchdown=touchdown.time - origin,
        outputs=outputs,
        torque_time=time[known] - origin + late,
        torque=record.inputs[body.inputs[0]][known],
        start=start,
        centre=np.concatenate([start[:4], [touchdown.slope]]),
        root=np.linalg.inv(np.linalg.cholesky(whole)),
        backwards=bool(reach < 0),
    )


def _motion(model: Model, data_set, after: float) -> tuple[np.ndarray, np.ndarray] | None:
    """State at the end of a data set, by a fit of its start, and the covariance of its motion."""
    compiled, p = compile_model(model, data_set.setup), parameter_vector(model, data_set.setup)
    u = data_set.inputs_for(compiled.input_names)
    none = np.full(len(compiled.free), -1)
    motion, belief = data_set.motion, np.diag(1 / data_set.motion_sigma**2)
    for _ in range(4):
        x0, by_motion, _ = compiled.initial_sensitivity(motion, u[0], p)
        normal, _, _ = compiled.normal(
            data_set.time, u, x0, by_motion, p, none, data_set.outputs, 1 / data_set.sigma
        )
        if normal.rows < len(data_set.time) or not np.isfinite(normal.hessian).all():
            return None
        away = data_set.motion - motion
        information = normal.hessian + belief
        motion = motion - np.linalg.solve(information, normal.gradient - belief @ away)
    # One row more, at which the data set ends.
    time, inputs = np.append(data_set.time, after), np.vstack([u, u[-1:]])

    def end(start: np.ndarray) -> np.ndarray:
        x0 = compiled.initial_state(start, u[0], p)
        return compiled.simulate(time, inputs, x0, p)[-1]

    try:
        state = end(motion)
        moved = np.column_stack(
            [(end(motion + d) - state)[:4] / d.max() for d in np.diag(NUDGES[:4])]
        )
    except DynamicsError:
        return None
    excess = max(1.0, float(normal.sse.sum() / normal.count.sum()))
    return state, excess * moved @ np.linalg.inv(information) @ moved.T


def simulate_passage(
    model: Model, passage: Passage, law: ContactLaw, own: np.ndarray
) -> np.ndarray:
    """Outputs at the rows of a landing, shape (n, ny).

    Args:
        model: The model.
        passage: The landing.
        law: How the ground receives the foot.
        own: Angles in rad, rates in rad/s, slope in rad, shape (5,).

    Raises:
        DynamicsError: if it runs away or jams.
    """
    x0 = passage.start.copy()
    x0[:4] = own[:4]

    compiled = compile_model(model, Setup(stance=passage.stance))
    p = parameter_vector(model, Setup())
    duration = float(passage.time[-1]) + 1e-6
    options = WalkOptions(
        slope=float(own[4]), step=STEP_S, sample_time=duration, fall_angle=np.pi,
        backwards=passage.backwards,
    )  # fmt: skip
    torques = list(zip(passage.torque_time, passage.torque, strict=True))
    done = walk(model, passage.stance, x0, duration, None, options, law, torques)
    return _outputs(compiled, p, done, passage)


def _outputs(compiled: CompiledModel, p: np.ndarray, done: Walk, passage: Passage) -> np.ndarray:
    _, delays, _ = compiled.delays(p)
    time = np.concatenate([arc.time for arc in done.arcs])
    states = np.concatenate([arc.states for arc in done.arcs])
    u = np.ones((len(passage.time), compiled.nu))
    acting = np.searchsorted(passage.torque_time, passage.time + 1e-9, side='right') - 1
    u[:, 0] = passage.torque[np.maximum(acting, 0)]
    y = np.empty(passage.outputs.shape)
    for delay in np.unique(delays):
        x = _between(time, states, passage.time - delay)
        read = np.asarray(compiled.h(x.T, u.T, p)).T
        late = delays == delay
        y[:, late] = read[:, late]
    return y


def _between(time: np.ndarray, states: np.ndarray, at: np.ndarray) -> np.ndarray:
    """States between the rows of a walk; the angles by cubics, whose slopes are the rates."""
    row = np.clip(np.searchsorted(time, at, side='right') - 1, 0, len(time) - 2)
    h = np.maximum(time[row + 1] - time[row], 1e-12)[:, None]
    s = np.clip((at - time[row])[:, None] / h, None, 1.0)
    a, b = states[row], states[row + 1]
    x = a + s * (b - a)
    d0, d1 = a[:, 2:4], b[:, 2:4]
    rise = b[:, :2] - a[:, :2]
    inside = a[:, :2] + s * (
        h * d0 + s * (3 * rise - h * (2 * d0 + d1) + s * (h * (d0 + d1) - 2 * rise))
    )
    # Before the start the robot moved on straight.
    x[:, :2] = np.where(s < 0, a[:, :2] + s * h * d0, inside)
    return x
