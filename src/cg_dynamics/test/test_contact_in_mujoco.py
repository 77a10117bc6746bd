"""Landings that slide, beside an engine that shares no code: mujoco_walker.py."""

import numpy as np
import pytest

pytest.importorskip('mujoco', reason='MuJoCo is not installed')

from mujoco_robot import two_links
from mujoco_walker import MujocoWalker

from cg_dynamics.rig import STANCES
from cg_dynamics.walking.gait import section_state
from cg_dynamics.walking.hybrid import WalkOptions, walk

SLOPE, SAMPLE, DURATION = 0.05, 0.002, 0.7


def pull(time, stance, x):
    """Torque that swings the leg ahead of the other."""
    sign, swing = (1.0, 0) if stance == 'outer' else (-1.0, 1)
    return [sign * (60 * (-0.2 - x[swing]) - 6 * x[2 + swing])]


@pytest.mark.parametrize('stance', STANCES)
@pytest.mark.parametrize('friction', [2.0, 0.45, 0.35])
def test_a_step_on_slippery_ground_is_the_same_there(bare, stance, friction):
    model = bare.with_values(two_links(bare.values)).with_effect('foot_slip', friction=friction)
    x0 = section_state(np.array([0.2, 1.1, 0.0]), stance, SLOPE)
    options = WalkOptions(slope=SLOPE, sample_time=SAMPLE)
    ours = walk(model, stance, x0, DURATION, pull, options)
    theirs = MujocoWalker(model.values, stance, x0, SLOPE, friction)
    rows, slips = np.arange(round(DURATION / SAMPLE)), []
    states = []
    for k in rows:
        states.append(theirs.state)
        slips.append(np.linalg.norm(theirs.foot(theirs.stance)[1]))
        theirs.advance(pull(k * SAMPLE, theirs.stance, theirs.state)[0], SAMPLE)
    time = np.concatenate([arc.time for arc in ours.arcs])
    found = np.concatenate([arc.states for arc in ours.arcs])
    expected = np.column_stack([np.interp(rows * SAMPLE, time, x) for x in found.T])
    # The engine's ground gives way for a millisecond, in which 10 m/s^2 and more act.
    assert len(ours.impacts) == len(theirs.landings) == 1
    assert theirs.landings[0] == pytest.approx(ours.impacts[0].time, abs=2e-3)
    late = rows * SAMPLE > ours.impacts[0].time + 0.1
    off = np.abs(np.array(states) - expected)[late].max(axis=0)
    assert (off < [4e-3, 4e-3, 0.03, 0.03]).all(), off
    stopped = [event.time for event in ours.events if event.kind == 'stick']
    assert bool(stopped) == (friction < 1)
    if stopped:
        still = SAMPLE * (1 + np.flatnonzero(np.array(slips) > 0.02).max())
        # The soft landing shifts where a slide of 40 to 100 ms ends by some milliseconds.
        assert still == pytest.approx(stopped[0], abs=0.012)
