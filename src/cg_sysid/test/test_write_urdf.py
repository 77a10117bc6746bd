"""What was identified goes into the URDF, and a simulator moves by it as the model does."""

import casadi as ca
import numpy as np
import pytest
from hanging_arm import nominal, urdf

from cg_description.model_file import ModelFile
from cg_description.robot_description import parse
from cg_dynamics.mechanisms.urdf import Urdf
from cg_dynamics.model import Model
from cg_dynamics.rig import Setup
from cg_sysid.cli.write_urdf import main

WELDED = """<link name="sole"><visual><geometry><sphere radius="0.02"/></geometry></visual>
  <inertial><mass value="0.2"/><origin xyz="0 0 -0.01"/>
  <inertia ixx="0.0001" iyy="0.0001" izz="0.0001" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="weld" type="fixed"><parent link="shank"/><child link="sole"/>
  <origin xyz="0 0 -0.25"/></joint></robot>"""
FOUND = {
    'thigh_mass': 1.13, 'thigh_shift_x': 0.2, 'shank_stretch_z': 0.8, 'shank_mass': 0.93,
    'viscous_friction@hip_joint.coefficient': 0.31, 'coulomb_friction@shank_joint.torque': 0.07,
}  # fmt: skip


@pytest.fixture
def files(tmp_path):
    text = urdf().replace('</robot>', WELDED)
    model = nominal()
    file = model.to_file()
    model = Model.from_file(
        type(file)(**{**vars(file), 'robot': {**file.robot, 'urdf': text}})
    ).with_values(FOUND).with_effect('rotor_inertia', 'thigh_joint', inertia=0.02).with_effect(
        'cogging_torque', 'hip_joint')  # fmt: skip
    model.save(tmp_path / 'model.yaml')
    (tmp_path / 'robot.urdf').write_text(text)
    return model, tmp_path


def test_the_urdf_moves_as_the_model_does(files, capsys):
    model, folder = files
    words = [str(folder / name) for name in ('model.yaml', 'robot.urdf')]
    assert main([*words, '--out', str(folder / 'new.urdf')]) == 0
    said = capsys.readouterr()
    assert '<joint name="hip_joint" damping="0.31" frictionloss="0.2"/>' in said.out
    assert 'armature="0.02"' in said.out
    assert 'cogging_torque@hip_joint' in said.err
    text = (folder / 'new.urdf').read_text()
    assert '<sphere radius="0.02"' in text
    written = Urdf(parse(text))
    damping = {joint.name: joint.damping for joint in written.description.joints}
    assert damping['hip_joint'] == 0.31
    random = np.random.default_rng(3)
    q, v, a = random.normal(size=(3, 3))
    taken = [
        np.asarray(ca.DM(body.inverse_dynamics(ca.SX(q), ca.SX(v), ca.SX(a), p, body.up(Setup()))))
        for body, p in (
            (model.mechanism, model.values),
            (written, {p.name: p.default for p in written.parameters}),
        )
    ]
    np.testing.assert_allclose(*taken, rtol=1e-9)


def test_a_motor_that_joints_share_is_a_tendon_of_mjcf(tmp_path, capsys):
    mujoco = pytest.importorskip('mujoco', reason='MuJoCo is not installed')
    shared = {'knee_motor': {'thigh_joint': 1.0, 'shank_joint': -2.5}}
    model = Model.from_file(ModelFile(
        name='leg', mechanism='urdf', parameters={}, robot={'urdf': urdf(), 'couplings': shared},
    )).with_effect('coulomb_friction', 'knee_motor', torque=0.4)  # fmt: skip
    model.with_effect('rotor_inertia', 'knee_motor', inertia=0.03).save(tmp_path / 'model.yaml')
    (tmp_path / 'robot.urdf').write_text(urdf())
    words = [str(tmp_path / name) for name in ('model.yaml', 'robot.urdf')]
    assert main([*words, '--out', str(tmp_path / 'new.urdf')]) == 0
    said = capsys.readouterr().out
    mjcf = mujoco.MjSpec.from_string((tmp_path / 'new.urdf').read_text()).to_xml()
    engine = mujoco.MjModel.from_xml_string(
        mjcf.replace('</mujoco>', f'<tendon>{said}</tendon></mujoco>')
    )
    assert engine.tendon_frictionloss[0] == pytest.approx(0.4)
    assert engine.tendon_armature[0] == pytest.approx(0.03)
    assert sorted(engine.wrap_prm) == [-2.5, 1.0]


def moved_at(text, held, q):
    """Torques of a URDF that is held so, at a motion of the rest."""
    body = Urdf(parse(text).holding(held))
    p = {q.name: q.default for q in body.parameters}
    words = map(ca.SX, q)
    return np.asarray(ca.DM(body.inverse_dynamics(*words, p, body.up(Setup()))))


def test_what_hangs_on_a_joint_that_was_held_keeps_its_weight(tmp_path, capsys):
    held = {'shank_joint': 0.7}
    whole = urdf().replace('</robot>', WELDED)
    model = Model.from_file(
        ModelFile(name='leg', mechanism='urdf', parameters={},
                  robot={'urdf': parse(whole).holding(held).text()})
    ).with_values({'hip_mass': 1.2, 'thigh_mass': 1.13, 'thigh_shift_x': 0.2})  # fmt: skip
    model.save(tmp_path / 'model.yaml')
    (tmp_path / 'robot.urdf').write_text(whole)
    words = [str(tmp_path / name) for name in ('model.yaml', 'robot.urdf')]
    assert main([*words, '--out', str(tmp_path / 'new.urdf')]) == 0
    text = (tmp_path / 'new.urdf').read_text()
    for link in ('shank', 'sole'):
        assert parse(text).inertials[link] == parse(whole).inertials[link]
    motion = np.random.default_rng(3).normal(size=(3, 2))
    body, words = model.mechanism, map(ca.SX, motion)
    expected = ca.DM(body.inverse_dynamics(*words, model.values, body.up(Setup())))
    np.testing.assert_allclose(moved_at(text, held, motion), np.asarray(expected), rtol=1e-9)
    # A leg lighter than the shank that hangs on it cannot be written apart.
    model.with_values({'thigh_mass': 0.2}).save(tmp_path / 'light.yaml')
    words = [str(tmp_path / name) for name in ('light.yaml', 'robot.urdf')]
    assert main([*words, '--out', str(tmp_path / 'light.urdf')]) == 2
    assert 'less than what hangs on joints that were held: 1 of 0.54' in capsys.readouterr().err


def test_mistakes_get_one_line(files, capsys):
    _, folder = files
    other = folder / 'other.urdf'
    other.write_text(urdf())
    words = [str(folder / 'model.yaml'), str(other)]
    assert main([*words, '--out', str(folder / 'new.urdf')]) == 2
    assert 'other joints than the URDF' in capsys.readouterr().err
    words = ['sydney_pendulum', str(other)]
    assert main([*words, '--out', str(folder / 'new.urdf')]) == 2
    assert 'a model of a URDF is needed' in capsys.readouterr().err
