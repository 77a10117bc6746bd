"""Command line: put what was identified into the URDF that a simulator loads.

    cg write-urdf answer/model.yaml my.urdf --out my_identified.urdf

Inertias of links, damping and friction of joints are those of the model; all else of the URDF
stays. What a URDF cannot say is printed: armature, damping and frictionloss as MJCF has them, of
joints and of the tendons that motors shared by several joints are there, and the effects that only
the model file knows.
"""

import argparse
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

from cg_description.model_file import write_atomically
from cg_description.reading import read_text
from cg_description.robot_description import RobotDescriptionError, parse, with_inertials
from cg_dynamics.errors import ModelError
from cg_dynamics.mechanisms.urdf import Urdf, nearest_real
from cg_dynamics.model import Model
from cg_sysid.cli import common as cli
from cg_sysid.cli.new_robot import FRICTION

# Effect -> what a joint and a tendon of MJCF call its size.
MJCF = {
    'viscous_friction': 'damping', 'coulomb_friction': 'frictionloss', 'rotor_inertia': 'armature',
}  # fmt: skip


def written(model: Model, text: str) -> tuple[str, list[str], list[str]]:
    """A URDF with the numbers of a model.

    Args:
        model: Of a URDF with the same joints.
        text: That URDF, shapes and all.

    Returns:
        The URDF, lines of MJCF for joints and tendons, and the labels of effects that neither
        can say.

    Raises:
        ModelError: if the model is of no URDF, of one with other joints, or a link would have to
            weigh less than nothing.
    """
    body = model.mechanism
    if not isinstance(body, Urdf):
        raise ModelError(f'{model.name!r} is a {body.name}; a model of a URDF is needed')
    given, _ = nearest_real(parse(text))
    if [j.name for j in given.joints] != [j.name for j in body.description.joints]:
        raise ModelError(f'{model.name!r} has other joints than the URDF {given.name!r}')
    dynamics: dict[str, dict[str, float]] = {}
    mjcf: dict[str, dict[str, float]] = {name: {} for name in body.all_joints}
    others = []
    for effect in model.effects:
        if effect.name not in MJCF:
            others.append(effect.label)
            continue
        value = model.values_of(effect)[effect.parameters[0].name]
        mjcf[effect.site][MJCF[effect.name]] = value
        if effect.name in FRICTION and effect.site not in body.couplings:
            dynamics.setdefault(effect.site, {})[FRICTION[effect.name]] = value
    lines: list[str] = []
    for name, values in mjcf.items():
        if values:
            lines += _mjcf(name, values, body.couplings.get(name, {}))
    return with_inertials(text, body.inertials(model.values, given), dynamics), lines, others


def _mjcf(name: str, values: Mapping[str, float], ratios: Mapping[str, float]) -> list[str]:
    """A joint, or the tendon that turns with several joints, each by a ratio."""
    said = ' '.join(f'{key}="{value:.6g}"' for key, value in values.items())
    if not ratios:
        return [f'<joint name="{name}" {said}/>']
    turned = [f'  <joint joint="{joint}" coef="{ratio:.6g}"/>' for joint, ratio in ratios.items()]
    return [f'<fixed name="{name}" {said}>', *turned, '</fixed>']


def parser() -> argparse.ArgumentParser:
    """The options."""
    made = argparse.ArgumentParser(
        prog='cg write-urdf', description='Put identified numbers into a URDF.'
    )
    made.add_argument('model', type=Path, help='model file of the robot, as identify writes it')
    made.add_argument('urdf', type=Path, help='the URDF that it was made from')
    made.add_argument('--out', type=Path, required=True, metavar='FILE', help='where to write it')
    return made


def main(args: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    return cli.run('cg write-urdf', work, parser().parse_args(args))


def work(options: argparse.Namespace) -> int:
    """Read, put in, write."""
    text = read_text(options.urdf, RobotDescriptionError)
    urdf, lines, others = written(Model.load(options.model), text)
    if options.out.exists():
        raise ValueError(f'--out {options.out}: exists already; name another file')
    write_atomically(options.out, urdf)
    print('\n'.join(lines))
    if others:
        print(f'in the model file only: {", ".join(others)}', file=sys.stderr)
    return 0


if __name__ == '__main__':
    sys.exit(main())
