"""What opposes each joint over its rate, measured and by the laws of the model, as a PNG."""

import math
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from cg_sysid.identification.joint_friction import JointFriction

COLUMNS = 3
MEASURED, MODELLED = '#9aa5b1', '#0b62a4'


def draw(joints: Mapping[str, JointFriction], path: Path) -> None:
    """Write the picture, a panel for each joint."""
    from matplotlib.figure import Figure

    columns = min(COLUMNS, len(joints))
    rows = math.ceil(len(joints) / columns)
    figure = Figure(figsize=(3.6 * columns, 2.8 * rows), layout='constrained')
    panels = np.ravel(figure.subplots(rows, columns, squeeze=False))
    for axes, (joint, own) in zip(panels, joints.items(), strict=False):
        axes.axhline(0, color='#d0d5db', lw=0.6)
        axes.axvline(0, color='#d0d5db', lw=0.6)
        axes.plot(own.rate, own.measured, '.', ms=2.5, color=MEASURED, label='measured')
        axes.plot(own.rate, own.modelled, '.', ms=2.0, color=MODELLED, label='by the laws')
        # Where friction turns a window of the motion may be far off: it shall not set the scale.
        most = 1.3 * float(np.quantile(np.abs(own.measured), 0.99)) or 1.0
        axes.set(ylim=(-most, most))
        axes.set_title(joint, fontsize=9)
        axes.tick_params(labelsize=7)
    for axes in panels[len(joints) :]:
        axes.set_visible(False)
    panels[0].legend(fontsize=7, markerscale=3, loc='upper left', frameon=False)
    figure.supxlabel('rate of the joint, rad/s (m/s)', fontsize=8)
    figure.supylabel('torque that its bodies do not take, N m (N)', fontsize=8)
    figure.savefig(path, dpi=140)
