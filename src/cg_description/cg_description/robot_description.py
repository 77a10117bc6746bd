"""Robot descriptions: what a URDF says of links and joints, without what is only to look at.

A description is a tree: one root that stands still, joints in an order in which a parent comes
before its children, and the inertia of each link. `parse` takes any URDF and says what it cannot
use; `text` writes the least URDF that says the same, which is what a model file carries.
"""

import math
import re
import xml.etree.ElementTree as Xml
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from cg_description.reading import DocumentError, shown

Vector = tuple[float, float, float]
MOVING = ('revolute', 'continuous', 'prismatic')
KINDS = (*MOVING, 'fixed')
LARGEST = 10_000_000  # characters of a description; those of whole humanoids have 200 000


class RobotDescriptionError(DocumentError):
    """A URDF that cannot be used; the message says what, where and what is allowed."""


@dataclass(frozen=True)
class Inertial:
    """Mass and inertia of a link.

    Attributes:
        mass: In kg.
        centre: Centre of mass in the link's frame, m.
        inertia: xx, yy, zz, xy, xz, yz about the centre of mass, along the link's axes, kg m^2.
    """

    mass: float
    centre: Vector
    inertia: tuple[float, float, float, float, float, float]


@dataclass(frozen=True)
class Joint:
    """A joint, at the origin of its child link.

    Attributes:
        name: Name.
        kind: One of `KINDS`.
        parent: Link nearer to the root.
        child: Link that it carries.
        xyz: Origin of the child in the parent's frame at position 0, m.
        rpy: Its orientation there: roll, pitch, yaw about fixed axes, rad.
        axis: Unit vector in the child's frame, about or along which it moves.
        lower: Smallest position, rad or m; -inf where none is stated.
        upper: Largest position.
        effort: Largest torque or force, N m or N; inf where none is stated.
        velocity: Largest rate, rad/s or m/s; inf where none is stated.
        damping: Of the description's `dynamics`, N m s/rad or N s/m.
        friction: Dry friction of it, N m or N.
        mimic: (joint, multiplier, offset) that this one follows, or None.
    """

    name: str
    kind: str
    parent: str
    child: str
    xyz: Vector = (0.0, 0.0, 0.0)
    rpy: Vector = (0.0, 0.0, 0.0)
    axis: Vector = (1.0, 0.0, 0.0)
    lower: float = -math.inf
    upper: float = math.inf
    effort: float = math.inf
    velocity: float = math.inf
    damping: float = 0.0
    friction: float = 0.0
    mimic: tuple[str, float, float] | None = None

    @property
    def slides(self) -> bool:
        """Whether it moves along its axis."""
        return self.kind == 'prismatic'

    def held(self, position: float) -> 'Joint':
        """The fixed joint that this one is where something holds it, rad or m."""
        turn = rotation(self.rpy)
        xyz, rpy = self.xyz, self.rpy
        if self.slides:
            x, y, z = (
                start + position * sum(row[k] * self.axis[k] for k in range(3))
                for start, row in zip(self.xyz, turn, strict=True)
            )
            xyz = x, y, z
        else:
            own = _about(self.axis, position)
            rpy = _angles(
                [[sum(row[k] * own[k][j] for k in range(3)) for j in range(3)] for row in turn]
            )
        return Joint(self.name, 'fixed', self.parent, self.child, xyz, rpy)


