"""The compass gait walking in MuJoCo: contact by an engine that is not ours.

Two legs hang from a hip that moves freely in the plane; feet are small spheres, the ground is a
plane, both are soft for a fraction of a millisecond, and friction is Coulomb's. Nothing is shared
with cg_dynamics but the meaning of signs and angles. As the legs cannot bend, the foot that swings
touches nothing until it is ahead and comes down, and the foot that was left is lifted at once.
"""

import math
from collections.abc import Callable, Mapping

import mujoco
import numpy as np
from mujoco_robot import NEGLIGIBLE, _legs

RADIUS = 5e-4
STEP = 5e-5
# Time constant in s and damping ratio of the ground. Critical damping would be enough for a spring
# and a mass; this contact then throws a foot up with a tenth of its speed.
PLASTIC = (5e-4, 8.0)


class MujocoWalker:
    """A walking robot.

    Args:
        values: leg_length, total_mass, gravity, c1 .. c6 with c3 and c6 negligible.
        stance: Leg that stands.
        motion: (q_inner, q_outer) in rad and rates in rad/s, the stance foot at rest.
        slope: Fall of the ground ahead in rad; angles are from the vertical.
        friction: Coefficient of the ground.
        hip_friction: Rate of the hip angle in rad/s -> torque in N m.
        payload: (leg, mass, distance from its foot), or None.
        solref: Time constant in s and damping ratio of the ground.
    """

    def __init__(
        self,
        values: Mapping[str, float],
        stance: str,
        motion,
        slope: float = 0.0,
        friction: float = 2.0,
        hip_friction: Callable[[float], float] | None = None,
        payload: tuple[str, float, float] | None = None,
        solref: tuple[float, float] = PLASTIC,
    ):
        if abs(values['c3']) > NEGLIGIBLE or abs(values['c6']) > NEGLIGIBLE:
            raise ValueError('c3 and c6 must be negligible')
        self.l, self.slope, self.stance = values['leg_length'], slope, stance
        self.hip_friction = hip_friction or (lambda rate: 0.0)
        text = _mjcf(values, slope, friction, payload, solref)
        self.model = mujoco.MjModel.from_xml_string(text)
        self.data = mujoco.MjData(self.model)
        self.geom = {
            leg: mujoco.mj_name2id(self.model, mujoco.mjtObj.mjOBJ_GEOM, leg)
            for leg in ('inner', 'outer')
        }
        q, v = np.asarray(motion[:2], float), np.asarray(motion[2:], float)
        a, w = (q[0], v[0]) if stance == 'inner' else (q[1], v[1])
        # The bottom of the sphere touches the ground.
        up = RADIUS * np.array([math.sin(slope), math.cos(slope)])
        hip = self.l * np.array([math.sin(a), math.cos(a)]) + up
        self.data.qpos[:] = [*hip, *q]
        self.data.qvel[:] = [self.l * w * math.cos(a), -self.l * w * math.sin(a), *v]
        self.landings: list[float] = []
        self._touch(stance)
        mujoco.mj_forward(self.model, self.data)

    def _touch(self, leg: str, also: str | None = None) -> None:
        for name, geom in self.geom.items():
            self.model.geom_contype[geom] = int(name in (leg, also))
            self.model.geom_conaffinity[geom] = int(name in (leg, also))

    def foot(self, leg: str) -> tuple[np.ndarray, np.ndarray]:
        """Place and velocity of a foot (x, z)."""
        i = 2 if leg == 'inner' else 3
        a, w = self.data.qpos[i], self.data.qvel[i]
        place = self.data.qpos[:2] - self.l * np.array([math.sin(a), math.cos(a)])
        return place, self.data.qvel[:2] - self.l * w * np.array([math.cos(a), -math.sin(a)])

    def advance(self, torque: float, duration: float) -> None:
        """Move on with a torque held."""
        steps = max(1, math.ceil(duration / STEP - 1e-9))
        self.model.opt.timestep = duration / steps
        n = np.array([math.sin(self.slope), math.cos(self.slope)])
        for _ in range(steps):
            rate = self.data.qvel[2] - self.data.qvel[3]
            total = torque + self.hip_friction(rate)
            self.data.qfrc_applied[2:] = [total, -total]
            swing = 'outer' if self.stance == 'inner' else 'inner'
            (place, velocity), (stand, _) = self.foot(swing), self.foot(self.stance)
            height = (place - stand) @ n
            comes = place[0] - stand[0] > 0.05 and velocity @ n < 0 and height < 2e-3
            self._touch(self.stance, swing if comes and height > -1e-3 else None)
            mujoco.mj_step(self.model, self.data)
            if any(self.geom[swing] in pair for pair in self.data.contact.geom):
                self.landings.append(self.data.time)
                self.stance = swing
                self._touch(swing)

    @property
    def state(self) -> np.ndarray:
        """(q_inner, q_outer) and rates."""
        return np.concatenate([self.data.qpos[2:], self.data.qvel[2:]])


def _mjcf(values, slope, friction, payload, solref) -> str:
    l, mt, g = values['leg_length'], values['total_mass'], values['gravity']
    legs = _legs(values)
    hip_mass = mt - sum(leg.mass for leg in legs.values())
    bodies = ''
    for name, leg in legs.items():
        extra = ''
        if payload is not None and payload[0] == name:
            extra = (
                f'<body pos="0 0 {payload[2] - l}"><inertial pos="0 0 0" mass="{payload[1]}" '
                'diaginertia="1e-12 1e-12 1e-12"/></body>'
            )
        bodies += (
            f'<body><joint type="hinge" axis="0 1 0"/>{leg.inertial(-leg.below_hip)}'
            f'<geom name="{name}" type="sphere" size="{RADIUS}" pos="0 0 {-l}" mass="0"/>{extra}'
            '</body>'
        )
    contact = (
        f'condim="3" friction="{friction} 0 0" solref="{solref[0]} {solref[1]}" '
        'solimp="0.999 0.9999 0.0001"'
    )
    return f"""
<mujoco>
  <option gravity="0 0 {-g}" timestep="{STEP}" cone="elliptic" impratio="100"
          noslip_iterations="20" tolerance="1e-12"/>
  <compiler angle="radian"/>
  <default><geom {contact}/></default>
  <worldbody>
    <geom type="plane" size="50 50 1" euler="0 {slope!r} 0"/>
    <body>
      <joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 0 1"/>
      <inertial pos="0 0 0" mass="{hip_mass!r}" diaginertia="1e-9 1e-9 1e-9"/>
      {bodies}
    </body>
  </worldbody>
</mujoco>"""
