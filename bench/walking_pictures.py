"""Pictures of the walking robot: a walk with a push, and the orbit with its tube.

    python bench/walking_pictures.py [walk] [portrait]

They go to docs/images; without names, both. The walk is the loop of the nodes in lock-step, with
observer and noise: from upright, ten steps, pushed on the way, and upright again. The portrait is
of one of its orbits, and of what the same loop walks round it.
"""

import argparse
from pathlib import Path

import numpy as np
from animation import COLOURS, Motion, save, stage
from matplotlib import pyplot
from matplotlib.patches import Ellipse
from trees_live import EPSILONS, MODEL, in_the_loop

from cg_control.orbits.transverse import frame
from cg_control.trees.recovery import ReadyTree, RecoverySettings
from cg_control.trees.tree import Tree
from cg_control.trees.tree_files import tree_path
from cg_dynamics.rig import STANCES

IMAGES = Path(__file__).parents[1] / 'docs' / 'images'
SPEED, STEPS = 0.3, 6  # m/s
DURATION = 16.0  # s
PUSHES = ((6.0, 3.0),)  # s, N s
ARROW, ARROW_LENGTH = 0.4, 0.3  # s for which a push is shown, m
DPI = 120


def walked(speed: float, steps: int, duration: float, pushes):
    """The loop of one walk, and the tree."""
    tree = Tree.load(tree_path('compass_gait_mit_walk'), MODEL)
    settings = RecoverySettings(speed=speed, steps=steps)
    run, _ = in_the_loop(
        ReadyTree.of(tree, MODEL, 0.002), STANCES[0], np.zeros(4), EPSILONS[0], 2, pushes,
        settings, duration,
    )  # fmt: skip
    return run, tree


def draw_walk(target: Path) -> None:
    """Steps in, walks, is pushed, walks on, stops."""
    run, _ = walked(SPEED, STEPS, DURATION, PUSHES)
    landings = int((np.diff(run.standing) != 0).sum())
    print(f'upright at the end: {run.upright(DURATION)}, steps: {landings}')
    motion = Motion.of(run.time, run.standing, run.states[:, :2], MODEL.values['leg_length'])
    figure, robot, plot, legs = stage(motion)
    for index, colour in enumerate(COLOURS.values()):
        plot.plot(run.time, run.states[:, index], color=colour)
    for instant, impulse in PUSHES:
        plot.axvline(instant, color='k', linestyle=':', label=f'push, {impulse:g} N s')
    plot.set(xlabel='time, s', ylabel='angles of the legs, rad', xlim=(0, DURATION))
    plot.legend(loc='lower right', fontsize=8)
    arrow = robot.annotate(
        '', (0, 0), (0, 0),
        arrowprops={'arrowstyle': '-|>', 'color': 'k', 'linewidth': 2, 'shrinkB': 4},
    )  # fmt: skip

    def shown(t, hip):
        now = [impulse for start, impulse in PUSHES if start <= t < start + ARROW]
        arrow.set_visible(bool(now))
        for impulse in now:
            arrow.xy = hip
            arrow.xyann = (hip[0] - ARROW_LENGTH * np.sign(impulse), hip[1])

    # The ground is long: the robot above, the curves below it.
    figure.set_size_inches(7.2, 4.2)
    robot.set_position([0.02, 0.5, 0.96, 0.48])
    plot.set_position([0.1, 0.13, 0.87, 0.3])
    save(target, figure, motion, legs, plot, shown)


def draw_portrait(target: Path) -> None:
    """Angle and rate of either leg: the orbit, its tube on the surfaces, a walk in it."""
    run, tree = walked(SPEED, 0, 18.0, ())
    nodes = tree.nodes
    orbit = int(np.abs(tree.speeds - SPEED).argmin())
    figure, panels = pyplot.subplots(1, 2, figsize=(9.0, 4.2), layout='constrained')
    settled = run.time > 8.0
    for axes, role in zip(panels, ('stance leg', 'swing leg'), strict=True):
        for leg, (stance, colour) in enumerate(COLOURS.items()):
            on = np.flatnonzero(nodes.orbiting & (nodes.orbit_of == orbit) & (nodes.stance == leg))
            shown = leg if role == 'stance leg' else 1 - leg
            pick = np.eye(4)[[shown, 2 + shown]]
            # At an impact itself hardly anything is left to be lost.
            # The tube of the swing leg is wider than the picture.
            for node in on[~nodes.impact[on]] if role == 'stance leg' else ():
                E = frame(nodes.surfaces[node, 0])
                # z'(E'FE)z <= 1, seen along the other two states.
                share = pick @ E @ np.linalg.inv(E.T @ nodes.F[node] @ E) @ E.T @ pick.T
                values, vectors = np.linalg.eigh(share)
                angle = np.degrees(np.arctan2(vectors[1, 1], vectors[0, 1]))
                width, height = 2 * np.sqrt(values[::-1])
                axes.add_patch(
                    Ellipse(nodes.x0[node][[shown, 2 + shown]], width, height, angle=angle,
                            facecolor=colour, alpha=0.06, edgecolor=colour, linewidth=0.4)
                )  # fmt: skip
            axes.plot(*nodes.x0[on][:, [shown, 2 + shown]].T, color=colour, linewidth=2,
                      label=f'{stance} leg stands')  # fmt: skip
            rows = settled & (run.standing == leg)
            axes.plot(run.states[rows, shown], run.states[rows, 2 + shown], '.', color='0.2',
                      markersize=0.6)  # fmt: skip
        axes.set(xlabel=f'angle of the {role}, rad', ylabel=f'rate of the {role}, rad/s')
        axes.grid(color='0.92')
        lines = np.vstack([line.get_xydata() for line in axes.get_lines()])
        low, high = lines.min(axis=0), lines.max(axis=0)
        room = 0.3 * (high - low)
        axes.set(xlim=(low[0] - room[0], high[0] + room[0]),
                 ylim=(low[1] - room[1], high[1] + room[1]))  # fmt: skip
    panels[0].legend(fontsize=8, loc='upper center')
    figure.suptitle(
        f'{tree.speeds[orbit]:g} m/s: the orbit, what its tube holds of the stance leg on the '
        'surface of each knot,\nand a walk with observer and noise (dots)', fontsize=9,
    )  # fmt: skip
    figure.savefig(target, dpi=DPI)


PICTURES = {'walk': (draw_walk, 'walking.gif'), 'portrait': (draw_portrait, 'walking_tube.png')}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition('\n')[0])
    parser.add_argument('names', nargs='*', metavar='NAME', help=f'of {", ".join(PICTURES)} [all]')
    options = parser.parse_args()
    unknown = set(options.names) - set(PICTURES)
    if unknown:
        parser.error(f'no such picture: {", ".join(sorted(unknown))}')
    for name in options.names or PICTURES:
        draw, file = PICTURES[name]
        draw(IMAGES / file)


if __name__ == '__main__':
    main()