@dataclass(frozen=True)
class RobotDescription:
    """A tree of links and joints on a base that stands still.

    Attributes:
        name: Name of the robot.
        root: The link that stands still.
        joints: Every joint, parents before children.
        inertials: Link -> its inertia, of the links that have one.
    """

    name: str
    root: str
    joints: tuple[Joint, ...]
    inertials: Mapping[str, Inertial]

    @property
    def links(self) -> tuple[str, ...]:
        """All links, the root first."""
        return (self.root, *(joint.child for joint in self.joints))

    @property
    def moving(self) -> tuple[Joint, ...]:
        """The joints that move."""
        return tuple(joint for joint in self.joints if joint.kind != 'fixed')

    @property
    def independent(self) -> tuple[Joint, ...]:
        """The joints that move and follow no other."""
        return tuple(joint for joint in self.moving if joint.mimic is None)

    def stranger(self, name: str) -> str:
        """What is wrong with a name that is no joint that moves by itself; empty if it is one."""
        free = [joint.name for joint in self.independent]
        if name in free:
            return ''
        return f'{shown(name)} is no joint that moves by itself; there are: {", ".join(free)}'

    def holding(self, positions: Mapping[str, float]) -> 'RobotDescription':
        """This robot with some joints fixed, and with them those that follow them.

        Args:
            positions: Joint that moves by itself -> where it is held, rad or m.

        Raises:
            RobotDescriptionError: One of them does not move by itself.
        """
        for name in positions:
            if stranger := self.stranger(name):
                raise RobotDescriptionError(stranger)
        joints = []
        for joint in self.joints:
            leader, ratio, offset = joint.mimic or (joint.name, 1.0, 0.0)
            moves = joint.kind != 'fixed' and leader in positions
            joints.append(joint.held(ratio * positions[leader] + offset) if moves else joint)
        return replace(self, joints=tuple(joints))

    def text(self) -> str:
        """The least URDF that says this; `parse` reads it back to an equal description."""
        lines = [f'<robot name={_quoted(self.name)}>']
        for link in self.links:
            found = self.inertials.get(link)
            if found is None:
                lines.append(f'  <link name={_quoted(link)}/>')
                continue
            xx, yy, zz, xy, xz, yz = map(repr, found.inertia)
            lines += [
                f'  <link name={_quoted(link)}>',
                '    <inertial>',
                f'      <origin xyz="{_numbers(found.centre)}"/>',
                f'      <mass value="{found.mass!r}"/>',
                f'      <inertia ixx="{xx}" iyy="{yy}" izz="{zz}" ixy="{xy}" ixz="{xz}" '
                f'iyz="{yz}"/>',
                '    </inertial>',
                '  </link>',
            ]
        for joint in self.joints:
            lines += [
                f'  <joint name={_quoted(joint.name)} type="{joint.kind}">',
                f'    <origin xyz="{_numbers(joint.xyz)}" rpy="{_numbers(joint.rpy)}"/>',
                f'    <parent link={_quoted(joint.parent)}/>',
                f'    <child link={_quoted(joint.child)}/>',
                *_joint_details(joint),
                '  </joint>',
            ]
        return '\n'.join([*lines, '</robot>', ''])


def parse(text: str, where: str = 'URDF') -> RobotDescription:
    """Read a URDF.

    Args:
        text: XML.
        where: What to name in an error.

    Raises:
        RobotDescriptionError: It is no URDF, no tree on one fixed base, or holds a joint that
            moves in more than one direction.
    """
    if len(text) > LARGEST:
        raise RobotDescriptionError(f'{where}: longer than {LARGEST} characters')
    if '<!' in re.sub(r'<!--.*?-->', '', text, flags=re.DOTALL).replace('<![CDATA[', ''):
        raise RobotDescriptionError(f'{where}: declares a document type, which no URDF needs')
    try:
        robot = Xml.fromstring(text.encode())
    except Xml.ParseError as error:
        raise RobotDescriptionError(f'{where}: no XML: {error}') from None
    if robot.tag != 'robot':
        raise RobotDescriptionError(f'{where}: <{robot.tag}> is no <robot>')
    if 'xacro' in text and any('xacro' in str(e.tag) for e in robot.iter()):
        raise RobotDescriptionError(f'{where}: holds xacro macros; run `xacro` on it first')
    links = _by_name(robot, 'link', where)
    if not links:
        raise RobotDescriptionError(f'{where}: no <link>; a robot has at least one')
    joints = [_joint(e, f'{where}: joint {name!r}') for name, e in
              _by_name(robot, 'joint', where).items()]  # fmt: skip
    ordered, root = _as_tree(joints, list(links), where)
    _follow(ordered, where)
    inertials = {}
    for name, element in links.items():
        found = _inertial(element, f'{where}: link {name!r}')
        if found is not None:
            inertials[name] = found
    return RobotDescription(robot.get('name') or 'robot', root, tuple(ordered), inertials)


