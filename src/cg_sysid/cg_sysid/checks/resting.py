"""Where a joint with dry friction may come to rest: anywhere that friction holds it.

At rest gravity and springs pull with K d at a distance d from the equilibrium, and friction takes
up to F of it, so that the joint may hang anywhere within F / K on either side. What a model calls
its friction does not matter here: it is half of what the acceleration jumps by where a rate
changes its sign.
"""

import casadi as ca
import numpy as np

from cg_dynamics.assemble import assemble, parameter_vector
from cg_dynamics.model import Model
from cg_dynamics.rig import Setup
from cg_sysid.identification.data_set import sensor_matrix

SLIDES = 0.05  # rad/s: faster than any smoothed friction needs, slow enough that nothing drags


def resting_band(model: Model, setup: Setup) -> dict[str, float]:
    """Half the width of the band in which each measured angle may rest, about the hanging pose.

    Args:
        model: The machine.
        setup: What is done to the rig.

    Returns:
        Output -> rad (m where the joint slides); only outputs that are coordinates. A joint that
        nothing pulls back is left out, as it may rest anywhere.
    """
    e, body = assemble(model, setup), model.mechanism
    m, size = e.coordinates, e.x.numel()
    f = ca.Function('a', [e.x, e.u, e.p], [e.rates[m : 2 * m]])
    stiffness = ca.Function('k', [e.x, e.u, e.p], [ca.jacobian(e.rates[m : 2 * m], e.x)[:, :m]])
    u, p = np.zeros(e.u.numel()), parameter_vector(model, setup)
    u[len(body.inputs) :] = 1.0  # a switch that is not recorded counts as on
    x = np.zeros(size)
    pull = np.asarray(stiffness(x, u, p))
    if not np.isfinite(pull).all() or np.linalg.cond(pull) > 1e8:
        return {}
    reach = np.zeros(m)
    for joint in range(m):
        slow = np.zeros(size)
        slow[m + joint] = SLIDES
        held = 0.5 * np.asarray(f(x + slow, u, p) - f(x - slow, u, p))[:, 0]
        reach += np.abs(np.linalg.solve(pull, held))
    sensors = np.abs(sensor_matrix(body, setup)[:, :m])
    return {
        name: float(row @ reach)
        for name, row, unit in zip(body.outputs, sensors, body.output_units, strict=True)
        if unit in ('rad', 'm')
    }
