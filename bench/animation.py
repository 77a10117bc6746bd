"""Animations of a compass gait: legs and ground true to scale, beside curves over time."""

from dataclasses import dataclass
from pathlib import Path

import matplotlib
import numpy as np

matplotlib.use('Agg')
from matplotlib import animation, pyplot
from matplotlib.figure import Figure

FRAMES_PER_SECOND = 20
COLOURS = {'inner': 'C0', 'outer': 'C1'}
SIZE = (7.2, 3.2)  # inches
MARGIN = 0.3  # m of ground beside the robot


@dataclass(frozen=True)
class Motion:
    """Where a robot was, one row per instant.

    Attributes:
        time: In s, shape (n,).
        hip: Position (x, z) in m, shape (n, 2).
        feet: Of both legs, in the order of STANCES, shape (n, 2, 2).
    """

    time: np.ndarray
    hip: np.ndarray
    feet: np.ndarray

    @classmethod
    def of(cls, time, standing, angles, leg_length: float) -> 'Motion':
        """Put a robot on the ground.

        Args:
            time: In s, shape (n,).
            standing: Index of the stance leg, shape (n,).
            angles: (q_inner, q_outer) in rad, shape (n, 2).
            leg_length: In m.
        """
        rows = np.arange(len(time))
        # Vectors from the feet to the hip.
        legs = leg_length * np.stack([np.sin(angles), np.cos(angles)], axis=-1)
        foot = np.zeros((len(time), 2))
        for k in np.flatnonzero(np.diff(standing)) + 1:
            # The foot that landed stays where it is; the other one has left the ground.
            foot[k:, 0] = foot[k - 1, 0] + (legs[k, 1 - standing[k]] - legs[k, standing[k]])[0]
        hip = foot + legs[rows, standing]
        return cls(np.asarray(time), hip, hip[:, None] - legs)


def stage(motion: Motion):
    """A figure with the robot's axes, to scale, and axes for curves; the artists of its legs."""
    figure, (robot, plot) = pyplot.subplots(1, 2, figsize=SIZE, width_ratios=(1, 1.5))
    x = np.concatenate([motion.hip[:, 0], motion.feet[..., 0].ravel()])
    low, high = x.min() - MARGIN, x.max() + MARGIN
    robot.set(xlim=(low, high), ylim=(-0.08, 1.25), aspect='equal')
    robot.axhline(0, color='0.7')
    robot.axis('off')
    legs = [
        robot.plot([], [], color=colour, linewidth=3, label=name)[0]
        for name, colour in COLOURS.items()
    ]
    robot.legend(
        loc='upper center', bbox_to_anchor=(0.5, 0.05), ncols=2, fontsize=8, frameon=False
    )
    return figure, robot, plot, legs


def save(target: Path, figure: Figure, motion: Motion, legs, curves, shown=None) -> None:
    """Write the animation.

    Args:
        target: A .gif.
        figure: From `stage`, with its curves drawn.
        motion: Of the robot.
        legs: From `stage`.
        curves: Axes in which a line goes along with time.
        shown: Called with every instant in s and the hip (x, z), to show more; None: no more.
    """
    now = [axes.axvline(0, color='0.5', linewidth=1) for axes in np.atleast_1d(curves)]

    def show(t):
        k = min(int(np.searchsorted(motion.time, t)), len(motion.time) - 1)
        for line, foot in zip(legs, motion.feet[k], strict=True):
            line.set_data(*np.transpose([foot, motion.hip[k]]))
        for line in now:
            line.set_xdata([t, t])
        if shown:
            shown(t, motion.hip[k])
        return legs

    clip = animation.FuncAnimation(
        figure, show, frames=np.arange(0, motion.time[-1], 1 / FRAMES_PER_SECOND), blit=False
    )
    clip.save(target, writer=animation.PillowWriter(fps=FRAMES_PER_SECOND), dpi=70)
