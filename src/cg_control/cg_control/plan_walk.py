"""Plan a tree that walks: orbits at several speeds, steps in, changes of speed, stops.

    python -m cg_control.plan_walk --speeds 0.2 0.25 0.3 --step 0.3 --out walk.npz

What the tree controller needs to walk: walking.md. Planning takes some seconds a speed.
"""

import argparse
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from cg_control.following.nodes import Nodes
from cg_control.grow_tree import upright_tree
from cg_control.orbits.orbit import Orbit, plan_orbit
from cg_control.trajectories.collocation import PlanningError
from cg_control.trees.preview import pruned
from cg_control.trees.tree import Tree, TreeError
from cg_control.walking.walking_tree import orbit_nodes, with_orbits, with_ways
from cg_description.paths import model_path
from cg_dynamics.model import Model

SPEEDS = (0.2, 0.25, 0.3, 0.35)  # m/s
STEP = 0.3  # m


def walking_tree(
    model: Model, speeds: Sequence[float] = SPEEDS, step: float = STEP, base: Tree | None = None
) -> Tree:
    """A tree that stands on either leg and walks at these speeds.

    Args:
        model: A compass gait.
        speeds: In m/s, increasing.
        step: Step length, m.
        base: A tree to upright that brings more states home; None: upright alone.

    Raises:
        PlanningError: There is no orbit for a speed.
        TrajectoryError: An orbit holds hardly a robot, or no way leads to one.
    """
    if sorted(set(speeds)) != list(speeds) or not speeds or not speeds[0] > 0:
        raise ValueError(f'speeds are {list(speeds)}; they must be positive and increasing, m/s')
    orbits: list[Nodes] = []
    near: Orbit | None = None
    for speed in speeds:
        near = plan_orbit(model, speed, step, near=near)
        if near.problem:
            raise ValueError(f'{speed:g} m/s in steps of {step:g} m: {near.problem}')
        orbits.append(orbit_nodes(model, near))
        print(
            f'plan_walk: {speed:g} m/s: period {near.period:.3f} s, largest torque '
            f'{near.peak_torque:.1f} N m, cost of transport {near.cost_of_transport:.3f}',
            file=sys.stderr, flush=True,
        )  # fmt: skip
    return with_ways(with_orbits(base or upright_tree(model), orbits, speeds), model)


def main(args: list[str] | None = None) -> int:
    """Entry point of `ros2 run cg_control plan_walk`."""
    parser = argparse.ArgumentParser(prog='plan_walk', description=__doc__)
    parser.add_argument(
        '--model', default='compass_gait_mit', help='a file or a name [compass_gait_mit]'
    )
    parser.add_argument(
        '--speeds', type=float, nargs='+', default=list(SPEEDS), metavar='V',
        help=f'm/s, increasing [{" ".join(map(str, SPEEDS))}]',
    )  # fmt: skip
    parser.add_argument('--step', type=float, default=STEP, help=f'step length, m [{STEP}]')
    parser.add_argument(
        '--base', type=Path, help='tree to upright, of grow_tree, that it becomes a part of'
    )
    parser.add_argument(
        '--champions', type=int, metavar='N',
        help='of the tree to upright the first N champions of each leg stay [all of it]',
    )  # fmt: skip
    parser.add_argument('--out', type=Path, required=True, help='file to write, .npz')
    options = parser.parse_args(args)
    try:
        if not options.out.absolute().parent.is_dir():
            raise TreeError(f'{options.out}: there is no such directory')
        model = Model.load(model_path(options.model))
        base = _base(options, model)
        tree = walking_tree(model, options.speeds, options.step, base)
        tree = replace(tree, provenance=_provenance(options, model, base))
        tree.save(options.out)
    except (PlanningError, ValueError, OSError) as error:
        print(f'plan_walk: {error}', file=sys.stderr)
        return 2
    print(
        f'plan_walk: {options.out}: {len(tree.nodes)} nodes, {len(tree.speeds)} orbits, '
        f'{tree.nodes.branches} branches'
    )
    return 0


def _base(options: argparse.Namespace, model: Model) -> Tree | None:
    """The tree to upright that is asked for."""
    most = options.champions
    if most is not None and (most < 1 or not options.base):
        raise ValueError(f'--champions is {most}; it must be 1 or more, and needs --base')
    if not options.base:
        return None
    base = Tree.load(options.base, model)
    return base if most is None else pruned(base, most)


def _provenance(options: argparse.Namespace, model: Model, base: Tree | None) -> dict[str, Any]:
    """What the file says of how it was made."""
    command = f'plan_walk --speeds {" ".join(map(str, options.speeds))} --step {options.step:g}'
    if base is None:
        return {'model': model.name, 'command': command}
    command += ' --base TREE'
    if options.champions is not None:
        command += f' --champions {options.champions}'
    return {'model': model.name, 'command': command, 'base': dict(base.provenance)}


if __name__ == '__main__':
    raise SystemExit(main())
