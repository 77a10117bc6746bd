"""The model file that `cg new-robot` makes of a URDF."""

import re
from dataclasses import replace

import numpy as np
import pytest
from hanging_arm import nominal, recorded, urdf

from cg_description.robot_description import parse
from cg_dynamics.mechanisms.urdf import Urdf
from cg_dynamics.model import Model
from cg_dynamics.rig import Setup
from cg_interfaces import channels
from cg_sysid.cli.diagnose import main as diagnose
from cg_sysid.cli.new_robot import main, template
from cg_sysid.records.bags import write_bag

CART_POLE = """<robot name="cart_pole"><link name="rail"/>
  <link name="cart"><inertial><mass value="0.9"/>
    <inertia ixx="2e-3" iyy="3e-3" izz="3e-3" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <link name="pole"><inertial><origin xyz="0 0 -0.3"/><mass value="0.2"/>
    <inertia ixx="7e-3" iyy="7e-3" izz="1e-4" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="slide" type="prismatic"><parent link="rail"/><child link="cart"/>
    <axis xyz="1 0 0"/><limit lower="-1" upper="1" effort="20" velocity="4"/>
    <dynamics damping="2.5" friction="0.6"/></joint>
  <joint name="hinge" type="continuous"><parent link="cart"/><child link="pole"/>
    <axis xyz="0 1 0"/><dynamics damping="0.003"/></joint></robot>"""


def test_friction_of_a_joint_without_a_drive_is_in_the_file():
    model = Model.from_text(template(parse(CART_POLE), ['slide'], [], 'cart_pole.urdf'))
    assert model.mechanism.inputs == ('slide_effort',)
    values = {name: value for name, value in model.values.items() if '.' in name}
    assert values['viscous_friction@slide.coefficient'] == 2.5
    assert values['coulomb_friction@slide.torque'] == 0.6
    assert values['viscous_friction@hinge.coefficient'] == 0.003
    assert model.declarations['viscous_friction@slide.coefficient'].unit == 'N s/m'
    assert model.declarations['viscous_friction@hinge.coefficient'].unit == 'N m s/rad'


@pytest.mark.parametrize('name', ['1', 'yes', 'a: b', 'a,b', '@left', '- joint', 'left joint'])
def test_names_that_yaml_would_take_for_something_else_come_back(name):
    text = CART_POLE.replace('"slide"', f'"{name}"').replace('"cart_pole"', f'"{name}"')
    model = Model.from_text(template(parse(text), [name], [], f'{name}.urdf'))
    assert model.name == name
    assert model.mechanism.inputs == (f'{name}_effort',)
    assert f'viscous_friction@{name}.coefficient' in model.declarations
    assert model.torque_limit == 20.0


@pytest.fixture
def leg(tmp_path):
    """The URDF of a leg, and a recording in which something holds its shank."""
    (tmp_path / 'leg.urdf').write_text(urdf())
    record = recorded(nominal(), 1.0, 3, Setup(locked=(('shank_joint', 0.4),)))
    write_bag(tmp_path / 'bag', record)
    return tmp_path


def made(folder, *words):
    """What `cg new-robot` returns, and the model that it writes."""
    out = folder / 'leg.yaml'
    code = main([str(folder / 'leg.urdf'), *words, '--out', str(out)])
    return code, Model.load(out) if code == 0 else None


def test_joints_that_somebody_holds_stand_where_they_were_recorded(leg):
    code, model = made(
        leg, '--joint-states', str(leg / 'bag'), '--joints', 'hip_joint,thigh_joint'
    )
    assert code == 0
    assert model.mechanism.coordinates == ('hip_joint', 'thigh_joint')
    assert model.mechanism.driven == ('hip_joint', 'thigh_joint')
    shank = next(j for j in model.mechanism.description.joints if j.name == 'shank_joint')
    assert shank.kind == 'fixed'
    assert shank.rpy[1] == pytest.approx(0.4, abs=1e-3)  # the noise of an encoder, averaged
    assert '# shank_joint is held at 0.4' in (leg / 'leg.yaml').read_text()
    noise = model.sensors['hip_joint_position']['noise']
    assert noise.value == pytest.approx(5e-5, rel=0.2)  # the recording was read once more


