"""The URDF shows the robot of the model file, and layouts name what there is."""

import json
import math
import xml.etree.ElementTree as ElementTree
from dataclasses import replace

import pytest
import yaml

from cg_description.model_file import ModelFileError, load
from cg_description.paths import model_path, models_directory
from cg_description.urdf import JOINTS, bodies, joint_positions, urdf

FILE = load(model_path('compass_gait_mit'))
SHARE = models_directory().parent


def chain(positions):
    """World (x, z) and pitch of every link, by walking the tree of joints in the plane."""
    robot = ElementTree.fromstring(urdf(FILE))
    joints = {joint.find('child').get('link'): joint for joint in robot.iter('joint')}

    def pose(link):
        if link not in joints:
            return 0.0, 0.0, 0.0
        joint = joints[link]
        x, z, pitch = pose(joint.find('parent').get('link'))
        dx, dy, dz = map(float, joint.find('origin').get('xyz').split())
        assert dy == 0
        mimic = joint.find('mimic')
        value = positions.get(joint.get('name'), 0.0)
        if mimic is not None:
            value = float(mimic.get('multiplier')) * positions[mimic.get('joint')]
        axis = (
            [0, 0, 0] if joint.get('type') == 'fixed'
            else list(map(float, joint.find('axis').get('xyz').split()))
        )  # fmt: skip
        if joint.get('type') == 'prismatic':
            dx, dz = dx + axis[0] * value, dz + axis[2] * value
            turn = 0.0
        else:
            turn = axis[1] * value
        # A pitch about +y turns z toward x.
        return (
            x + dx * math.cos(pitch) + dz * math.sin(pitch),
            z - dx * math.sin(pitch) + dz * math.cos(pitch),
            pitch + turn,
        )

    return {link.get('name'): pose(link.get('name')) for link in robot.iter('link')}


@pytest.mark.parametrize('stance', ['inner', 'outer'])
def test_legs_stand_where_the_conventions_say(stance):
    l = FILE.parameters['leg_length'].value
    q = {'inner': 0.2, 'outer': -0.3}
    places = chain(joint_positions(q['inner'], q['outer'], stance, l, foot_x=1.5))
    foot, hip = places[f'{stance}_foot'], places['hip_body']
    assert foot[:2] == pytest.approx((1.5, 0.0), abs=1e-9)
    # The hip end is ahead of the foot by the leg's lean.
    lean = q[stance]
    assert hip[:2] == pytest.approx((1.5 + l * math.sin(lean), l * math.cos(lean)), abs=1e-6)
    assert places['inner_leg'][2] == pytest.approx(0.2)
    assert places['outer_leg'][2] == pytest.approx(-0.3)
    assert hip[2] == pytest.approx(-0.05), 'the hip body bisects the legs'
    assert places['imu_link'][2] == pytest.approx(0.2), 'the IMU is on the inner legs'


def test_bodies_have_the_lumps_of_the_model():
    p = {name: q.value for name, q in FILE.parameters.items()}
    l, mt = p['leg_length'], p['total_mass']
    found = bodies(FILE)
    assert sum(mass for mass, _, _ in found.values()) == pytest.approx(mt)

    def inertia(name):
        mass, height, own = found[name]
        assert own > 0
        return (own + mass * height**2) / (mt * l**2)

    def moment(name):
        return found[name][0] * found[name][1] / (mt * l)

    assert inertia('inner_leg') + p['c3'] == pytest.approx(p['c1'])
    assert inertia('outer_leg') + p['c3'] == pytest.approx(p['c2'])
    assert inertia('hip_body') / 4 == pytest.approx(p['c3'])
    assert -moment('inner_leg') == pytest.approx(p['c4'])
    assert -moment('outer_leg') == pytest.approx(p['c5'])
    assert moment('hip_body') / 4 == pytest.approx(p['c6'])


def test_file_is_up_to_date():
    written = (SHARE / 'urdf' / 'compass_gait.urdf').read_text(encoding='utf-8')
    assert written == urdf(FILE), 'run python tools/make_urdf.py'


def test_joints_are_those_that_positions_are_given_for():
    robot = ElementTree.fromstring(urdf(FILE))
    free = [
        joint.get('name')
        for joint in robot.iter('joint')
        if joint.get('type') != 'fixed' and joint.find('mimic') is None
    ]
    assert tuple(free) == JOINTS == tuple(joint_positions(0, 0, 'inner', 1.0))


def test_other_mechanisms_and_impossible_lumps_are_refused():
    with pytest.raises(ModelFileError, match='that of a compass gait'):
        urdf(load(model_path('sydney_pendulum')))
    heavy = dict(FILE.parameters)
    heavy['c4'] = replace(heavy['c4'], value=0.9)
    with pytest.raises(ModelFileError, match='no real bodies'):
        urdf(replace(FILE, parameters=heavy))


def test_layouts_can_be_read():
    layout = json.loads((SHARE / 'layouts' / 'foxglove.json').read_text(encoding='utf-8'))

    def leaves(node):
        if isinstance(node, str):
            return {node}
        return leaves(node['first']) | leaves(node['second'])

    assert leaves(layout['layout']) == set(layout['configById'])
    rviz = yaml.safe_load((SHARE / 'rviz' / 'compass_gait.rviz').read_text(encoding='utf-8'))
    assert rviz['Visualization Manager']['Global Options']['Fixed Frame'] == 'world'
