"""The compass gait as URDF, built from its model file: shapes to look at, inertias that fit.

    world --x, z--> inner foot --q_inner--> inner_leg --hip--> outer_leg
                                            inner_leg --hip/2--> hip_body

`hip` is the joint that the encoder measures, q_inner - q_outer, so it turns the outer legs
backward; the hip body follows at half of it and so bisects the legs. The model file holds lumps,
which many bodies share (theory.md, LUMPS); the masses here are one choice that has them.
"""

import math
from xml.sax.saxutils import quoteattr

from cg_description.model_file import ModelFile, ModelFileError

JOINTS = ('x', 'z', 'q_inner', 'hip')


def joint_positions(
    q_inner: float, q_outer: float, stance: str, leg_length: float, foot_x: float = 0.0
) -> dict[str, float]:
    """Positions of the URDF's joints in m and rad.

    Args:
        q_inner: Angle of the inner legs in rad.
        q_outer: Angle of the outer legs in rad.
        stance: 'inner' or 'outer'.
        leg_length: In m.
        foot_x: Where the stance foot is on level ground in m.
    """
    x, z = foot_x, 0.0
    if stance == 'outer':
        x += leg_length * (math.sin(q_outer) - math.sin(q_inner))
        z += leg_length * (math.cos(q_outer) - math.cos(q_inner))
    return {'x': x, 'z': z, 'q_inner': q_inner, 'hip': q_inner - q_outer}


def bodies(file: ModelFile) -> dict[str, tuple[float, float, float]]:
    """Body -> (mass in kg, centre above the hip in m, inertia about it in kg m^2).

    The three bodies share what mass their lumps leave open, so none is left at the hip.
    """
    p = {name: q.value for name, q in file.parameters.items()}
    l, mt = p['leg_length'], p['total_mass']
    # Inertia about the hip and first moment, above positive, in units of mt l^2 and mt l.
    lumps = {
        'inner_leg': (p['c1'] - p['c3'], -p['c4']),
        'outer_leg': (p['c2'] - p['c3'], -p['c5']),
        'hip_body': (4 * p['c3'], 4 * p['c6']),
    }
    least = {name: moment**2 / inertia for name, (inertia, moment) in lumps.items()}
    slack = 1 - sum(least.values())
    if min(inertia for inertia, _ in lumps.values()) <= 0 or slack <= 0:
        raise ModelFileError(f'{file.name}: no real bodies have these lumps')
    found = {}
    for name, (inertia, moment) in lumps.items():
        share = least[name] + slack / 3
        found[name] = (
            mt * share,
            l * moment / share,
            mt * l**2 * (inertia - moment**2 / share),
        )
    return found


def urdf(file: ModelFile) -> str:
    """URDF text of a compass gait.

    Raises:
        ModelFileError: if the model is not a compass gait of real bodies.
    """
    if file.mechanism != 'compass_gait':
        raise ModelFileError(f'{file.name}: the URDF is that of a compass gait')
    l = file.parameters['leg_length'].value
    found = bodies(file)
    legs = {
        # (colour, places across of the two legs of a pair in m)
        'inner_leg': ('0.85 0.45 0.1 1', (-0.08, 0.08)),
        'outer_leg': ('0.1 0.4 0.75 1', (-0.2, 0.2)),
    }
    lines = [
        '<?xml version="1.0"?>',
        f'<!-- Written by tools/make_urdf.py from the model file of {file.name}. -->',
        f'<robot name={quoteattr(file.name)}>',
        *('  <link name="world"/>', '  <link name="x_slide"/>', '  <link name="inner_ground"/>'),
        _joint('x', 'prismatic', 'world', 'x_slide', (0, 0, 0), (1, 0, 0), 1e3),
        _joint('z', 'prismatic', 'x_slide', 'inner_ground', (0, 0, 0), (0, 0, 1), 1e3),
        # The link's origin is the hip end; the joint is at the foot end.
        '  <link name="inner_pivot"/>',
        _joint('q_inner', 'continuous', 'inner_ground', 'inner_pivot', (0, 0, 0), (0, 1, 0)),
        _fixed('inner_hip', 'inner_pivot', 'inner_leg', (0, 0, l)),
        *(_leg(name, l, *legs[name], found[name]) for name in legs),
        _hip_body(found['hip_body'], legs['outer_leg'][1]),
        _joint('hip', 'continuous', 'inner_leg', 'outer_leg', (0, 0, 0), (0, -1, 0)),
        _joint(
            'hip_half', 'continuous', 'inner_leg', 'hip_body', (0, 0, 0), (0, -1, 0),
            mimic='<mimic joint="hip" multiplier="0.5"/>',
        ),
        *(_foot(leg, l) for leg in ('inner', 'outer')),
        '  <link name="imu_link"/>',
        _fixed('imu', 'inner_leg', 'imu_link', (0, 0, -0.1)),
        '</robot>',
        '',
    ]  # fmt: skip
    return '\n'.join(lines)


