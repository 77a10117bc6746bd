"""Plain identification of a robot: least squares of base parameters by the torques.

The rigid bodies are linear in their masses, first moments and inertias; rotor, viscous and dry
friction and a bias of every joint are linear too. What the motion does not tell apart is left to
the least norm. This is what the toolboxes of robot arms do.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np

from cg_dynamics.mechanisms.urdf import Urdf
from cg_dynamics.model import Model
from cg_dynamics.rig import Setup
from cg_sysid.identification.data_set import DataSet
from cg_sysid.identification.measured_motion import motion_of

CONDITION = 1e-8  # of singular values that count, of the largest
TURNING = 0.01  # rad/s or m/s, over which dry friction turns
RIGID = 'rigid bodies'
OWN = {  # of every joint, and where our model files have the same
    'rotor': ('rotor_inertia', 'inertia'),
    'viscous friction': ('viscous_friction', 'coefficient'),
    'dry friction': ('coulomb_friction', 'torque'),
    'bias': ('torque_bias', 'torque'),
}


@dataclass(frozen=True)
class LeastSquares:
    """What they say.

    Attributes:
        left: Relative residual error of each driven joint along motions held out.
        changed: 'TERM at JOINT' -> how much of the torques there is other than the model file
            says, as a share of what acts at any joint (root mean square).
    """

    left: np.ndarray
    changed: Mapping[str, float]


def least_squares(
    model: Model, train: Sequence[DataSet], held: Sequence[DataSet], turning: float = TURNING
) -> LeastSquares:
    """Fit a robot of a URDF to some motions, and judge it by others.

    Args:
        model: The robot as its file has it; no number of it is believed.
        train: Data sets to fit.
        held: Data sets held out.
        turning: Rate over which dry friction turns, rad/s or m/s.
    """
    body = model.mechanism
    assert isinstance(body, Urdf)
    n = len(body.coordinates)
    driven = [list(body.coordinates).index(joint) for joint in body.driven]
    regressor = _regressor(body)

    def system(data_sets: Sequence[DataSet]) -> tuple[np.ndarray, np.ndarray]:
        """Torques by each number, (rows, joints, numbers), and torques, (rows, joints)."""
        motions = [motion_of(model, d, body.inputs) for d in data_sets]
        place, rate, acceleration, inputs = (
            np.vstack([getattr(m, name) for m in motions if m is not None])
            for name in ('position', 'rate', 'acceleration', 'inputs')
        )
        k = len(place)
        acted = np.zeros((k, n))
        acted[:, driven] = inputs[:, : len(driven)]
        rigid = np.asarray(regressor.map(k)(place.T, rate.T, acceleration.T)).reshape(n, k, -1)
        own = np.zeros((n, k, len(OWN) * n))
        for j in range(n):
            turned = np.tanh(rate[:, j] / turning)
            own[j, :, len(OWN) * j : len(OWN) * (j + 1)] = np.column_stack(
                [acceleration[:, j], rate[:, j], turned, np.ones(k)]
            )
        return np.concatenate([rigid, own], 2).transpose(1, 0, 2), acted

    design, acted = system(train)
    flat = design.reshape(-1, design.shape[2])
    size = np.maximum(np.linalg.norm(flat, axis=0), 1e-12)
    found = np.linalg.pinv(flat / size, CONDITION) @ acted.ravel() / size
    design, acted = system(held)
    rest = (acted - design @ found)[:, driven]
    left = np.sqrt((rest**2).mean(0) / (acted[:, driven] ** 2).mean(0))
    bodies = _as_believed(body)
    by = design * (found - np.concatenate([bodies, _joints_as_believed(model)]))
    terms = {(RIGID, j): by[:, j, : len(bodies)].sum(1) for j in range(n)} | {
        (name, j): by[:, j, len(bodies) + len(OWN) * j + k]
        for j in range(n)
        for k, name in enumerate(OWN)
    }
    most = np.sqrt((acted**2).mean(0)).max()
    changed = {
        f'{name} at {body.coordinates[j]}': float(np.sqrt((term**2).mean()) / most)
        for (name, j), term in terms.items()
    }
    return LeastSquares(left, changed)


def _joints_as_believed(model: Model) -> np.ndarray:
    """OWN of each joint as the model file has them; zero what it does not have."""
    found = []
    for joint in model.mechanism.coordinates:
        for effect, parameter in OWN.values():
            there = [e for e in model.effects if e.name == effect and e.site == joint]
            found.append(model.values_of(there[0])[parameter] if there else 0.0)
    return np.array(found)


def _as_believed(body: Urdf) -> np.ndarray:
    """Ten numbers of each body, as the URDF has them."""
    p = {parameter.name: ca.DM(parameter.default) for parameter in body.parameters}
    found = []
    for carried in body._bodies:
        m, h, inertia = (np.asarray(ca.DM(x)) for x in carried.symbols(p))
        found.append([*m.ravel(), *h.ravel(), *np.diag(inertia), inertia[0, 1], inertia[0, 2],
                      inertia[1, 2]])  # fmt: skip
    return np.concatenate(found)


def _regressor(body: Urdf) -> ca.Function:
    """Torques by the ten numbers of each body, along (q, v, a)."""
    n = len(body.coordinates)
    q, v, a = (ca.SX.sym(name, n) for name in 'qva')
    linear = _Linear(body.description, body.driven)
    linear.numbers = p = ca.SX.sym('p', 10 * len(linear.moving))
    torque = linear.inverse_dynamics(q, v, a, {'gravity': ca.SX(9.81)}, body.up(Setup()))
    return ca.Function('regressor', [q, v, a], [ca.densify(ca.jacobian(torque, p))])


class _Linear(Urdf):
    """The robot with masses, first moments and inertias themselves as numbers."""

    numbers: ca.SX

    @property
    def _bodies(self):
        return [_LinearBody(self.numbers[10 * k : 10 * k + 10]) for k in range(len(self.moving))]

    @_bodies.setter
    def _bodies(self, bodies):
        self.numbers = ca.SX.zeros(10 * len(bodies))

    def _determined(self):
        return self.parameters


class _LinearBody:
    def __init__(self, p: ca.SX):
        self.p = p

    def parameters(self):
        """None that has a belief."""
        return ()

    def symbols(self, _):
        """Mass, first moment, inertia about the origin."""
        m, hx, hy, hz, xx, yy, zz, xy, xz, yz = ca.vertsplit(self.p)
        inertia = ca.vertcat(
            ca.horzcat(xx, xy, xz), ca.horzcat(xy, yy, yz), ca.horzcat(xz, yz, zz)
        )
        return m, ca.vertcat(hx, hy, hz), inertia
