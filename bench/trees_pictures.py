"""Pictures of trees: slices of what one brings home, growth, a recovery, a pendulum's.

    python bench/trees_pictures.py [slices] [growth] [recovery] [pendulum]

They go to docs/images; without names, all of them. *Slices* preview every state of a grid on the
nominal robot. *Growth* draws the table of results/trees_growth.md. *Recovery* is the loop of
bench/trees_live.py, with observer and noise, of a robot that is pushed twice. *Pendulum* grows the
tree of bench/trees_pendulum.py and judges a grid of states as there.
"""

import argparse
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from animation import COLOURS, Motion, save, stage
from matplotlib import pyplot
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.patheffects import withTickedStroke
from matplotlib.ticker import FixedLocator, NullLocator, PercentFormatter, StrMethodFormatter
from trees_live import EPSILONS, MODEL, RESULT, in_the_loop
from trees_pendulum import BOX as PENDULUM_BOX
from trees_pendulum import claims, grower

from cg_bringup.recover_run import RecoverOptions
from cg_control.grow_tree import BOX
from cg_control.trees.growth import in_coordinates
from cg_control.trees.lookup import Lookup
from cg_control.trees.preview import AT_HOME, LANDING, Preview
from cg_control.trees.recovery import ReadyTree
from cg_control.trees.rollouts import follow
from cg_control.trees.tree import Tree
from cg_control.trees.tree_files import tree_path
from cg_dynamics.rig import STANCES

IMAGES = Path(__file__).parents[1] / 'docs' / 'images'
GROWTH = RESULT.with_name('trees_growth.md')
GRID = 81  # states along an edge of a slice
LEAN = 0.1  # rad, of the slices through the swing leg's motion
SLOW = 3.0  # s: end of the colours
DPI = 120
DRAWN = (32, 128, 512, 8192)  # states that the pendulum's tree has seen
ORANGE, BLUE, BLACK = '#d55e00', '#0072b2', 'black'  # told apart by the colour-blind
TICKS = withTickedStroke(spacing=14, angle=-90, length=0.4)  # where the values are smaller
PUSHES = ((0.5, 5.0), (2.75, 5.0))  # s, N s
DURATION = 5.0  # s
ARROW, ARROW_LENGTH = 0.25, 0.28  # s for which a push is shown, m


