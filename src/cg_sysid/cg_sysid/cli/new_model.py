"""Command line: a commented model file to start from.

    cg new-model MECHANISM > my_robot.yaml

The file loads as it is. It holds every key that this mechanism can have, with unit and range; its
numbers are those of a model that comes along, to be replaced. model_file.md is the reference.
"""

import argparse
import sys
import textwrap
from collections.abc import Mapping, Sequence

import yaml

from cg_description.model_file import ACTUATOR, FORMAT, SENSOR, Quantity
from cg_description.paths import models_directory
from cg_dynamics.effects import LIBRARY
from cg_dynamics.effects.effect import Effect
from cg_dynamics.mechanisms import MECHANISMS, Mechanism, mechanism
from cg_dynamics.model import Model
from cg_dynamics.parameter import Parameter
from cg_sysid.cli import common as cli

WIDTH = 99
HEAD = """\
# A model: every number of a robot, with unit and source. Replace what stands here, which is
# {example}, a model that comes along; its own file says where the numbers are from.
#
# A number is {{value, unit, tolerance, fixed, source}}:
#   tolerance  one standard deviation of what you believe about the value
#   fixed      true: identification leaves the number alone
#   source     where the number comes from: scales, a data sheet, assumed
# The reference of all keys is model_file.md.
"""
EFFECTS = """\
# What the robot has beyond rigid bodies, in the order in which it acts. `at` says at which joint,
# body or sensor, where it is not the usual one. A diagnosis finds what is missing by itself.
"""
OTHERS = """\
# The others that this mechanism can have (effects.md says more). One without `parameters`
# takes the values at which an identification starts.
"""
SENSORS = """\
# How well each output channel measures: the standard deviation of a sample, and the smallest step.
"""
ACTUATORS = """\
# What the drive of each input channel can do: it clips to `limit`, and controllers stay below.
"""


def template(name: str) -> str:
    """The text of a model file for the mechanism of that name, with comments.

    Raises:
        ModelError: There is no such mechanism; those there are are listed.
    """
    body = mechanism(name)
    example = example_of(body)
    others = ', '.join(other for other in MECHANISMS if other != name)
    lines = [
        HEAD.format(example=example.name).rstrip(),
        f'format: {FORMAT}',
        f'name: my_{name}',
        f'mechanism: {name}   # others: {others}',
        'description: >-',
        '  What this robot is, in a sentence or two.',
        '',
        'parameters:',
    ]
    for p in body.parameters:
        lines += [f'  # {_meaning(p)}', f'  {p.name}: {_quantity(example, p.name)}']
    lines += ['', EFFECTS.rstrip(), 'effects:']
    for effect in example.effects:
        lines += _effect(example, effect)
    lines += [*_others(body, example), '', SENSORS.rstrip(), 'sensors:']
    for channel, unit in zip(body.outputs, body.output_units, strict=True):
        lines += _entries(channel, SENSOR.keys, example.sensors.get(channel, {}), unit, example)
    lines += ['', ACTUATORS.rstrip(), 'actuators:']
    for channel, unit in zip(body.inputs, input_units(body), strict=True):
        given = example.actuators.get(channel, {})
        lines += _entries(channel, ACTUATOR.keys, given, unit, example)
    lines += ['', 'provenance:   # any keys: who wrote this file, and when', '  source: ...', '']
    return '\n'.join(lines)


def example_of(body: Mechanism) -> Model:
    """The plainest model of a mechanism that comes along, of a machine with sensors."""
    models = [Model.load(path) for path in sorted(models_directory().glob('*.yaml'))]
    own = (model for model in models if model.mechanism is body)
    return min(own, key=lambda model: (not model.sensors, len(model.effects)))


def input_units(body: Mechanism) -> list[str]:
    """Unit of each input channel."""
    return ['N m'] * len(body.inputs)


def _meaning(p: Parameter) -> str:
    left = '' if p.free else '; not identified unless told'
    return f'{p.description}; {p.lower:g} to {p.upper:g} {p.unit}{left}'


def _quantity(example: Model, name: str) -> str:
    q = example.quantities[name]
    return flow(Quantity(q.value, q.unit, q.tolerance, q.fixed, example.name))


def flow(q: Quantity) -> str:
    """A number as one line of YAML."""
    text = yaml.safe_dump(q.to_yaml(), default_flow_style=True, sort_keys=False, width=10 * WIDTH)
    return text.strip()


def quoted(name: str) -> str:
    """A name as YAML reads it back: in quotes where it needs them."""
    text = yaml.safe_dump(
        [name], default_flow_style=True, allow_unicode=True, width=2 * len(name) + WIDTH
    )
    return text.strip()[1:-1]


def _effect(example: Model, effect: Effect) -> list[str]:
    lines = [f'- name: {effect.name}   # {shortened(effect.summary, effect.name)}']
    if effect.at:
        lines.append(f'  at: {effect.at}')
    lines.append('  parameters:')
    for p in effect.parameters:
        lines.append(f'    # {_meaning(p)}')
        lines.append(f'    {p.name}: {_quantity(example, f"{effect.label}.{p.name}")}')
    return lines


def _others(body: Mechanism, example: Model) -> list[str]:
    present = {effect.name for effect in example.effects}
    names = [n for n, effect in LIBRARY.items() if n not in present and effect.sites(body)]
    return [
        OTHERS.rstrip(),
        *(f'# - name: {name}   # {shortened(LIBRARY[name].summary, name)}' for name in names),
    ]


def shortened(summary: str, name: str) -> str:
    """What an effect does, as far as it fits behind its name."""
    return textwrap.shorten(summary, WIDTH - len(f'# - name: {name}   # '), placeholder=' ...')


def _entries(
    channel: str, keys: Mapping, given: Mapping[str, Quantity], unit: str, example: Model
) -> list[str]:
    """The quantities of a channel; what the example does not state is left to fill in."""
    lines = [f'  {channel}:']
    for key in keys:
        if key in given:
            q = given[key]
            stated = Quantity(q.value, q.unit, q.tolerance, q.fixed, example.name)
            lines.append(f'    {key}: {flow(stated)}')
        else:
            lines.append(f'    # {key}: {{value: ..., unit: {unit}, source: ...}}')
    return lines


def parser() -> argparse.ArgumentParser:
    """The options."""
    made = argparse.ArgumentParser(
        prog='cg new-model', description='Write a commented model file to start from.'
    )
    made.add_argument('mechanism', help=f'one of {", ".join(MECHANISMS)}')
    return made


def main(args: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    return cli.run('cg new-model', work, parser().parse_args(args))


def work(options: argparse.Namespace) -> int:
    """Print the file."""
    print(template(options.mechanism), end='')
    return 0


if __name__ == '__main__':
    sys.exit(main())
