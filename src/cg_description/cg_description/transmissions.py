"""Drives of a robot, by the `ros2_control` and `transmission` elements of its URDF.

Two motors may share two joints. With x the angles of motors (a) and joints (j), offsets apart, and
n their reductions, such transmissions are, as ros2_control's transmission_interface has them,

    differential          x_a1 = n_a1 (n_j1 x_j1 + n_j2 x_j2),  x_a2 = n_a2 (n_j1 x_j1 - n_j2 x_j2)
    four-bar linkage      x_a1 = n_a1 n_j1 x_j1,                x_a2 = n_a2 (x_j1 + n_j2 x_j2)

A motor's own reduction n_a is left out here: it is seen through its gear, as one at a joint is.
"""

import math
import xml.etree.ElementTree as Xml

from cg_description.reading import shown
from cg_description.robot_description import RobotDescriptionError, parse

DIFFERENTIAL = 'transmission_interface/DifferentialTransmission'
FOUR_BAR = 'transmission_interface/FourBarLinkageTransmission'
# As ROS 1 and as ROS 2 write it.
REDUCTIONS = 'mechanicalReduction', 'mechanical_reduction'


def driven_joints(text: str) -> list[str]:
    """Joints that a URDF gives a drive; [] for none.

    Raises:
        RobotDescriptionError: It cannot be used.
    """
    free = [joint.name for joint in parse(text).independent]
    robot = Xml.fromstring(text.encode())
    controlled = [
        joint.get('name', '')
        for system in robot.iter('ros2_control')
        for joint in system.iter('joint')
        if joint.find('command_interface') is not None
    ]
    transmitted = [j.get('name', '') for t in robot.iter('transmission') for j in t.iter('joint')]
    return [name for name in free if name in (controlled or transmitted)]


def couplings(text: str) -> dict[str, dict[str, float]]:
    """Motor that turns with two joints of a URDF -> joint -> rad of it with each rad of that.

    A motor that has the name of a joint is called NAME_motor. Transmissions of other types, and
    those that do not name two motors and two joints that move by themselves, are left out.

    Raises:
        RobotDescriptionError: It cannot be used, or a reduction is no number other than 0.
    """
    described = parse(text)
    free = [joint.name for joint in described.independent]
    names = [joint.name for joint in described.joints]
    found = {}
    for element in Xml.fromstring(text.encode()).iter('transmission'):
        kind = next((_said(element, tag) for tag in ('type', 'plugin') if _said(element, tag)), '')
        motors, joints = (_in_order(element, tag) for tag in ('actuator', 'joint'))
        if kind not in (DIFFERENTIAL, FOUR_BAR) or len(motors) != 2 or len(joints) != 2:
            continue
        one, two = (str(joint.get('name')) for joint in joints)
        if one not in free or two not in free:
            continue
        first, second = (str(motor.get('name')) for motor in motors)
        n_1, n_2 = (_reduction(joint, str(element.get('name'))) for joint in joints)
        rows = (
            {first: {one: n_1, two: n_2}, second: {one: n_1, two: -n_2}}
            if kind == DIFFERENTIAL
            else {second: {one: 1.0, two: n_2}}
        )
        for name, ratios in rows.items():
            found[f'{name}_motor' if name in names else name] = ratios
    return found


def _said(element: Xml.Element, tag: str) -> str:
    return (element.findtext(tag) or '').strip()


def _in_order(element: Xml.Element, tag: str) -> list[Xml.Element]:
    """Motors or joints of a transmission, by their roles, which end with 1 and 2."""
    return sorted(
        (own for own in element.findall(tag) if own.get('name')),
        key=lambda own: (own.get('role') or _said(own, 'role'))[-1:],
    )


def _reduction(joint: Xml.Element, transmission: str) -> float:
    said = next((_said(joint, tag) for tag in REDUCTIONS if _said(joint, tag)), '1')
    try:
        value = float(said)
    except ValueError:
        value = math.nan
    if not math.isfinite(value) or value == 0:
        raise RobotDescriptionError(
            f'transmission {shown(transmission)}: joint {shown(joint.get("name"))}: mechanical '
            f'reduction {shown(said)}; a number other than 0 is needed'
        )
    return value
