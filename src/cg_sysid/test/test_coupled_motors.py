"""A leg whose knee has its motor at the hip, by a four-bar linkage: MuJoCo's, with a secret."""

import mujoco_tree
import numpy as np
import pytest
from hanging_arm import NOISE, urdf

from cg_dynamics.model import Model
from cg_interfaces import channels
from cg_sysid.cli.new_robot import main as new_robot
from cg_sysid.identification.data_set import prepare
from cg_sysid.records.bags import read_bag, write_bag
from cg_sysid.records.record import Record
from cg_sysid.search.torque_selection import select

JOINTS = 'hip_joint', 'thigh_joint', 'shank_joint'
LINKAGE = """<transmission name="knee">
  <type>transmission_interface/FourBarLinkageTransmission</type>
  <actuator name="thigh_motor"><role>actuator1</role></actuator>
  <actuator name="knee_motor"><role>actuator2</role></actuator>
  <joint name="thigh_joint"><role>joint1</role></joint>
  <joint name="shank_joint"><role>joint2</role></joint></transmission>
  <transmission name="hip"><type>transmission_interface/SimpleTransmission</type>
  <actuator name="hip_motor"/><joint name="hip_joint"/></transmission>"""
URDF = urdf().replace('</robot>', f'{LINKAGE}</robot>')
SHARED = np.array([0.0, 1.0, 1.0])  # the knee's motor turns by the angle of the shank in space
DRY = 0.4  # N m, of the knee's motor
SECONDS = 6.0
SOUGHT = 'coulomb_friction', 'viscous_friction', 'rotor_inertia', 'torque_bias'


def rubs(time, q, v, torque):
    """Dry friction of the knee's motor, which thigh and shank feel alike."""
    return -DRY * np.tanh(SHARED @ v / 0.01) * SHARED


def moved(seed: int) -> mujoco_tree.Recording:
    """It follows smooth ways, by a controller that knows nothing of it."""
    reach = np.array([0.5, 0.7, 0.9])
    way, start = mujoco_tree.wander(np.random.default_rng(seed), 3, reach, 0.2, 1.3)

    def command(time, q, v):
        position, rate = way(time)
        return 60 * (position - q) + 3 * (rate - v)

    return mujoco_tree.record(
        urdf(), JOINTS, command, SECONDS, start, mujoco_tree.Secret(torque=rubs), NOISE, seed=seed
    )


def as_record(model: Model, recording: mujoco_tree.Recording, name: str, efforts) -> Record:
    body = model.mechanism
    return Record(
        name=name,
        stamp_ns=1_700_000_000_000_000_000 + np.round(recording.time * 1e9).astype(np.int64)
        + 60_000_000_000 * int(name[-1]),
        inputs=dict(zip(body.inputs, efforts.T, strict=True)),
        outputs=dict(zip(body.outputs, recording.position.T, strict=True)),
        mechanism=channels.interface(body),
    )  # fmt: skip


@pytest.fixture(scope='module')
def recordings():
    return [moved(seed) for seed in range(4)]


def written(folder, *options: str) -> Model:
    """As `cg new-robot` writes it."""
    (folder / 'leg.urdf').write_text(URDF)
    command = [str(folder / 'leg.urdf'), '--out', str(folder / 'leg.yaml'), *options]
    assert new_robot(command) == 0
    return Model.load(folder / 'leg.yaml')


def test_friction_of_a_motor_that_joints_share_is_told_from_theirs(recordings, tmp_path):
    """The joints' torques are known, as ros2_control works them out."""
    model = written(tmp_path)
    assert model.mechanism.couplings == {'knee_motor': {'thigh_joint': 1.0, 'shank_joint': 1.0}}
    assert model.mechanism.driven == JOINTS
    records = [as_record(model, r, f'way_{k}', r.effort) for k, r in enumerate(recordings)]
    found = prepare(model, records)
    (law,) = select(model, found[0::2], found[1::2], SOUGHT).laws
    assert law.label == 'coulomb_friction@knee_motor'
    # A share of it is lost to smoothing, where the motor turns back.
    assert law.parameters['torque'][0] == pytest.approx(DRY, rel=0.05)


@pytest.mark.evidence
def test_torques_of_the_motors_say_the_same(recordings, tmp_path):
    """Each motor's own: that of the knee acts on both joints."""
    motors = written(tmp_path, '--driven', 'hip_joint,thigh_joint,knee_motor')
    assert motors.mechanism.driven == ('hip_joint', 'thigh_joint', 'knee_motor')
    records = []
    for k, r in enumerate(recordings):
        hip, thigh, shank = r.effort.T
        own = as_record(motors, r, f'way_{k}', np.column_stack([hip, thigh - shank, shank]))
        bag = write_bag(tmp_path / own.name, own)
        records.append(read_bag(bag, mechanism=channels.interface(motors.mechanism)))
        assert records[-1].inputs.keys() == own.inputs.keys()
    found = prepare(motors, records)
    (law,) = select(motors, found[0::2], found[1::2], SOUGHT).laws
    assert law.label == 'coulomb_friction@knee_motor'
    assert law.parameters['torque'][0] == pytest.approx(DRY, rel=0.05)
