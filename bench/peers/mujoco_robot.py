"""The compass gait in MuJoCo, for its system-identification toolbox.

Two legs, the hip body that bisects them (a joint equality), the springs of the set-up, one motor.
By RK4 at the sample time it agrees with our simulator to 1e-7 rad without dry friction; with the
constraint of the dry friction softened as below, to a quarter of the noise with it.
"""

from collections.abc import Mapping

import mujoco
import numpy as np

from cg_dynamics.model import Model
from cg_dynamics.rig import Setup
from cg_sysid.identification.data_set import DataSet

CHANNELS = ('imu_angle', 'imu_rate', 'hip_angle')
# Constraint dry friction is linear below a slip rate and constant above; at this width and
# impedance it is closest to the model file's tanh(rate / 0.01 rad/s).
SLIP_RATE = 0.0152  # rad/s
IMPEDANCE = 0.001


def mjcf(model: Model, setup: Setup, step: float) -> str:
    """The nominal robot in a set-up; `lumps` puts the inertias in."""
    l = model.values['leg_length']
    standing = setup.stance
    swinging = 'outer' if standing == 'inner' else 'inner'
    free = setup.fixture == 'none'
    hooks, anchors, springs = {'inner': '', 'outer': ''}, '', ''
    for i, spring in enumerate(setup.springs):
        x, z = spring.anchor
        height = spring.point if spring.body == standing else spring.point - l
        anchors += f'<site name="anchor{i}" pos="{x} 0 {z}"/>'
        hooks[spring.body] += f'<site name="hook{i}" pos="0 0 {height}"/>'
        springs += (
            f'<spatial name="spring{i}" stiffness="{spring.stiffness}" '
            f'springlength="{spring.free_length}">'
            f'<site site="anchor{i}"/><site site="hook{i}"/></spatial>'
        )
    stance = '<joint name="stance" type="hinge" axis="0 1 0"/>' if free else ''
    lean = '<joint joint="stance" coef="1"/>' if free else ''
    body = '<inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>'
    return f"""
<mujoco>
  <option integrator="RK4" timestep="{step}" tolerance="1e-10">
    <flag contact="disable" autoreset="disable"/>
  </option>
  <compiler angle="radian" autolimits="true"/>
  <worldbody>
    {anchors}
    <body name="{standing}">{stance}{body}{hooks[standing]}
      <body name="hip" pos="0 0 {l}">{body}</body>
      <body name="load_{standing}">{body}</body>
      <body name="{swinging}" pos="0 0 {l}">
        <joint name="hip" type="hinge" axis="0 1 0"/>{body}{hooks[swinging]}
        <body name="load_{swinging}" pos="0 0 {-l}">{body}</body>
      </body>
      <body name="middle" pos="0 0 {l}">
        <joint name="middle" type="hinge" axis="0 1 0"/>{body}
      </body>
    </body>
  </worldbody>
  <tendon>
    {springs}
    <fixed name="{swinging}">{lean}<joint joint="hip" coef="1"/></fixed>
    {f'<fixed name="{standing}">{lean}</fixed>' if free else ''}
  </tendon>
  <equality>
    <joint joint1="middle" joint2="hip" polycoef="0 0.5 0 0 0" solref="-4e4 -400"
      solimp="0.9999 0.9999 0.001"/>
  </equality>
  <actuator>
    <general name="motor" joint="hip" gear="{-1 if standing == 'inner' else 1}"
      gaintype="fixed" gainprm="1" biastype="affine" biasprm="0 0 0"/>
  </actuator>
</mujoco>"""


def put_inertias(spec: mujoco.MjSpec, values: Mapping[str, float]) -> None:
    """Bodies that have these lumps, the masses a little above the least that they can have."""
    l, mt = values['leg_length'], values['total_mass']
    about = {'inner': (values['c1'] - values['c3']) * mt * l**2,
             'outer': (values['c2'] - values['c3']) * mt * l**2,
             'middle': 4 * values['c3'] * mt * l**2}  # fmt: skip
    moment = {'inner': -values['c4'] * mt * l, 'outer': -values['c5'] * mt * l,
              'middle': 4 * values['c6'] * mt * l}  # fmt: skip
    least = {name: moment[name] ** 2 / about[name] for name in about}
    slack = max(mt - sum(least.values()), 0.0)
    standing = spec.worldbody.first_body().name
    rest = mt
    for name, share in (('inner', 0.25), ('outer', 0.25), ('middle', 0.1)):
        mass = least[name] + share * slack + 1e-6
        above = moment[name] / mass
        put_body(spec.body(name), mass, above + (l if name == standing else 0.0),
             about[name] - mass * above**2)  # fmt: skip
        rest -= mass
    put_body(spec.body('hip'), max(rest, 1e-6), 0.0, 1e-9)
    for name in ('inner', 'outer'):
        put_body(spec.body(f'load_{name}'), 1e-9, 0.0, 1e-12)


def put_body(body: mujoco.MjsBody, mass: float, height: float, inertia: float) -> None:
    """Mass in kg, height of its centre in m above the body's origin, inertia about the centre."""
    body.explicitinertial = True
    body.mass, body.ipos, body.inertia = mass, [0, 0, height], [max(inertia, 1e-9)] * 3


def soften(compiled: mujoco.MjModel) -> mujoco.MjModel:
    """Dry friction that is linear below the slip rate: `solref` and `solimp` of its constraint."""
    dof = compiled.joint('hip').dofadr[0]
    level = compiled.dof_frictionloss[dof]
    if level > 0:
        softness = (1 - IMPEDANCE) / IMPEDANCE * compiled.dof_invweight0[dof]
        compiled.dof_solref[dof] = [-1, -level / SLIP_RATE * softness * IMPEDANCE]
        compiled.dof_solimp[dof] = [IMPEDANCE, IMPEDANCE, 0.001, 0.5, 2]
    return compiled


def start_of(model, data_set: DataSet, motion: np.ndarray) -> np.ndarray:
    """Initial state from the free coordinates and rates; a filter starts settled."""
    half = len(motion) // 2

    def joints(x):
        if half == 1:
            return [x[0], x[0] / 2]
        standing, swinging = x if data_set.setup.stance == 'inner' else x[::-1]
        return [standing, swinging - standing, (swinging - standing) / 2]

    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = joints(motion[:half]), joints(motion[half:])
    driven = model.actuator('motor')
    if driven.actnum[0]:
        data.act[driven.actadr[0]] = data_set.inputs[0, 0]
    for i in np.flatnonzero(model.actuator_history[:, 0]):
        n = model.actuator_history[i, 0]
        mujoco.mj_initCtrlHistory(model, data, i, None, np.full(n, data_set.inputs[0, 0]))
    state = np.empty(mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_FULLPHYSICS))
    mujoco.mj_getState(model, data, state, mujoco.mjtState.mjSTATE_FULLPHYSICS)
    return state


def channels_of(model, setup: Setup, state: np.ndarray) -> np.ndarray:
    """IMU angle and rate and hip angle, shape (n, 3), from states (n, 1 + nq + nv + ...)."""
    q, v = state[:, 1 : 1 + model.nq], state[:, 1 + model.nq : 1 + model.nq + model.nv]
    free = setup.fixture == 'none'
    standing, rate = (q[:, 0], v[:, 0]) if free else (0 * q[:, 0], 0 * v[:, 0])
    hip, hip_rate = q[:, int(free)], v[:, int(free)]
    if setup.stance == 'inner':
        return np.column_stack([standing, rate, -hip])
    return np.column_stack([standing + hip, rate + hip_rate, hip])
