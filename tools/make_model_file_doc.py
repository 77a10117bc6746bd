"""Write model_file.md from schema and mechanisms: python tools/make_model_file_doc.py."""

import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
TARGET = ROOT / 'docs/reference/model_file.md'

INTRODUCTION = """\
# The model file

One YAML file holds every number of a robot, with unit and source. Simulated hardware, observer,
controllers, planner, identification and diagnosis read the same file, and a diagnosis writes a new
one. This page is written by `tools/make_model_file_doc.py`; do not edit it.

    cg new-model pendulum > my_robot.yaml

writes a commented file for a mechanism, which loads as it is. The files that come along are in
`src/cg_description/models`. This is one of them:
"""
RULES = """\
## How it is read
A mistake gets one line that names file, path, what stands there and what is allowed, such as
`my_robot.yaml: effects[2].parameters.mass.value: 'abc' is no number`. Refused are unknown keys,
keys that stand twice, a second document, tags such as `!!python/name`, text that is not UTF-8, and
numbers in quotes. `1e-3` is a number here, though YAML 1.1 takes it for text; dates, octal
(`0o17`) and sexagesimal (`1:30`) numbers are text. An empty entry counts as absent. The limits are
{size:g} MB, {nodes} values and {depth} levels; an alias counts as often as it is used. The same
reader and the same rules hold for recording notes, set-ups, mappings and experiments, and, with
larger limits, for JSON.
"""


def cell(text: str) -> str:
    """A text as a cell of a table."""
    return text.replace('|', '\\|')


def default_of(key) -> str:
    """The default of a key, in words."""
    from cg_description.schema import NEEDED

    if key.default is NEEDED:
        return 'needed'
    if key.default is None or key.default in ('', (), {}):
        return 'none'
    return str(key.default).lower()


def kind_of(key, names) -> str:
    """The kind of a key, with a link to the section that explains it."""
    from cg_description.schema import ListOf, MapOf

    words, kind = key.kind.words, key.kind
    while isinstance(kind, ListOf | MapOf):
        kind = kind.kind
    for name, schema in names.items():
        if kind is schema:
            whole = {ListOf: f'list of [{name}s](#{name})', MapOf: f'names -> [{name}](#{name})'}
            return whole.get(type(key.kind), f'[{name}](#{name})')
    return words


def table(schema, names) -> list[str]:
    """The keys of a mapping."""
    lines = ['| key | type | unit | default | meaning |', '|---|---|---|---|---|']
    for name, key in schema.keys.items():
        lines.append(
            f'| `{name}` | {cell(kind_of(key, names))} | {key.unit or "-"} | {default_of(key)} '
            f'| {cell(key.meaning)} |'
        )
    return [*lines, '']


def mechanism_section(body) -> list[str]:
    """What a mechanism needs: its parameters and channels."""
    from cg_sysid.cli.new_model import example_of, input_units

    lines = [
        f'### `{body.name}`',
        f'Coordinates {", ".join(f"`{q}`" for q in body.coordinates)}; bodies '
        f'{", ".join(f"`{b}`" for b in body.bodies)}; joints '
        f'{", ".join(f"`{j}`" for j in body.joints)}. A file with its numbers: '
        f'`{example_of(body).name}`.',
        '',
        '| parameter | unit | default | meaning | range | identified |',
        '|---|---|---|---|---|---|',
    ]
    for p in body.parameters:
        lines.append(
            f'| `{p.name}` | {p.unit} | needed | {p.description} | {p.lower:g} to {p.upper:g} '
            f'| {"yes" if p.free else "no"} |'
        )
    lines += ['', '| channel | | unit |', '|---|---|---|']
    for channel, unit in zip(body.inputs, input_units(body), strict=True):
        lines.append(f'| `{channel}` | input, for `actuators` | {unit} |')
    for channel, unit in zip(body.outputs, body.output_units, strict=True):
        kind = body.sensor_kinds[channel]
        lines.append(f'| `{channel}` | output of the {kind}, for `sensors` | {unit} |')
    return [*lines, '']


def robots_section() -> list[str]:
    """The same of robots by their URDF."""
    from cg_dynamics.mechanisms.urdf import NUMBERS

    return [
        '### `urdf`',
        'A robot by its URDF ([robots](../how_to/robots.md)). Its coordinates and joints are '
        'those of the URDF that move by themselves. LINK is the child link of a joint that moves.',
        '',
        '| parameter | unit | default | meaning | range | identified |',
        '|---|---|---|---|---|---|',
        *(
            f'| `LINK_{name}` | 1 | {neutral:g} | {meaning} | {low:g} to {high:g} | where motions '
            'show it |'
            for name, meaning, neutral, (low, high) in NUMBERS
        ),
        '| `gravity` | m/s^2 | 9.81 | acceleration of gravity | 0 to 30 | no |',
        '',
        '| channel | | unit |',
        '|---|---|---|',
        '| `JOINT_effort` | input of a driven joint, for `actuators` | N m; N where it slides |',
        '| `JOINT_position` | output of the encoder, for `sensors` | rad; m |',
        '| `JOINT_velocity` | output of the tachometer, with `rates: true` | rad/s; m/s |',
        '',
    ]


def page() -> str:
    """The whole page."""
    from cg_description.model_file import ACTUATOR, EFFECT, QUANTITY, ROBOT, SCHEMA, SENSOR
    from cg_description.paths import model_path
    from cg_description.reading import YAML
    from cg_dynamics.mechanisms import MECHANISMS

    names = {
        'quantity': QUANTITY, 'effect': EFFECT, 'sensor': SENSOR, 'actuator': ACTUATOR,
        'robot': ROBOT,
    }  # fmt: skip
    lines = [
        INTRODUCTION,
        '```yaml', model_path('sydney_pendulum').read_text('utf-8').rstrip(), '```', '',
        '## The file', *table(SCHEMA, names),
    ]  # fmt: skip
    for name, schema in names.items():
        lines += [f'### {name.capitalize()}', *table(schema, names)]
    lines += [
        'An effect may have the parameters that [effects.md](effects.md) lists, in the units '
        'given there, each within its range;',
        'one that is absent takes the first value of "identification starts at". The same effect '
        'may stand there once for each `at`.',
        '',
        '## Mechanisms',
        'All parameters are needed, but for those of `urdf`. What they mean together, and which '
        'values no real bodies can have, is in [conventions.md](conventions.md).',
        '',
    ]
    for body in MECHANISMS.values():
        lines += mechanism_section(body)
    lines += robots_section()
    lines.append(RULES.format(size=YAML.size / 1e6, nodes=YAML.nodes, depth=YAML.depth))
    return '\n'.join(lines).rstrip() + '\n'


if __name__ == '__main__':
    packages = ('cg_sysid', 'cg_estimation', 'cg_dynamics', 'cg_description')
    sys.path[:0] = [str(ROOT / 'src' / name) for name in packages]
    TARGET.write_text(page(), encoding='utf-8')
