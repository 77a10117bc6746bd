"""Robots that nobody drew: random trees of every kind of joint, as URDF."""

import numpy as np


def random_tree(seed: int, moving: int, mimic: bool = False, slide: float = 0.25) -> str:
    """A URDF with so many joints that move, some links fixed in between, branches, odd frames.

    Args:
        seed: Of the numbers.
        moving: Joints that move.
        mimic: Whether the last one follows the first.
        slide: Share of joints that slide.
    """
    random = np.random.default_rng(seed)
    links, joints, moved = ['<link name="base"/>'], [], 0
    names = ['base']
    while moved < moving:
        name, parent = f'link_{len(names)}', str(random.choice(names[-3:]))
        fixed = random.random() < 0.2 and 0 < moved < moving
        turns = 1 - slide
        kind = 'fixed' if fixed else random.choice(
            ['prismatic', 'revolute', 'continuous'], p=[slide, 0.6 * turns, 0.4 * turns]
        )  # fmt: skip
        links.append(_link(random, name))
        follows = mimic and moved == moving - 1
        joints.append(_joint(random, f'joint_{moved}' if not fixed else f'weld_{len(names)}',
                             kind, parent, name, 'joint_0' if follows else None))  # fmt: skip
        moved += not fixed
        names.append(name)
    return '\n'.join(['<robot name="tree">', *links, *joints, '</robot>'])


def _numbers(values) -> str:
    return ' '.join(repr(float(x)) for x in values)


def _link(random: np.random.Generator, name: str) -> str:
    mass, points = random.uniform(0.3, 4.0), random.normal(0, 0.1, (9, 3))
    second = mass * points.T @ points / len(points)
    i = (np.trace(second) * np.eye(3) - second).tolist()
    return (
        f'<link name="{name}"><inertial><mass value="{mass!r}"/>'
        f'<origin xyz="{_numbers(random.normal(0, 0.1, 3))}" '
        f'rpy="{_numbers(random.uniform(-3, 3, 3))}"/>'
        f'<inertia ixx="{i[0][0]!r}" iyy="{i[1][1]!r}" izz="{i[2][2]!r}" ixy="{i[0][1]!r}" '
        f'ixz="{i[0][2]!r}" iyz="{i[1][2]!r}"/></inertial></link>'
    )


def _joint(random, name, kind, parent, child, leader) -> str:
    follow = f'<mimic joint="{leader}" multiplier="-0.7" offset="0.2"/>' if leader else ''
    limit = '<limit lower="-9" upper="9" effort="100" velocity="9"/>'
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="{_numbers(random.normal(0, 0.2, 3))}" '
        f'rpy="{_numbers(random.uniform(-3, 3, 3))}"/>'
        f'<axis xyz="{_numbers(random.normal(0, 1, 3))}"/>{limit}{follow}</joint>'
    )