def with_inertials(
    text: str,
    inertials: Mapping[str, Inertial | None],
    dynamics: Mapping[str, Mapping[str, float]] | None = None,
) -> str:
    """A URDF with other inertias of some links and other friction; all else stays as written.

    Args:
        text: The URDF.
        inertials: Link -> its inertia; None takes it away, where another link has it now.
        dynamics: Joint -> `damping` and `friction` that it has from now on.

    Raises:
        RobotDescriptionError: It does not have one of these links or joints.
    """
    robot = Xml.fromstring(
        text.encode(), Xml.XMLParser(target=Xml.TreeBuilder(insert_comments=True))
    )
    links = {str(e.get('name')): e for e in robot.findall('link')}
    for name, new in inertials.items():
        if name not in links:
            raise RobotDescriptionError(f'URDF: no link {name!r}; there are: {", ".join(links)}')
        link = links[name]
        inertial = link.find('inertial')
        if new is None:
            if inertial is not None:
                link.remove(inertial)
            continue
        if inertial is None:
            inertial = Xml.SubElement(link, 'inertial')
        for child in list(inertial):
            if child.tag in ('origin', 'mass', 'inertia'):
                inertial.remove(child)
        Xml.SubElement(inertial, 'origin', xyz=_numbers(new.centre), rpy='0 0 0')
        Xml.SubElement(inertial, 'mass', value=repr(new.mass))
        names = ('ixx', 'iyy', 'izz', 'ixy', 'ixz', 'iyz')
        values = map(repr, new.inertia)
        Xml.SubElement(inertial, 'inertia', dict(zip(names, values, strict=True)))
    joints = {str(e.get('name')): e for e in robot.findall('joint')}
    for name, numbers in (dynamics or {}).items():
        if name not in joints:
            raise RobotDescriptionError(f'URDF: no joint {name!r}; there are: {", ".join(joints)}')
        element = joints[name].find('dynamics')
        if element is None:
            element = Xml.SubElement(joints[name], 'dynamics')
        for key, value in numbers.items():
            element.set(key, repr(float(value)))
    Xml.indent(robot)
    return '<?xml version="1.0"?>\n' + Xml.tostring(robot, encoding='unicode') + '\n'


def rotation(rpy: Vector) -> list[list[float]]:
    """Rotation matrix of roll, pitch, yaw about fixed axes, rows first.

    Right angles that were written with few digits too many are right: what is within 1e-9 of 0 or
    +-1 is that.
    """
    (cr, sr), (cp, sp), (cy, sy) = ((math.cos(a), math.sin(a)) for a in rpy)
    rows = [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]
    return [[round(x) * 1.0 if abs(x - round(x)) < 1e-9 else x for x in row] for row in rows]


def _about(axis: Vector, angle: float) -> list[list[float]]:
    """Rotation matrix about a unit vector, rows first."""
    x, y, z = axis
    c, s = math.cos(angle), math.sin(angle)
    return [
        [c + x * x * (1 - c), x * y * (1 - c) - z * s, x * z * (1 - c) + y * s],
        [y * x * (1 - c) + z * s, c + y * y * (1 - c), y * z * (1 - c) - x * s],
        [z * x * (1 - c) - y * s, z * y * (1 - c) + x * s, c + z * z * (1 - c)],
    ]


def _angles(turn: Sequence[Sequence[float]]) -> Vector:
    """Roll, pitch and yaw of a rotation matrix; where only their sum is known all is yaw."""
    cosine = math.hypot(turn[0][0], turn[1][0])
    pitch = math.atan2(-turn[2][0], cosine)
    if cosine < 1e-9:
        return 0.0, pitch, math.atan2(-turn[0][1], turn[1][1])
    return (
        math.atan2(turn[2][1], turn[2][2]), pitch, math.atan2(turn[1][0], turn[0][0])
    )  # fmt: skip


