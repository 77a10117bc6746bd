"""Command line: a commented model file from a URDF, and from recordings of its joints.

    cg new-robot my.urdf [--joint-states BAG ...] [--out my_robot.yaml]

The file loads as it is. It carries what matters of the URDF; which joints have a drive, what they
measure and how well comes from the recordings, where there are any. robots.md goes on from there.
"""

import argparse
import math
import sys
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np

from cg_description.model_file import FORMAT, Quantity, write_atomically
from cg_description.reading import read_text
from cg_description.robot_description import (
    Joint,
    RobotDescription,
    RobotDescriptionError,
    driven_joints,
    parse,
)
from cg_dynamics.effects import LIBRARY
from cg_dynamics.mechanisms.urdf import BELIEF, Urdf
from cg_dynamics.model import Model
from cg_interfaces import channels
from cg_sysid.cli import common as cli
from cg_sysid.cli.new_model import flow, shortened
from cg_sysid.records.bags import read_bag
from cg_sysid.records.noise import ChannelNoise, measure_noise
from cg_sysid.records.record import Record

HEAD = """\
# A model: every number of a robot, with unit and source. It was written from
# {source}; correct what is not so. The reference of all keys is model_file.md, the way on from
# here is robots.md.
#
# A number is {{value, unit, tolerance, fixed, source}}:
#   tolerance  one standard deviation of what you believe about the value
#   fixed      true: identification leaves the number alone
"""
BODIES = """\
# How far the bodies are from the URDF, which is believed to {belief:.0%}: what is not listed here
# is as there. LINK_mass is a ratio of masses; LINK_shift_x .. z move the centre of mass, in radii
# of gyration; LINK_stretch_x .. z and LINK_shear_xy .. yz change the extent. For example
#   {link}_mass: {{value: 1.05, unit: '1', tolerance: 0.05, source: weighed}}
# Of {count} numbers motions of this robot can show these {free}; the others stay as in the URDF:
"""
EFFECTS = """\
# What the robot has beyond rigid bodies, in the order in which it acts; `at` says at which joint
# or link. A diagnosis finds what is missing by itself.
"""
OTHERS = """\
# Others that a robot can have (effects.md says more). One without `parameters` takes the values at
# which an identification starts.
"""
WIDTH = 99
GUESSED = 'guessed: state the gains of the drive'
DOUBT = 0.5  # of friction in a URDF, relative: it is a guess more often than not
# Effect -> what a URDF's `dynamics` calls its size.
FRICTION = {'viscous_friction': 'damping', 'coulomb_friction': 'friction'}


def template(
    description: RobotDescription,
    driven: Sequence[str] | None,
    records: Sequence[Record],
    source: str,
) -> str:
    """The text of a model file for a robot, with comments.

    Args:
        description: Its links and joints.
        driven: Joints with a drive, as far as is known; None if nothing says.
        records: Recordings of it, of an interface with rates.
        source: Where the description comes from, in words.
    """
    rates = bool(records) and all(
        f'{j.name}_velocity' in r.outputs for r in records for j in description.independent
    )
    body = Urdf(description, driven, rates)
    noises = noise_of(records)
    follows = any(set(record.inputs) & set(record.mechanism.told_names) for record in records)
    effects = [*_effects(body, description, follows)]
    lines = [
        HEAD.format(source=source).rstrip(),
        f'format: {FORMAT}',
        f'name: {description.name}',
        'mechanism: urdf',
        'description: >-',
        '  What this robot is, in a sentence or two.',
        '',
        '# Joints, links and inertias. `driven`: those with a drive. `rates`: whether velocities',
        '# count as measured; one that a driver made of positions does not.',
        'robot:',
        f'  driven: [{", ".join(body.driven)}]',
        f'  rates: {str(body.rates).lower()}',
        '  urdf: |',
        *(f'    {line}' for line in description.text().splitlines()),
        '',
        *_bodies(body),
        '',
        EFFECTS.rstrip(),
        *(['effects:', *effects] if effects else ['effects: []']),
        *_others(body),
        '',
        '# How well each channel measures: the standard deviation of a sample, the smallest step.',
        'sensors:',
    ]
    for channel, unit in zip(body.outputs, body.output_units, strict=True):
        lines += list(_sensor(channel, unit, noises.get(channel)))
    lines += ['', '# What each drive can do: it clips to `limit`.', 'actuators:']
    by_name = {joint.name: joint for joint in description.joints}
    for joint, channel, unit in zip(body.driven, body.inputs, body.input_units, strict=True):
        lines += list(_actuator(by_name[joint], channel, unit))
    lines += ['', 'provenance:   # any keys: who wrote this file, and when', f'  source: {source}',
              '']  # fmt: skip
    return '\n'.join(lines)


def noise_of(records: Sequence[Record]) -> Mapping[str, ChannelNoise]:
    """Noise and resolution of each output: the median of the recordings."""
    found: dict[str, list[ChannelNoise]] = {}
    for record in records:
        for channel, noise in measure_noise(record).items():
            found.setdefault(channel, []).append(noise)
    return {
        channel: ChannelNoise(
            float(np.median([n.sigma for n in each])), float(np.median([n.quantum for n in each]))
        )
        for channel, each in found.items()
    }