def _numbers(values) -> str:
    return ' '.join(f'{value:.6g}' for value in values)


def _joint(name, kind, parent, child, origin, axis, reach=None, mimic='') -> str:
    limit = (
        '' if reach is None
        else f'<limit lower="{-reach:g}" upper="{reach:g}" effort="0" velocity="100"/>'
    )  # fmt: skip
    return (
        f'  <joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="{_numbers(origin)}"/><axis xyz="{_numbers(axis)}"/>{limit}{mimic}</joint>'
    )


def _fixed(name, parent, child, origin) -> str:
    return (
        f'  <joint name="{name}" type="fixed"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="{_numbers(origin)}"/></joint>'
    )


def _foot(leg: str, l: float) -> str:
    return f'  <link name="{leg}_foot"/>\n' + _fixed(
        f'{leg}_foot', f'{leg}_leg', f'{leg}_foot', (0, 0, -l)
    )


def _inertial(body) -> str:
    mass, height, inertia = body
    # The motion is planar: only the inertia about y matters; the others make it a real body.
    return (
        f'<inertial><origin xyz="0 0 {height:.12g}"/><mass value="{mass:.12g}"/>'
        f'<inertia ixx="{inertia:.12g}" iyy="{inertia:.12g}" izz="{inertia:.12g}" '
        'ixy="0" ixz="0" iyz="0"/></inertial>'
    )


def _visual(place, shape: str, colour: str, turn=(0, 0, 0)) -> str:
    return (
        f'    <visual><origin xyz="{_numbers(place)}" rpy="{_numbers(turn)}"/>'
        f'<geometry>{shape}</geometry>'
        f'<material name="{colour}"><color rgba="{colour}"/></material></visual>'
    )


def _leg(name: str, l: float, colour: str, across, body) -> str:
    parts = [f'  <link name="{name}">', f'    {_inertial(body)}']
    for y in across:
        tube = f'<cylinder radius="0.018" length="{l:.6g}"/>'
        parts.append(_visual((0, y, -l / 2), tube, colour))
        parts.append(_visual((0, y, -l), '<sphere radius="0.025"/>', '0.15 0.15 0.15 1'))
    return '\n'.join([*parts, '  </link>'])


def _hip_body(body, across) -> str:
    quarter = 1.5707963
    length = across[1] - across[0] + 0.05
    axle = f'<cylinder radius="0.022" length="{length:.6g}"/>'
    return '\n'.join(
        [
            '  <link name="hip_body">',
            f'    {_inertial(body)}',
            _visual((0, 0, 0), axle, '0.5 0.5 0.5 1', (quarter, 0, 0)),
            _visual((0, 0, 0.06), '<box size="0.12 0.1 0.1"/>', '0.3 0.3 0.3 1'),
            '  </link>',
        ]
    )