def test_a_urdf_that_knows_no_friction_is_told_so(leg, capsys):
    """Both ways: a joint that it states some of is not named."""
    text = urdf()
    i = text.index('</joint>', text.index('thigh_joint'))
    (leg / 'leg.urdf').write_text(f'{text[:i]}<dynamics damping="0.1"/>{text[i:]}')
    code, _ = made(leg)
    assert code == 0
    said = 'the URDF states no friction of hip_joint, shank_joint, and drives have some'
    assert said in capsys.readouterr().err
    assert said in (leg / 'leg.yaml').read_text()
    diagnose(['--model', str(leg / 'leg.yaml'), '--out', str(leg / 'answer'), 'no_such_bag'])
    assert 'no friction at hip_joint, shank_joint; let `cg torques`' in capsys.readouterr().err


def test_where_a_joint_is_held_can_be_stated(leg):
    code, model = made(leg, '--held', 'shank_joint=-0.25')
    assert code == 0
    assert model.mechanism.coordinates == ('hip_joint', 'thigh_joint')
    shank = next(j for j in model.mechanism.description.joints if j.name == 'shank_joint')
    np.testing.assert_allclose(shank.rpy, [0.0, -0.25, 0.0], atol=1e-12)


def rewritten(folder, name, body, setup):
    """The recording without what this robot does not have."""
    record = recorded(nominal(), 1.0, 3, setup)
    inputs = {name: record.inputs[name] for name in body.inputs}
    outputs = {name: record.outputs[name] for name in body.outputs}
    known = channels.interface(body)
    write_bag(folder / name, replace(record, inputs=inputs, outputs=outputs, mechanism=known,
                                     setup=Setup()))  # fmt: skip
    return str(folder / name)


def test_a_joint_that_no_recording_has_is_named_or_held(leg, capsys):
    part = Urdf(parse(urdf()).holding({'shank_joint': 0.4}))
    bag = rewritten(leg, 'part', part, Setup(locked=(('shank_joint', 0.4),)))
    code, _ = made(leg, '--joint-states', bag)
    assert code == 2
    said = "no recording has a position of joint 'shank_joint'; say where it is held (--held shank"
    assert said in capsys.readouterr().err
    code, model = made(leg, '--joint-states', bag, '--held', 'shank_joint=0.4')
    assert code == 0
    assert model.mechanism == Urdf(part.description, rates=False)


def test_a_joint_of_which_no_effort_is_recorded_swings_freely(leg):
    swings = Urdf(parse(urdf()), ('hip_joint', 'thigh_joint'))
    bag = rewritten(leg, 'free', swings, Setup())
    code, model = made(leg, '--joint-states', bag)
    assert code == 0
    assert model.mechanism == swings


@pytest.mark.parametrize(
    ('words', 'said'),
    [
        (['--joint-states', 'BAG', '--joints', 'shank_joint'],
         "'hip_joint' moves by .* in a recording; one that is held moves by 0.02 at most"),
        (['--joints', 'knee'], "'knee' is no joint that moves by itself; there are: hip_joint, "),
        (['--held', 'shank_joint'], '--held shank_joint: JOINT=POSITION is needed, in rad or m'),
        (['--held', 'shank_joint=nan'], 'JOINT=POSITION is needed'),
        (['--joints', 'hip_joint', '--held', 'hip_joint=0'],
         "'hip_joint' is among --joints, which move, and among --held"),
        (['--held', 'hip_joint=0', 'thigh_joint=0', 'shank_joint=0'], 'no joint moves'),
    ],
)  # fmt: skip
def test_a_joint_that_cannot_be_held_is_named(leg, words, said, capsys):
    code, _ = made(leg, *[str(leg / 'bag') if word == 'BAG' else word for word in words])
    assert code == 2
    assert re.search(said, capsys.readouterr().err)
    assert not (leg / 'leg.yaml').exists()


def test_an_inertia_that_no_body_has_is_told_and_put_right(leg, capsys):
    """Hip of 2.1 kg: 0.0126, 0.01386, 0.00504 kg m^2; who writes 0.1 for the first has erred."""
    text = urdf().replace('ixx="0.0126', 'ixx="0.1')
    assert text != urdf()
    (leg / 'leg.urdf').write_text(text)
    code, model = made(leg)
    assert code == 0
    said = "link 'hip': no body has the inertia that the URDF gives it"
    assert said in capsys.readouterr().err
    assert said in (leg / 'leg.yaml').read_text()
    assert model.mechanism.inertials(model.values)['hip'].inertia[0] == pytest.approx(0.1)
