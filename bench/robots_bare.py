"""What `cg torques` says of robots of which the URDF knows the bodies and nothing else.

    ./cg exec python bench/robots_bare.py [ROBOT ...] [--write bench/results/robots_bare.md]

Most URDFs that robots come with say nothing of friction, and none of rotors. The robots are those
of robots.py: in MuJoCo they have the friction of their own URDF at each joint, and a rotor at each
drive, a tenth to a half of what the joint turns. The URDF that their owner has says neither, and
its masses, centres and inertias are 5 to 12 % off.

A law that the machine has counts as told, as missing, or as told by another law of the same joint.
Each robot has all cores, and its time is that of a clock.
"""

import argparse
import os
import re
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from robots import Case, known_urdf, version, written
from robots_machines import ROBOTS, Robot, Secret

from cg_description.robot_description import parse
from cg_dynamics.effects import LIBRARY
from cg_dynamics.mechanisms.urdf import Urdf
from cg_dynamics.model import Model
from cg_sysid.checks.loading import load_bags
from cg_sysid.diagnosis.diagnose import split
from cg_sysid.identification.data_set import prepare
from cg_sysid.parallel import run_all
from cg_sysid.search.torque_selection import TorqueSelection, select

ROTOR = 0.1, 0.5  # of the inertia that a joint turns, at least and at most


def machine(robot: Robot) -> tuple[Secret, dict[str, float]]:
    """Its rotors, and all that its owner does not know: label -> size."""
    body = Urdf(parse(robot.urdf), robot.driven)
    random = np.random.default_rng([41, list(ROBOTS).index(robot.name)])
    rotors = {
        joint: float(body.inertia_at(joint) * random.uniform(*ROTOR)) for joint in robot.driven
    }
    sizes = [('rotor_inertia', joint, inertia) for joint, inertia in rotors.items()]
    for joint in body.description.independent:
        sizes.append(('viscous_friction', joint.name, joint.damping))
        sizes.append(('coulomb_friction', joint.name, joint.friction))
    lacks = {LIBRARY[name](body, joint).label: size for name, joint, size in sizes if size}
    return Secret(armature=rotors), lacks


def sound(robot: Robot) -> Case:
    """The case whose numbers its owner has."""
    return Case(robot.name, 'sound', 0, '', False)


def bare_urdf(robot: Robot) -> str:
    """The URDF as its owner has it."""
    return re.sub(r'<dynamics [^>]*/>', '', known_urdf(sound(robot)))


def said(model_file: Path, bags: Sequence[Path]) -> TorqueSelection:
    """What `cg torques` finds, on all cores."""
    model = Model.load(model_file)
    loaded = load_bags(bags, model_file, whole=True)
    train, held = split(prepare(model, loaded.records))
    workers = os.cpu_count() or 1
    return select(
        model, train, held, None,
        lambda function, arguments, _: run_all(function, arguments, workers),
    )  # fmt: skip


def told(robot: Robot) -> tuple[TorqueSelection, dict[str, float], float]:
    """What the torques say, what the machine has, and the seconds that it took."""
    secret, lacks = machine(robot)
    with tempfile.TemporaryDirectory() as folder:
        model_file, bags = written(
            robot, secret, bare_urdf(robot), sound(robot).seed, Path(folder)
        )
        began = time.monotonic()
        return said(model_file, bags), lacks, time.monotonic() - began


def rows_of(robot: Robot) -> tuple[str, list[str]]:
    """Of the table of robots, and of that of laws."""
    found, lacks, seconds = told(robot)
    sizes = {law.label: next(iter(law.parameters.values())) for law in found.laws}
    site = {label: label.partition('@')[2] for label in (*lacks, *sizes)}
    right = [label for label in lacks if label in sizes]
    others = [label for label in sizes if label not in lacks]
    missing = [label for label in lacks if label not in sizes]
    off = [abs(sizes[label][0] / lacks[label] - 1) for label in right]
    before, after = (float(np.nanmax(x)) for x in (found.identified, found.extended))
    summary = (
        f'| {robot.name} | {len(robot.joints)} | {len(lacks)} | {len(right)} | {len(others)} '
        f'| {100 * np.median(off):.1f} | {100 * max(off, default=np.nan):.0f} '
        f'| {100 * before:.2g} '
        f'| {100 * after:.2g} | {seconds:.0f} |'
    )
    lines = [
        f'| {robot.name} | {label} | {lacks[label]:.4g} | {sizes[label][0]:.4g} '
        f'| {sizes[label][1]:.1g} |' for label in right
    ]  # fmt: skip
    for label in missing:
        instead = ', '.join(o for o in others if site[o] == site[label]) or 'none'
        lines.append(f'| {robot.name} | {label} | {lacks[label]:.4g} | missing: {instead} | |')
    lines += [
        f'| {robot.name} | {label} | none | {sizes[label][0]:.4g} | {sizes[label][1]:.1g} |'
        for label in others if all(site[m] != site[label] for m in missing)
    ]  # fmt: skip
    return summary, lines


def main() -> int:
    """Run the robots, and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('robots', nargs='*', default=list(ROBOTS))
    parser.add_argument('--write', type=Path)
    options = parser.parse_args()
    rows = []
    for name in options.robots:
        rows.append(rows_of(ROBOTS[name]))
        print(rows[-1][0], flush=True)
    text = '\n'.join([
        '# Robots of which the URDF knows the bodies and nothing else',
        '',
        f'Command: `./cg exec python bench/robots_bare.py`. Sources {version()}. The error is '
        'that of the joint with the largest, of recordings held out.',
        '',
        '| robot | joints | laws that it lacks | told | others told | size off, %: median | worst '
        '| torque error, %: identified | with the laws | s on 2 cores |',
        '|---|---:|---:|---:|---:|---:|---:|---:|---:|---:|',
        *(summary for summary, _ in rows),
        '',
        '| robot | law | the machine has | told | +- |',
        '|---|---|---:|---:|---:|',
        *(line for _, lines in rows for line in lines),
    ]) + '\n'  # fmt: skip
    print(text)
    if options.write:
        options.write.write_text(text)
    return 0


if __name__ == '__main__':
    sys.exit(main())