def _by_name(robot: Xml.Element, tag: str, where: str) -> dict[str, Xml.Element]:
    found: dict[str, Xml.Element] = {}
    for element in robot.findall(tag):
        name = element.get('name')
        if not name:
            raise RobotDescriptionError(f'{where}: a <{tag}> has no name')
        if name in found:
            raise RobotDescriptionError(f'{where}: two {tag}s are called {shown(name)}')
        found[name] = element
    return found


def _joint(element: Xml.Element, where: str) -> Joint:
    kind = element.get('type', '')
    if kind not in KINDS:
        hint = '; a base that floats is not supported' if kind in ('floating', 'planar') else ''
        raise RobotDescriptionError(
            f'{where}: type {shown(kind)} is not one of {", ".join(KINDS)}{hint}'
        )
    ends = []
    for tag in ('parent', 'child'):
        link = element.find(tag)
        if link is None or not link.get('link'):
            raise RobotDescriptionError(f'{where}: no <{tag} link="...">')
        ends.append(str(link.get('link')))
    axis = _vector(element, 'axis', 'xyz', (1.0, 0.0, 0.0), where)
    length = math.hypot(*axis)
    if kind != 'fixed' and length == 0:
        raise RobotDescriptionError(f'{where}: its axis has no length')
    if not math.isclose(length, 1.0, rel_tol=1e-12):  # else it reads back to the digit
        x, y, z = axis
        axis = (x / length, y / length, z / length) if length else (1.0, 0.0, 0.0)
    bounded = kind in ('revolute', 'prismatic')
    return Joint(
        name=str(element.get('name')),
        kind=kind,
        parent=ends[0],
        child=ends[1],
        xyz=_vector(element, 'origin', 'xyz', (0.0, 0.0, 0.0), where),
        rpy=_vector(element, 'origin', 'rpy', (0.0, 0.0, 0.0), where),
        axis=axis,
        lower=_number(element, 'limit', 'lower', -math.inf, where) if bounded else -math.inf,
        upper=_number(element, 'limit', 'upper', math.inf, where) if bounded else math.inf,
        effort=_number(element, 'limit', 'effort', math.inf, where),
        velocity=_number(element, 'limit', 'velocity', math.inf, where),
        damping=_number(element, 'dynamics', 'damping', 0.0, where),
        friction=_number(element, 'dynamics', 'friction', 0.0, where),
        mimic=_mimic(element, where),
    )


def _mimic(element: Xml.Element, where: str) -> tuple[str, float, float] | None:
    found = element.find('mimic')
    if found is None:
        return None
    if not found.get('joint'):
        raise RobotDescriptionError(f'{where}: <mimic> names no joint')
    return (
        str(found.get('joint')),
        _number(element, 'mimic', 'multiplier', 1.0, where),
        _number(element, 'mimic', 'offset', 0.0, where),
    )


