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
from cg_sysid.identification.data_set import DataSet
from cg_sysid.identification.unknowns import without_events
from cg_sysid.stances.phases import SHORTEST_S, longest_run

INSIDE = 0.97  # share of the cone that counts as held: the force is that of a fitted motion


def held_by_friction(
    model: Model,
    data_sets: Sequence[DataSet],
    motions: Sequence[np.ndarray],
    friction: float,
    slope: float,
) -> list[DataSet]:
    """The data sets, each cut to its longest part in which friction holds the foot.

    Args:
        model: The model with what was found.
        data_sets: Stance phases; what is no phase of a step is not touched.
        motions: Fitted initial motion of each, its own values behind it.
        friction: Coefficient of the ground.
        slope: Fall of the ground ahead in rad, in the frame of the angles.

    Returns:
        Those of which enough is left.
    """
    model = without_events(model)
    found = (
        _held(model, data_set, motion, friction, slope)
        for data_set, motion in zip(data_sets, motions, strict=True)
    )
    return [data_set for data_set in found if data_set is not None]


def _held(
    model: Model, data_set: DataSet, motion: np.ndarray, friction: float, slope: float
) -> DataSet | None:
    if not data_set.setup.may_step:
        return data_set
    compiled, p = compile_model(model, data_set.setup), parameter_vector(model, data_set.setup)
    u = data_set.inputs_for(compiled.input_names)
    x0 = compiled.initial_state(motion[:4], u[0], p)
    try:
        states = compiled.simulate(data_set.time, u, x0, p)
    except DynamicsError:
        return None
    ground = Ground(slope)
    force = ground_reaction(model, data_set.setup.stance, states, u)
    along, off = force @ ground.tangent, force @ ground.normal
    run = longest_run((off > 0) & (np.abs(along) < INSIDE * friction * off))
    if run is None or data_set.time[run[1]] - data_set.time[run[0]] < SHORTEST_S:
        return None
    first, last = run
    if (first, last) == (0, len(data_set.time) - 1):
        return data_set
    rows = slice(first, last + 1)
    return replace(
        data_set,
        time=data_set.time[rows] - data_set.time[first],
        inputs=data_set.inputs[rows],
        outputs=data_set.outputs[rows],
        motion=states[first, :4],
        since=data_set.since + float(data_set.time[first]),
    )
