"""A rebalance as an animation: python bench/rebalance_animation.py docs/images/rebalance.gif."""

import sys
from pathlib import Path

import numpy as np
from animation import COLOURS, Motion, save, stage
from rebalance import OPTIONS, ROBOT, planned

from cg_control.following.planning import executed
from cg_control.following.tracking import TrackingSettings
from cg_dynamics.rig import STANCES

START = np.array([0.02, -0.08, 0.05, 0.1])


def main() -> None:
    trajectory, balance = planned(ROBOT)
    done = executed(
        trajectory, ROBOT, TrackingSettings(), x0=START, more=0.8, options=OPTIONS, balance=balance
    )
    times = np.concatenate([arc.time for arc in done.arcs])
    states = np.vstack([arc.states for arc in done.arcs])
    standing = np.concatenate([[STANCES.index(arc.stance)] * len(arc.time) for arc in done.arcs])
    motion = Motion.of(times, standing, states[:, :2], ROBOT.values['leg_length'])
    figure, _, plot, legs = stage(motion)
    nominal = np.array([trajectory.at(t).state for t in times])
    for index, colour in enumerate(COLOURS.values()):
        plot.plot(times, nominal[:, index], color='c', linewidth=1)
        plot.plot(times, states[:, index], color=colour)
    plot.set(xlabel='s', ylabel='rad', title='angles, nominal in cyan')
    figure.tight_layout()
    save(Path(sys.argv[1]), figure, motion, legs, plot)


if __name__ == '__main__':
    main()