def _inertial(link: Xml.Element, where: str) -> Inertial | None:
    element = link.find('inertial')
    if element is None:
        return None
    mass = _number(element, 'mass', 'value', 0.0, where)
    if not mass >= 0 or math.isinf(mass):
        raise RobotDescriptionError(f'{where}: mass {mass:g} kg; it must be 0 or more')
    if mass == 0:
        return None
    xx, yy, zz, xy, xz, yz = (
        _number(element, 'inertia', name, 0.0, where)
        for name in ('ixx', 'iyy', 'izz', 'ixy', 'ixz', 'iyz')
    )
    turn = rotation(_vector(element, 'origin', 'rpy', (0.0, 0.0, 0.0), where))
    own = [[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]

    def turned(i: int, j: int) -> float:
        return sum(turn[i][a] * own[a][b] * turn[j][b] for a in range(3) for b in range(3))

    return Inertial(
        mass,
        _vector(element, 'origin', 'xyz', (0.0, 0.0, 0.0), where),
        (turned(0, 0), turned(1, 1), turned(2, 2), turned(0, 1), turned(0, 2), turned(1, 2)),
    )


def _as_tree(joints: list[Joint], links: list[str], where: str) -> tuple[list[Joint], str]:
    """The joints, parents first, and the root."""
    carried: dict[str, Joint] = {}
    for joint in joints:
        for link in (joint.parent, joint.child):
            if link not in links:
                raise RobotDescriptionError(
                    f'{where}: joint {joint.name!r} holds a link {shown(link)} that is not there'
                )
        if joint.child in carried:
            raise RobotDescriptionError(
                f'{where}: link {joint.child!r} hangs on two joints, '
                f'{carried[joint.child].name!r} and {joint.name!r}; loops are not supported'
            )
        carried[joint.child] = joint
    roots = [link for link in links if link not in carried]
    if len(roots) != 1:
        raise RobotDescriptionError(
            f'{where}: {len(roots)} links hang on no joint '
            f'({", ".join(roots[:5]) or "the joints form a loop"}); one is needed, the base'
        )
    ordered: list[Joint] = []
    waiting = [joint for joint in reversed(joints) if joint.parent == roots[0]]
    while waiting:  # as one walks the tree: out along a limb before the next one
        ordered.append(waiting.pop())
        end = ordered[-1].child
        waiting += [joint for joint in reversed(joints) if joint.parent == end]
    astray = [joint.name for joint in joints if joint not in ordered]
    if astray:
        raise RobotDescriptionError(
            f'{where}: joints that do not hang on the base: {", ".join(astray)}'
        )
    return ordered, roots[0]


def _follow(joints: Sequence[Joint], where: str) -> None:
    """Refuse a joint that follows one that is not there, does not move or follows itself."""
    by_name = {joint.name: joint for joint in joints}
    for joint in joints:
        if joint.mimic is None:
            continue
        leader = by_name.get(joint.mimic[0])
        if leader is None or leader.kind == 'fixed' or leader.mimic is not None:
            raise RobotDescriptionError(
                f'{where}: joint {joint.name!r} follows {shown(joint.mimic[0])}, which is no '
                'joint that moves by itself'
            )


def _vector(element: Xml.Element, tag: str, name: str, default: Vector, where: str) -> Vector:
    child = element.find(tag)
    text = None if child is None else child.get(name)
    if text is None:
        return default
    try:
        x, y, z = (float(part) for part in text.split())
    except ValueError:
        raise RobotDescriptionError(
            f'{where}: <{tag} {name}={shown(text)}>; three numbers are needed'
        ) from None
    if not all(map(math.isfinite, (x, y, z))):
        raise RobotDescriptionError(
            f'{where}: <{tag} {name}={shown(text)}>; three finite numbers are needed'
        )
    return x, y, z


def _number(element: Xml.Element, tag: str, name: str, default: float, where: str) -> float:
    child = element.find(tag)
    text = None if child is None else child.get(name)
    if text is None:
        return default
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if math.isnan(value):
        raise RobotDescriptionError(f'{where}: <{tag} {name}={shown(text)}>; no number')
    return value


def _joint_details(joint: Joint) -> list[str]:
    """What a joint says beyond its place, where it is not the default."""
    if joint.kind == 'fixed':
        return []
    lines = [f'    <axis xyz="{_numbers(joint.axis)}"/>']
    limits = {
        'lower': joint.lower, 'upper': joint.upper, 'effort': joint.effort,
        'velocity': joint.velocity,
    }  # fmt: skip
    stated = ' '.join(f'{k}="{v!r}"' for k, v in limits.items() if math.isfinite(v))
    if stated:
        lines.append(f'    <limit {stated}/>')
    if joint.damping or joint.friction:
        lines.append(f'    <dynamics damping="{joint.damping!r}" friction="{joint.friction!r}"/>')
    if joint.mimic:
        leader, multiplier, offset = joint.mimic
        lines.append(
            f'    <mimic joint={_quoted(leader)} multiplier="{multiplier!r}" offset="{offset!r}"/>'
        )
    return lines


def _numbers(values: Sequence[float]) -> str:
    return ' '.join(repr(float(value)) for value in values)


def _quoted(text: str) -> str:
    escaped = text.replace('&', '&amp;').replace('<', '&lt;').replace('"', '&quot;')
    return f'"{escaped}"'
