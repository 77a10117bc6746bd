"""Write docs/reference/effects.md from the effect library: python tools/make_effects_doc.py."""

import math
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
TARGET = ROOT / 'docs/reference/effects.md'

PLACES = {
    'command': 'between the torque that the drive reports and the motor',
    'transmission': 'between motor and joint',
    'joint': 'at the joint',
    'body': 'on a body',
    'environment': 'around the robot',
    'impact': 'when a foot lands',
    'sensor': 'in a sensor',
    'timing': 'in time',
}

FRICTION = {
    'dry': 'dry friction; linear designs leave it out',
    'viscous': 'viscous friction; linear designs keep it',
}


def number(value: float) -> str:
    """A number as it stands in a model file."""
    if math.isinf(value):
        return 'infinite'
    return f'{value:g}'


def section(effect, mechanisms) -> list[str]:
    """The part of the page about one effect."""
    from cg_dynamics.effects.effect import CLOCKS

    sites = {name: effect.sites(mechanism) for name, mechanism in mechanisms.items()}
    where = '; '.join(
        f'{name}: {", ".join(f"`{site}`" for site in found)}'
        for name, found in sites.items()
        if found and found != ('all',)
    )
    plain = [name for name, found in sites.items() if found == ('all',)]
    if plain:
        where = '; '.join(filter(None, [where, f'as a whole: {", ".join(plain)}']))
    lines = [
        f'### `{effect.name}`',
        effect.summary,
        '',
        f'Acts {PLACES[effect.place]}. '
        + (f'Sites, the usual one first: {where}.' if where else 'Only in robots of a URDF.'),
    ]
    if effect.states:
        lines.append(f'Extra states: {", ".join(f"`{state}`" for state in effect.states)}.')
    recorded = [name for name in effect.extra_inputs if name not in CLOCKS]
    if recorded:
        names = ', '.join(f'`{name}`' for name in recorded)
        lines.append(f'Needs in the recording: {names}.')
    if effect.friction:
        lines.append(f'For controllers: {FRICTION[effect.friction]}.')
    if effect.ripple:
        lines.append('For controllers: a ripple; linear designs leave it out.')
    if math.isfinite(effect.largest_step):
        lines.append(f'Longest step of integration: {1e3 * effect.largest_step:g} ms.')
    lines += [
        '',
        '| parameter | unit | meaning | range | vanishes at | identification starts at | free |',
        '|---|---|---|---|---|---|---|',
    ]
    for p in effect.parameters:
        starts = ', '.join(map(number, p.starts)) or '-'
        neutral = '-' if p.neutral is None else number(p.neutral)
        free = 'yes' if p.free else 'shape' if p.leeway else 'choice' if p.choice else 'no'
        unit = f'{p.unit} ({p.along})' if p.along else p.unit
        lines.append(
            f'| `{p.name}` | {unit} | {p.description} | {number(p.lower)} to {number(p.upper)} '
            f'| {neutral} | {starts} | {free} |'
        )
    return [*lines, '']


def page() -> str:
    """The whole page."""
    from cg_dynamics.effects import LIBRARY
    from cg_dynamics.mechanisms import MECHANISMS
    from cg_dynamics.parameter import SLIDING

    sliding = ', '.join(f'{turning} becomes {slid}' for turning, slid in SLIDING.items())
    lines = [
        '# Effects',
        '',
        'Every effect of the library. This page is written by `tools/make_effects_doc.py`; do not '
        'edit it.',
        '',
        'A model file lists the effects that a robot has, in the order in which they act; '
        'diagnosis tries all of them. At the value in the column "vanishes at" the effect is not '
        'there at all. At a joint of a URDF, effects with states start at so many times the '
        'inertia that it turns, in kg m^2, where the unit has a torque or a mass. '
        '"Free: no" marks parameters that identification leaves alone unless told; '
        '"shape" those of the shape of a law, which a diagnosis lets go within bounds, '
        '"choice" one that stays at that of its starts which explains most. A new effect is '
        'one class in one file of `src/cg_dynamics/cg_dynamics/effects`.',
        '',
        'Units are those of a joint that turns. At a joint that slides, and in a sensor that '
        f'reads a length, {sliding}: friction in N m s/rad is one in N s/m there. Where that is '
        'not so, the unit at such a joint is in brackets.',
        '',
    ]
    for place, words in PLACES.items():
        found = [effect for effect in LIBRARY.values() if effect.place == place]
        if found:
            lines += [f'## {place.capitalize()}: {words}', '']
            for effect in found:
                lines += section(effect, MECHANISMS)
    return '\n'.join(lines).rstrip() + '\n'


if __name__ == '__main__':
    sys.path[:0] = [str(ROOT / 'src' / name) for name in ('cg_dynamics', 'cg_description')]
    TARGET.write_text(page(), encoding='utf-8')