def recorded_drives(records: Sequence[Record], body: Urdf) -> list[str]:
    """The joints of a robot on which something acted in recordings."""
    found = []
    for joint, channel in zip(body.driven, body.inputs, strict=True):
        position, _ = body.told(joint)
        acted = (np.any(record.inputs.get(channel, np.zeros(1)) != 0) for record in records)
        told = (np.ptp(record.inputs.get(position, np.zeros(1))) > 0 for record in records)
        if any(acted) or any(told):
            found.append(joint)
    return found


def _bodies(body: Urdf) -> Iterator[str]:
    numbers = [p for p in body.parameters if p.name != 'gravity']
    free = [p.name for p in numbers if p.free]
    link = next((p.name.removesuffix('_mass') for p in numbers if p.name.endswith('_mass')), '')
    yield BODIES.format(
        belief=BELIEF, link=link or 'LINK', count=len(numbers), free=len(free)
    ).rstrip()
    text = ', '.join(free)
    yield from textwrap.wrap(text, WIDTH, initial_indent='#   ', subsequent_indent='#   ')
    yield 'parameters:'
    yield f'  gravity: {flow(Quantity(9.81, "m/s^2", fixed=True, source="standard"))}'


def _effects(body: Urdf, description: RobotDescription, follows: bool) -> Iterator[str]:
    for driven in body.driven if follows else ():
        loop = LIBRARY['position_control'](body, driven)
        gains = {
            p.name: flow(Quantity(p.default, p.unit, p.default, source=GUESSED))
            for p in loop.parameters
        }
        yield f'- name: position_control   # {shortened(loop.summary, loop.name)}'
        if len(body.coordinates) > 1:
            yield f'  at: {driven}'
        yield '  parameters:'
        yield from (f'    {name}: {gain}' for name, gain in gains.items())
    stated = [
        (joint, name, getattr(joint, attribute))
        for joint in description.independent
        for name, attribute in FRICTION.items()
        if getattr(joint, attribute)
    ]
    for joint, name, value in stated:
        size = LIBRARY[name](body, joint.name).parameters[0]
        yield f'- name: {name}   # {shortened(LIBRARY[name].summary, name)}'
        if len(body.coordinates) > 1:
            yield f'  at: {joint.name}'
        q = Quantity(value, size.unit, DOUBT * value, source='dynamics in the URDF')
        yield f'  parameters: {{{size.name}: {flow(q)}}}'


def _others(body: Urdf) -> list[str]:
    names = [name for name, kind in LIBRARY.items() if kind.sites(body)]
    return [OTHERS.rstrip(), *(f'# - name: {n}   # {shortened(LIBRARY[n].summary, n)}'
                               for n in names)]  # fmt: skip


def _sensor(channel: str, unit: str, noise: ChannelNoise | None) -> Iterator[str]:
    yield f'  {channel}:'
    for key, value in (('noise', noise and noise.sigma), ('resolution', noise and noise.quantum)):
        if value:
            q = Quantity(float(f'{value:.3g}'), unit, source='seen in the recordings')
            yield f'    {key}: {flow(q)}'
        else:
            yield f'    # {key}: {{value: ..., unit: {unit}, source: ...}}'


def _actuator(joint: Joint, channel: str, unit: str) -> Iterator[str]:
    yield f'  {channel}:'
    if math.isfinite(joint.effort) and joint.effort > 0:
        q = Quantity(joint.effort, unit, source='effort limit in the URDF')
        yield f'    limit: {flow(q)}'
    else:
        yield f'    # limit: {{value: ..., unit: {unit}, source: ...}}'


def parser() -> argparse.ArgumentParser:
    """The options."""
    made = argparse.ArgumentParser(
        prog='cg new-robot', description='Write a commented model file from a URDF.'
    )
    made.add_argument('urdf', type=Path, help='robot description; of a xacro file, what it makes')
    made.add_argument(
        '--joint-states', nargs='+', metavar='BAG', default=[],
        help='recordings with /joint_states: which joints are driven, and how well they measure',
    )  # fmt: skip
    made.add_argument('--driven', metavar='A,B', help='joints with a drive [from the recordings]')
    made.add_argument(
        '--out', type=Path, metavar='FILE', help='where to write it [standard output]'
    )
    return made


def main(args: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    return cli.run('cg new-robot', work, parser().parse_args(args))


def work(options: argparse.Namespace) -> int:
    """Read, measure, write."""
    xml = read_text(options.urdf, RobotDescriptionError)
    description = parse(xml, str(options.urdf))
    every = Urdf(description, rates=True)
    records = [
        read_bag(path, mechanism=channels.interface(every)) for path in options.joint_states
    ]
    driven = options.driven.split(',') if options.driven else driven_joints(xml)
    if not driven and records:
        driven = recorded_drives(records, every)
    text = template(description, driven or None, records, options.urdf.name)
    Model.from_text(text, str(options.out or 'new robot'))  # what is written loads
    if options.out is None:
        print(text, end='')
        return 0
    if options.out.exists():
        raise ValueError(f'--out {options.out}: exists already; name another file')
    write_atomically(options.out, text)
    print(f'{options.out}: {len(every.coordinates)} joints that move', file=sys.stderr)
    return 0


if __name__ == '__main__':
    sys.exit(main())
