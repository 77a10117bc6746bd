"""Command line: a commented model file from a URDF, and from recordings of its joints.

    cg new-robot my.urdf [--joint-states BAG ...] [--joints A,B] [--out my_robot.yaml]

The file loads as it is. It carries what matters of the URDF; which joints have a drive, what they
measure and how well comes from the recordings, where there are any. Of a hand, a mobile base or a
second arm that somebody holds still the masses count and nothing else. robots.md goes on from
there.
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
    parse,
)
from cg_description.transmissions import couplings, driven_joints
from cg_dynamics.effects import LIBRARY
from cg_dynamics.mechanisms.urdf import BELIEF, Urdf, nearest_real
from cg_dynamics.model import Model
from cg_interfaces import channels
from cg_sysid.cli import common as cli
from cg_sysid.cli.new_model import flow, quoted, shortened
from cg_sysid.records.bags import read_bag, read_raw
from cg_sysid.records.noise import ChannelNoise, measure_noise
from cg_sysid.records.record import Record
from cg_sysid.records.recorded_joints import held_positions, recorded_drives

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
ADDS_UP = 'Drives that add up their errors, PI or PID, have these as well:'
# Friction in a URDF is a guess more often than not, and often a placeholder: so far it may be off,
# relative, and as a share of the largest torque (at the largest rate).
DOUBT, DOUBT_OF_LARGEST = 0.5, 0.05
# Effect -> what a URDF's `dynamics` calls its size.
FRICTION = {'viscous_friction': 'damping', 'coulomb_friction': 'friction'}


def template(
    description: RobotDescription,
    driven: Sequence[str] | None,
    records: Sequence[Record],
    source: str,
    doubts: Sequence[str] = (),
    coupled: Mapping[str, Mapping[str, float]] | None = None,
) -> str:
    """The text of a model file for a robot, with comments.

    Args:
        description: Its links and joints.
        driven: Joints with a drive, as far as is known; None if nothing says.
        records: Recordings of it, of an interface with rates.
        source: Where the description comes from, in words.
        doubts: What somebody should look at in the description, sentences.
        coupled: Motors that turn with several joints, as `Urdf` takes them.
    """
    rates = bool(records) and all(
        f'{j.name}_velocity' in r.outputs for r in records for j in description.independent
    )
    body = Urdf(description, driven, rates, coupled)
    noises = noise_of(records)
    follows = any(set(record.inputs) & set(record.mechanism.told_names) for record in records)
    effects = [*_effects(body, description, follows)]
    lines = [
        HEAD.format(source=source).rstrip(),
        f'format: {FORMAT}',
        f'name: {quoted(description.name)}',
        'mechanism: urdf',
        'description: >-',
        '  What this robot is, in a sentence or two.',
        '',
        '# Joints, links and inertias. `driven`: those with a drive. `rates`: whether velocities',
        '# count as measured; one that a driver made of positions does not.',
        *(line for doubt in doubts for line in _comment(doubt)),
        'robot:',
        f'  driven: [{", ".join(map(quoted, body.driven))}]',
        *_couplings(body),
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
        lines += list(_actuator(by_name.get(joint), channel, unit))
    lines += ['', 'provenance:   # any keys: who wrote this file, and when']
    lines += [f'  source: {quoted(source)}', '']
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


def _comment(text: str) -> list[str]:
    return textwrap.wrap(text, WIDTH, initial_indent='# ', subsequent_indent='#   ')


def _unreal(link: str, before: np.ndarray, after: np.ndarray) -> str:
    """What was wrong with a link, and what stands in its place."""
    was, now = (', '.join(f'{x:.3g}' for x in moments) for moments in (before, after))
    return (
        f'link {link!r}: no body has the inertia that the URDF gives it, principal moments '
        f'{was} kg m^2; the nearest that one has is taken, {now}. Correct it if you can'
    )


def _unstated_friction(body: Urdf) -> list[str]:
    """That every drive rubs, where the URDF says nothing of it."""
    silent = [
        joint.name for joint in body.moving
        if joint.name in body.driven and not joint.damping and not joint.friction
    ]  # fmt: skip
    if not silent:
        return []
    return [
        f'the URDF states no friction of {", ".join(silent)}, and drives have some: let `cg '
        'torques` say how much before you diagnose'
    ]


def _couplings(body: Urdf) -> Iterator[str]:
    if body.couplings:
        yield '  couplings:   # motor -> rad that it turns, behind its gear, per rad of a joint'
    for name, ratios in body.couplings.items():
        turned = ', '.join(f'{quoted(joint)}: {ratio!r}' for joint, ratio in ratios.items())
        yield f'    {quoted(name)}: {{{turned}}}'


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
            yield f'  at: {quoted(driven)}'
        yield '  parameters:'
        yield from (f'    {name}: {gain}' for name, gain in gains.items())
    if follows:
        yield from _comment(ADDS_UP)
        for driven in body.driven:
            at = f', at: {quoted(driven)}' if len(body.coordinates) > 1 else ''
            yield f'# - {{name: integral_control{at}}}'
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
            yield f'  at: {quoted(joint.name)}'
        q = Quantity(value, size.unit, _doubt(joint, name, value), source='dynamics in the URDF')
        yield f'  parameters: {{{size.name}: {flow(q)}}}'


def _doubt(joint: Joint, name: str, value: float) -> float:
    """Standard deviation of what is believed of friction that a URDF states."""
    largest = joint.effort
    if name == 'viscous_friction':
        largest = joint.effort / joint.velocity if joint.velocity > 0 else 0.0
    share = DOUBT_OF_LARGEST * largest if 0 < largest < math.inf else 0.0
    return float(f'{max(DOUBT * value, share):.3g}')


def _others(body: Urdf) -> list[str]:
    names = [name for name, kind in LIBRARY.items() if kind.sites(body)]
    return [OTHERS.rstrip(), *(f'# - name: {n}   # {shortened(LIBRARY[n].summary, n)}'
                               for n in names)]  # fmt: skip


def _sensor(channel: str, unit: str, noise: ChannelNoise | None) -> Iterator[str]:
    yield f'  {quoted(channel)}:'
    for key, value in (('noise', noise and noise.sigma), ('resolution', noise and noise.quantum)):
        if value:
            q = Quantity(float(f'{value:.3g}'), unit, source='seen in the recordings')
            yield f'    {key}: {flow(q)}'
        else:
            yield f'    # {key}: {{value: ..., unit: {unit}, source: ...}}'


def _actuator(joint: Joint | None, channel: str, unit: str) -> Iterator[str]:
    yield f'  {quoted(channel)}:'
    if joint is not None and math.isfinite(joint.effort) and joint.effort > 0:
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
    made.add_argument(
        '--driven', metavar='A,B',
        help='joints with a drive, or motors that joints share [from the recordings]',
    )  # fmt: skip
    made.add_argument(
        '--joints', metavar='A,B',
        help='joints that move, where others are held still: a hand, a base [all]',
    )  # fmt: skip
    made.add_argument(
        '--held', nargs='+', metavar='JOINT=POSITION', default=[],
        help='where others are held, in rad or m [as recorded, else 0]',
    )  # fmt: skip
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
    description, unreal = nearest_real(parse(xml, str(options.urdf)))
    doubts = [_unreal(link, *moments) for link, moments in unreal.items()]
    every = Urdf(description, rates=True)
    raws = [read_raw(path, mechanism=channels.interface(every)) for path in options.joint_states]
    joints = options.joints.split(',') if options.joints else None
    positions = held_positions(every, joints, _stated(options.held), raws)
    if positions:
        description = description.holding(positions)
        every = Urdf(description, rates=True)
        doubts += [f'{name} is held at {at:.6g}' for name, at in positions.items()]
    stated = [name for name in driven_joints(xml) if name in every.coordinates]
    driven = options.driven.split(',') if options.driven else stated
    if not driven and raws:
        driven = recorded_drives(raws, every)
    # A joint that is held couples nothing.
    coupled = {
        motor: ratios
        for motor, ratios in couplings(xml).items()
        if {*ratios} <= {*every.coordinates}
    }
    body = Urdf(description, driven or None, True, coupled)
    records = [read_bag(path, mechanism=channels.interface(body)) for path in options.joint_states]
    doubts += _unstated_friction(body)
    for doubt in doubts:
        print(f'cg new-robot: {doubt}', file=sys.stderr)
    text = template(description, driven or None, records, options.urdf.name, doubts, coupled)
    Model.from_text(text, str(options.out or 'new robot'))  # what is written loads
    if options.out is None:
        print(text, end='')
        return 0
    if options.out.exists():
        raise ValueError(f'--out {options.out}: exists already; name another file')
    write_atomically(options.out, text)
    print(
        f'{options.out}: {len(body.coordinates)} joints that move; {description.root!r} stands '
        'still', file=sys.stderr,
    )  # fmt: skip
    return 0


def _stated(words: Sequence[str]) -> dict[str, float]:
    """Positions that --held states."""
    found = {}
    for word in words:
        name, _, value = word.partition('=')
        try:
            found[name] = float(value)
        except ValueError:
            found[name] = math.nan
        if not math.isfinite(found[name]):
            raise ValueError(f'--held {word}: JOINT=POSITION is needed, in rad or m')
    return found


if __name__ == '__main__':
    sys.exit(main())
