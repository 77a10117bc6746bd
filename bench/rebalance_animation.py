"""A rebalance as an animation: python bench/rebalance_animation.py docs/images/rebalance.gif."""

import sys
from pathlib import Path

import matplotlib
import numpy as np
from rebalance import OPTIONS, ROBOT, planned

from cg_control.planning import executed
from cg_control.tracking import TrackingSettings
from cg_dynamics.hybrid import swing_foot

matplotlib.use('Agg')
from matplotlib import animation, pyplot

FRAMES_PER_SECOND = 20
START = np.array([0.02, -0.08, 0.05, 0.1])


def main() -> None:
    target = Path(sys.argv[1])
    trajectory, balance = planned(ROBOT)
    done = executed(
        trajectory, ROBOT, TrackingSettings(), x0=START, more=0.8, options=OPTIONS, balance=balance
    )
    l = ROBOT.values['leg_length']
    frames, foot = [], 0.0
    for arc in done.arcs:
        for t, x, u in zip(arc.time, arc.states, arc.inputs, strict=True):
            standing = 0 if arc.stance == 'inner' else 1
            hip = foot + l * np.sin(x[standing]), l * np.cos(x[standing])
            ends = [(hip[0] - l * np.sin(q), hip[1] - l * np.cos(q)) for q in x[:2]]
            frames.append((t, hip, ends, u[0]))
        foot += swing_foot(arc.states[-1], arc.stance, l)[0]
    times = np.array([frame[0] for frame in frames])
    figure, (robot, plot) = pyplot.subplots(1, 2, figsize=(7.2, 3.2), width_ratios=(1, 1.5))
    robot.set(xlim=(-0.6, 0.9), ylim=(-0.08, 1.25), aspect='equal')
    robot.axhline(0, color='0.7')
    robot.axis('off')
    legs = [robot.plot([], [], color=c, linewidth=3, label=n)[0]
            for c, n in (('C0', 'inner'), ('C1', 'outer'))]  # fmt: skip
    robot.legend(loc='upper right', fontsize=8, frameon=False)
    states = np.vstack([arc.states for arc in done.arcs])
    nominal = np.array([trajectory.at(t).state for t in times])
    for index, colour in ((0, 'C0'), (1, 'C1')):
        plot.plot(times, nominal[:, index], color='c', linewidth=1)
        plot.plot(times, states[:, index], color=colour)
    plot.set(xlabel='s', ylabel='rad', title='angles, nominal in cyan')
    now = plot.axvline(0, color='0.5')
    figure.tight_layout()

    def show(t):
        _, hip, ends, _ = frames[min(int(np.searchsorted(times, t)), len(frames) - 1)]
        for line, end in zip(legs, ends, strict=True):
            line.set_data([end[0], hip[0]], [end[1], hip[1]])
        now.set_xdata([t, t])
        return [*legs, now]

    clip = animation.FuncAnimation(
        figure, show, frames=np.arange(0, times[-1], 1 / FRAMES_PER_SECOND), blit=False
    )
    clip.save(target, writer=animation.PillowWriter(fps=FRAMES_PER_SECOND), dpi=70)


if __name__ == '__main__':
    main()
