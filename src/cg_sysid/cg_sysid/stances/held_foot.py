"""The part of a stance phase in which friction can hold the foot.

A gentle slide hides in noise for some time. Once the friction of the ground is known, so is where
the foot cannot have been held: where the force that would hold it leaves the cone.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from cg_dynamics.assemble import parameter_vector
from cg_dynamics.errors import DynamicsError
from cg_dynamics.model import Model
from cg_dynamics.rollout.compiled import compile_model
from cg_dynamics.walking.contact import Ground
from cg_dynamics.walking.unpinned import ground_reaction
from cg_sysid.identification.data_set import Trial
from cg_sysid.identification.unknowns import without_events
from cg_sysid.stances.phases import SHORTEST_S, longest_run

INSIDE = 0.97  # share of the cone that counts as held: the force is that of a fitted motion


def held_by_friction(
    model: Model,
    trials: Sequence[Trial],
    motions: Sequence[np.ndarray],
    friction: float,
    slope: float,
) -> list[Trial]:
    """The trials, each cut to its longest part in which friction holds the foot.

    Args:
        model: The model with what was found.
        trials: Stance phases; what is no phase of a step is not touched.
        motions: Fitted initial motion of each, its own values behind it.
        friction: Coefficient of the ground.
        slope: Fall of the ground ahead in rad, in the frame of the angles.

    Returns:
        Those of which enough is left.
    """
    model = without_events(model)
    found = (
        _held(model, trial, motion, friction, slope)
        for trial, motion in zip(trials, motions, strict=True)
    )
    return [trial for trial in found if trial is not None]


def _held(
    model: Model, trial: Trial, motion: np.ndarray, friction: float, slope: float
) -> Trial | None:
    if not trial.setup.may_step:
        return trial
    compiled, p = compile_model(model, trial.setup), parameter_vector(model, trial.setup)
    u = trial.inputs_for(compiled.input_names)
    x0 = compiled.initial_state(motion[:4], u[0], p)
    try:
        states = compiled.simulate(trial.time, u, x0, p)
    except DynamicsError:
        return None
    ground = Ground(slope)
    force = ground_reaction(model, trial.setup.stance, states, u)
    along, off = force @ ground.tangent, force @ ground.normal
    run = longest_run((off > 0) & (np.abs(along) < INSIDE * friction * off))
    if run is None or trial.time[run[1]] - trial.time[run[0]] < SHORTEST_S:
        return None
    first, last = run
    if (first, last) == (0, len(trial.time) - 1):
        return trial
    rows = slice(first, last + 1)
    return replace(
        trial,
        time=trial.time[rows] - trial.time[first],
        inputs=trial.inputs[rows],
        outputs=trial.outputs[rows],
        motion=states[first, :4],
        since=trial.since + float(trial.time[first]),
    )
