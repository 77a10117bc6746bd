"""A robot that no table knows: two joints of a JointState, a motor at the first only."""

from cg_dynamics.mechanisms import MECHANISMS
from cg_dynamics.mechanisms.double_pendulum import DoublePendulum
from cg_dynamics.model import Model
from cg_interfaces import channels


class TwoJointArm(DoublePendulum):
    """The physics of a double pendulum, channels as of a robot that a URDF describes."""

    name = 'two_joint_arm'
    coordinates = ('shoulder', 'elbow')
    joints = {'shoulder': (1.0, 0.0)}  # noqa: RUF012 - read only
    inputs = ('shoulder_effort',)
    outputs = ('shoulder_position', 'elbow_position', 'shoulder_velocity', 'elbow_velocity')
    output_units = ('rad', 'rad', 'rad/s', 'rad/s')
    sensor_kinds = {  # noqa: RUF012 - read only
        'shoulder_position': 'encoder',
        'elbow_position': 'encoder',
        'shoulder_velocity': 'tachometer',
        'elbow_velocity': 'tachometer',
    }

    def sensors(self, q, v):
        """What the joints report of themselves."""
        return dict(zip(self.outputs, (q[0], q[1], v[0], v[1]), strict=True))


FILE = """\
format: cg_model/1
name: arm
mechanism: two_joint_arm
parameters:
  upper_inertia: {value: 0.06, unit: kg m^2}
  lower_inertia: {value: 0.02, unit: kg m^2}
  coupling: {value: 0.02, unit: kg m^2}
  upper_gravity: {value: 2.0, unit: N m}
  upper_length: {value: 0.3, unit: m, fixed: true}
  gravity: {value: 9.81, unit: m/s^2, fixed: true}
effects:
- name: viscous_friction
  at: shoulder
  parameters:
    coefficient: {value: 0.05, unit: N m s/rad}
sensors:
  shoulder_position: {noise: {value: 1.0e-4, unit: rad}}
  elbow_position: {noise: {value: 1.0e-4, unit: rad}}
  shoulder_velocity: {noise: {value: 1.0e-2, unit: rad/s}}
  elbow_velocity: {noise: {value: 1.0e-2, unit: rad/s}}
actuators:
  shoulder_effort: {limit: {value: 20.0, unit: N m}}
"""
ARM = channels.interface(TwoJointArm())


def install(monkeypatch) -> None:
    """Make the mechanism one that model files may name."""
    monkeypatch.setitem(MECHANISMS, TwoJointArm.name, TwoJointArm())


def arm() -> Model:
    """The arm as its file has it; `install` comes first."""
    return Model.from_text(FILE)