@dataclass(frozen=True)
class Slice:
    """States of one stance leg in a plane, on a grid.

    Attributes:
        leg: Leg that stands, index into STANCES.
        title: Of the picture.
        axes: What is along them, with units.
        half: Half their lengths, rad and rad/s.
        states: Values along the axes -> states in the roles of the legs (`in_coordinates`).
    """

    leg: int
    title: str
    axes: tuple[str, str]
    half: tuple[float, float]
    states: Callable[[np.ndarray, np.ndarray], list[np.ndarray]]

    def grid(self, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Values along both axes (count,), legs (count^2,) and states (count^2, 4)."""
        across, up = (np.linspace(-h, h, count) for h in self.half)
        a, b = (values.ravel() for values in np.meshgrid(across, up))
        leg = np.full(len(a), self.leg)
        return across, up, leg, in_coordinates(leg, np.column_stack(self.states(a, b)))


def slices() -> list[Slice]:
    """The planes, for both legs, as wide as the box in which the tree was grown."""
    lean, swing, lean_rate, swing_rate = BOX
    found = []
    for leg, stance in enumerate(STANCES):
        found.append(Slice(
            leg, f'{stance} leg stands, legs together',
            ('lean, rad', 'its rate, rad/s'), (lean, lean_rate),
            lambda a, b: [a, 0 * a, b, 0 * b],
        ))  # fmt: skip
    for leg, stance in enumerate(STANCES):
        found.append(Slice(
            leg, f'{stance} leg stands still, leaning {LEAN:g} rad',
            ('swing leg to stance leg, rad (ahead: negative)', 'its rate, rad/s'),
            (swing, swing_rate), lambda a, b: [LEAN + 0 * a, a, 0 * a, b],
        ))  # fmt: skip
    return found


def brought_home(preview: Preview, leg: np.ndarray, x: np.ndarray) -> tuple:
    """Time until home in s and steps taken, shapes (B,), NaN where no preview comes home."""
    entry = preview.choose(leg, x)
    home = entry >= 0
    nodes, found = preview.tree.nodes, entry[home]
    done = follow(
        nodes, preview.known, found, x[home], nodes.to_go[found] + AT_HOME,
        goal=preview.tree.goal, options=preview.simulation,
    )  # fmt: skip
    time, steps = np.full((2, len(x)), np.nan)
    time[home], steps[home] = done.time, done.impacts
    return time, steps


def draw_slices(target: Path) -> None:
    """Time until home in planes of the state space, beside what funnels claim alone."""
    tree = Tree.load(tree_path(RecoverOptions().tree), MODEL)
    preview, lookup = Preview(tree, MODEL, simulation=LANDING), Lookup(tree.nodes)
    pyplot.rcParams['hatch.linewidth'] = 0.5
    figure, panels = pyplot.subplots(2, 2, figsize=(9.0, 8.2), layout='constrained')
    for one, axes in zip(slices(), panels.flat, strict=True):
        across, up, leg, x = one.grid(GRID)
        time, steps = (v.reshape(GRID, GRID) for v in brought_home(preview, leg, x))
        depth = np.concatenate([
            lookup.best_of_many(*some)[1]
            for some in zip(np.split(leg, GRID), np.split(x, GRID), strict=True)
        ]).reshape(GRID, GRID)  # fmt: skip
        image = axes.pcolormesh(
            across, up, time, cmap='viridis', vmin=0, vmax=SLOW, shading='nearest', rasterized=True
        )
        stepped = np.nan_to_num(steps) > 0
        axes.contourf(across, up, stepped, [0.5, 1.5], colors='none', hatches=['///'])
        edge = axes.contour(across, up, depth, [1.0], colors=ORANGE, linewidths=1.4)
        edge.set_path_effects([TICKS])
        across, up, leg, x = one.grid(4 * GRID)
        goal = np.einsum('bi,bij,bj->b', x, tree.goal[leg], x).reshape(4 * GRID, 4 * GRID)
        axes.contour(across, up, goal, [1.0], colors='white', linewidths=3.0)
        axes.contour(across, up, goal, [1.0], colors=BLACK, linewidths=1.4)
        share = np.isfinite(time).mean()
        axes.set_title(one.title, fontsize=10)
        axes.set(xlabel=one.axes[0], ylabel=one.axes[1])
        print(
            f'{one.title}: {share:.0%} home, the slowest in {np.nanmax(time):.1f} s, '
            f'steps up to {np.nanmax(steps):.0f}, '
            f'funnels claim {(depth <= 1).mean():.0%}'
        )
    figure.colorbar(image, ax=panels, label='time until home, s', shrink=0.6, extend='max')
    figure.legend(
        handles=[
            Patch(facecolor='white', edgecolor='0.4', label='no preview comes home'),
            Patch(facecolor='white', edgecolor=BLACK, hatch='///', label='takes a step'),
            Line2D(
                [], [], color=ORANGE, path_effects=[TICKS],
                label='what funnels alone claim (ticked side)',
            ),
            Line2D([], [], color=BLACK, label='home: the goal region'),
        ],
        loc='outside lower center', ncols=4, frameon=False, fontsize=9,
    )  # fmt: skip
    figure.savefig(target, dpi=DPI)


@dataclass(frozen=True)
class Curve:
    """The growth curve of trees_growth.md, one row per mark.

    Attributes:
        states: Drawn so far, shape (n,).
        branches: Grown so far, shape (n,).
        funnels: Share that they cover, least and largest by the interval of 95 %, shape (n, 3).
        previews: The same of previews.
    """

    states: np.ndarray
    branches: np.ndarray
    funnels: np.ndarray
    previews: np.ndarray

    @classmethod
    def read(cls, text: str) -> 'Curve':
        """From the first table of the file.

        Raises:
            ValueError: There is no such table.
        """
        lines = iter(text.splitlines())
        head = next((line for line in lines if line.startswith('| states |')), '')
        titles = cells_of(head)
        next(lines, None)
        rows = []
        for line in lines:
            if not line.startswith('|'):
                break
            rows.append(dict(zip(titles, cells_of(line), strict=True)))

        def column(start: str) -> list[str]:
            found = [title for title in titles if title.startswith(start)]
            if len(found) != 1 or not rows:
                raise ValueError(f'no table with one column {start!r}; its columns: {titles}')
            return [row[found[0]] for row in rows]

        return cls(
            np.array(column('states'), int),
            np.array(column('branches'), int),
            np.array([share_of(cell) for cell in column('covered by funnels')]),
            np.array([share_of(cell) for cell in column('covered by previews')]),
        )


def cells_of(line: str) -> list[str]:
    """The cells of a row of a table."""
    return [cell.strip() for cell in line.strip().strip('|').split('|')]


def share_of(cell: str) -> tuple[float, float, float]:
    """Share, least and largest of `84 of 175 = 48.0% (40.4% to 55.7%)`."""
    found = re.fullmatch(r'(\d+) of (\d+) = \S+ \((\S+)% to (\S+)%\)', cell)
    if not found:
        raise ValueError(f'not a share with its interval: {cell!r}')
    hits, of, low, high = (float(number) for number in found.groups())
    return hits / of, low / 100, high / 100


def draw_growth(target: Path) -> None:
    """What a tree covers, and its branches, against the states drawn."""
    curve = Curve.read(GROWTH.read_text(encoding='utf-8'))
    figure, axes = pyplot.subplots(figsize=(7.5, 4.2), layout='constrained')
    other = axes.twinx()
    for share, colour, marker, label in (
        (curve.previews, BLUE, 'o', 'by previews'), (curve.funnels, ORANGE, 's', 'by funnels'),
    ):  # fmt: skip
        middle, low, high = share.T
        axes.fill_between(curve.states, low, high, color=colour, alpha=0.15, linewidth=0)
        axes.plot(curve.states, middle, color=colour, marker=marker, markersize=4, label=label)
    other.plot(curve.states, curve.branches, color='0.35', linestyle='--', label='branches')
    other.set(ylim=(0, None), ylabel='branches')
    axes.set(xscale='log', xlabel='states drawn', ylim=(0, 1))
    axes.set_ylabel('covered, of the feasible states of the census')
    axes.yaxis.set_major_formatter(PercentFormatter(1.0))
    ticks = 2.0 ** np.arange(
        np.ceil(np.log2(curve.states[0])), np.floor(np.log2(curve.states[-1])) + 1
    )
    axes.xaxis.set_major_locator(FixedLocator(ticks))
    axes.xaxis.set_minor_locator(NullLocator())
    axes.xaxis.set_major_formatter(StrMethodFormatter('{x:.0f}'))
    axes.grid(color='0.9')
    figure.legend(loc='outside upper center', ncols=3, frameon=False)
    figure.savefig(target, dpi=DPI)


def draw_recovery(target: Path) -> None:
    """A robot that is pushed twice and takes a step each time."""
    ready = ReadyTree.of(Tree.load(tree_path(RecoverOptions().tree), MODEL), MODEL)
    run, _ = in_the_loop(ready, STANCES[0], np.zeros(4), EPSILONS[0], 1, PUSHES, duration=DURATION)
    steps = int((np.diff(run.standing) != 0).sum())
    print(f'upright at the end: {run.upright(DURATION)}, steps: {steps}')
    motion = Motion.of(run.time, run.standing, run.states[:, :2], MODEL.values['leg_length'])
    figure, robot, plot, legs = stage(motion)
    plot.fill_between(
        run.time, 0, 1, where=~run.engaged, transform=plot.get_xaxis_transform(), color='0.88',
        linewidth=0,     )  # fmt: skip
    for index, colour in enumerate(COLOURS.values()):
        plot.plot(run.time, run.states[:, index], color=colour)
    for number, (instant, impulse) in enumerate(PUSHES):
        label = f'push, {impulse:g} N s'
        plot.axvline(instant, color=BLACK, linestyle=':', label='' if number else label)
    plot.set(xlabel='time, s', ylabel='angles of the legs, rad', xlim=(0, DURATION))
    plot.set_title('shaded: follows the tree, otherwise balances', fontsize=9)
    plot.legend(loc='lower right', fontsize=8)
    figure.tight_layout()
    arrow = robot.annotate(
        '', (0, 0), (0, 0),
        arrowprops={'arrowstyle': '-|>', 'color': BLACK, 'linewidth': 2, 'shrinkB': 4},
    )  # fmt: skip
    size = robot.text(0, 0, '', ha='center', va='bottom', fontsize=8)

    def shown(t, hip):
        now = [impulse for start, impulse in PUSHES if start <= t < start + ARROW]
        arrow.set_visible(bool(now))
        size.set_visible(bool(now))
        for impulse in now:
            tail = hip[0] - ARROW_LENGTH * np.sign(impulse)
            arrow.xy, arrow.xyann = hip, (tail, hip[1])
            size.set_text(f'{impulse:g} N s')
            size.set_position(((tail + hip[0]) / 2, hip[1] + 0.05))

    save(target, figure, motion, legs, plot, shown)


def draw_pendulum(target: Path) -> None:
    """What the tree of the pendulum claims while it grows, in the unrolled angle of one turn."""
    growing = grower(seed=0, tolerated=0.0, intervals=40)
    angle, rate = (np.linspace(-half, half, 2 * GRID) for half in PENDULUM_BOX)
    x = np.stack(np.meshgrid(angle, rate), axis=-1)
    figure, panels = pyplot.subplots(
        2, 2, figsize=(9.0, 6.4), layout='constrained', sharex=True, sharey=True
    )
    for drawn, axes in zip(DRAWN, panels.flat, strict=True):
        while growing.counts.samples < drawn:
            growing.round()
        claimed, true = (some.reshape(x.shape[:2]) for some in claims(growing, x.reshape(-1, 2)))
        axes.contourf(angle, rate, true, [0.5, 1.5], colors=[BLUE], alpha=0.35)
        axes.contourf(angle, rate, claimed & ~true, [0.5, 1.5], colors=[ORANGE])
        nodes = growing.nodes
        for branch in range(1, nodes.branches + 1):
            q, v = nodes.x0[nodes.branch == branch].T
            wrapped = (q + np.pi) % (2 * np.pi) - np.pi
            wrapped[1:][np.abs(np.diff(wrapped)) > np.pi] = np.nan
            axes.plot(wrapped, v, color='0.2', linewidth=0.9)
        axes.set(xlim=(angle[0], angle[-1]), ylim=(rate[0], rate[-1]))
        axes.set_title(f'{drawn} states drawn, {nodes.branches} branches', fontsize=10)
    figure.supxlabel('angle from upright, rad')
    figure.supylabel('rate, rad/s')
    figure.legend(
        handles=[
            Patch(facecolor=BLUE, alpha=0.35, label='claimed, and comes home'),
            Patch(facecolor=ORANGE, label='claimed falsely'),
            Line2D([], [], color='0.2', label='branches'),
        ],
        loc='outside upper center', ncols=3, frameon=False, fontsize=9,
    )  # fmt: skip
    figure.savefig(target, dpi=DPI)


PICTURES = {
    'slices': (draw_slices, 'tree_slices.png'),
    'growth': (draw_growth, 'tree_growth.png'),
    'recovery': (draw_recovery, 'recovery.gif'),
    'pendulum': (draw_pendulum, 'tree_pendulum.png'),
}


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
