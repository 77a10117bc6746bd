"""Cost tuning (thesis, 4.5): which weights give a trajectory the largest basin of attraction?

    python -m cg_control.cost_tuning --rounds 12 --out tuning      searches, draws, prints

A set of weights is scored by simulation: the share of seeded starts around the start of the
trajectory from which the exact hybrid model, friction and torque limit included, ends standing.
The search is design intuition plus brute force, as the thesis says: it begins with the weights of
the balance controller, changes them by random factors on a logarithmic scale that become
smaller, and keeps what scores better. Starts are the same for all, so that scores compare.
"""

import argparse
import json
import math
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from cg_control.balancing.balance import BalanceSettings, balance_gains
from cg_control.following.planning import executed, plan
from cg_control.following.tracking import TrackingSettings
from cg_control.trajectories.collocation import Options
from cg_control.trajectories.task import Task
from cg_control.trajectories.trajectory import Trajectory
from cg_control.trajectories.tvlqr import Weights, stabilise
from cg_description.model_file import write_atomically
from cg_dynamics.errors import SimulationError
from cg_dynamics.model import Model
from cg_dynamics.rig import STANCES
from cg_dynamics.walking.hybrid import WalkOptions

TUNED = ('stance_angle', 'swing_angle', 'stance_rate', 'swing_rate', 'torque', 'final')
FIRST_FACTOR, LAST_FACTOR = 10.0, 2.0  # of a random change, standard deviation in the logarithm
SPREAD = np.array([0.06, 0.15, 0.15, 0.3])  # rad, rad/s; stance first
STANDING = 0.05, 0.2  # rad, rad/s of the stance leg at the end
MORE = 1.0  # s after the end
SAMPLE_TIME = 0.004  # s


@dataclass(frozen=True)
class Trial:
    """One set of weights and its score, the share of starts that end standing."""

    weights: Weights
    score: float


def starts(count: int, stance: str, seed: int = 0) -> np.ndarray:
    """Deviations from the start of a trajectory, shape (count, 4)."""
    order = [0, 1, 2, 3] if stance == 'inner' else [1, 0, 3, 2]
    return np.random.default_rng(seed).uniform(-1, 1, (count, 4)) * SPREAD[order]


def score(
    trajectory: Trajectory,
    robot: Model,
    weights: Weights,
    deviations: np.ndarray,
    minimum_step: float = 0.1,
) -> float:
    """Share of the starts from which the robot ends standing on the last leg.

    Args:
        trajectory: To the upright equilibrium.
        robot: What is simulated and controlled.
        weights: Of the feedback.
        deviations: From the start of the trajectory, shape (n, 4).
        minimum_step: Steps shorter than this do not land, m.
    """
    stabilised = stabilise(trajectory, robot, weights)
    last = trajectory.modes[-1]
    balance = balance_gains(robot, BalanceSettings(), SAMPLE_TIME)[last][:4]
    options = WalkOptions(
        sample_time=SAMPLE_TIME, step=0.002, minimum_step=minimum_step, fall_angle=0.6,
        largest_steps=len(trajectory.modes),
    )  # fmt: skip
    standing = STANCES.index(last)
    successes = 0
    for deviation in deviations:
        try:
            done = executed(
                stabilised, robot, TrackingSettings(), x0=trajectory.states[0] + deviation,
                more=MORE, options=options, balance=balance,
            )  # fmt: skip
        except SimulationError:
            continue
        successes += (
            done.outcome == 'time'
            and done.stance == last
            and abs(done.state[standing]) < STANDING[0]
            and abs(done.state[2 + standing]) < STANDING[1]
        )
    return successes / len(deviations)


def search(
    measure: Callable[[Weights], float],
    rounds: int,
    seed: int = 0,
    start: Weights | None = None,
    report: Callable[[int, Trial, Trial], None] = lambda number, trial, best: None,
) -> list[Trial]:
    """Random search on the logarithms of the weights.

    Args:
        measure: Weights to score; higher is better.
        rounds: Scores to take after the first.
        seed: Of the changes.
        start: Where to begin; None: Weights().
        report: Told the number of the round, the trial and the best so far.

    Returns:
        All trials in order; the best is `max(trials, key=lambda t: t.score)`.
    """
    rng = np.random.default_rng(seed)
    first = start or Weights()
    best = Trial(first, measure(first))
    trials = [best]
    report(0, best, best)
    for number in range(1, rounds + 1):
        share = (number - 1) / max(rounds - 1, 1)
        width = math.log(FIRST_FACTOR) * (1 - share) + math.log(LAST_FACTOR) * share
        factors = np.exp(width / 2 * rng.standard_normal(len(TUNED)))
        changed = {
            name: getattr(best.weights, name) * float(factor)
            for name, factor in zip(TUNED, factors, strict=True)
        }
        weights = replace(best.weights, **changed)
        trial = Trial(weights, measure(weights))
        trials.append(trial)
        if trial.score > best.score:
            best = trial
        report(number, trial, best)
    return trials


def draw(trials: Sequence[Trial], path: Path) -> None:
    """The search as a picture: scores over rounds, and each weight against its score."""
    import matplotlib

    matplotlib.use('Agg')
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(2, 4, figsize=(12, 5.5), sharey=True)
    scores = np.array([100 * trial.score for trial in trials])
    flat = axes.ravel()
    flat[0].plot(scores, 'o', color='0.6', markersize=4)
    flat[0].plot(np.maximum.accumulate(scores), color='C0')
    flat[0].set_xlabel('round')
    for axis, name in zip(flat[1:], TUNED, strict=False):
        axis.semilogx([getattr(t.weights, name) for t in trials], scores, 'o', markersize=4)
        best = trials[int(scores.argmax())]
        axis.axvline(getattr(best.weights, name), color='C0', linewidth=1)
        axis.set_xlabel(name)
    for axis in axes[:, 0]:
        axis.set_ylabel('starts that end standing, %')
    flat[-1].axis('off')
    figure.tight_layout()
    figure.savefig(path, dpi=90)
    pyplot.close(figure)


def main(args: list[str] | None = None) -> int:
    """Search the weights of the one-step rebalance."""
    parser = argparse.ArgumentParser(prog='python -m cg_control.cost_tuning', description=__doc__)
    parser.add_argument('--model', default='', help='file or name; empty for the nominal one')
    parser.add_argument('--first', choices=STANCES, default='inner', help='leg of the start')
    parser.add_argument('--rounds', type=int, default=30, help='sets of weights to try [30]')
    parser.add_argument('--starts', type=int, default=60, help='starts of each [60]')
    parser.add_argument('--seed', type=int, default=0, help='[0]')
    parser.add_argument('--out', type=Path, default=Path('tuning'), help='directory [tuning]')
    options = parser.parse_args(args)
    robot = Model.load(options.model or 'compass_gait_mit')
    second = next(leg for leg in STANCES if leg != options.first)
    trajectory = plan(robot, Task((options.first, second), reach=0.2), Options(fine=25))
    deviations = starts(options.starts, options.first, options.seed)

    def report(number: int, trial: Trial, best: Trial) -> None:
        print(
            f'{number}/{options.rounds}: {100 * trial.score:.0f} %, best {100 * best.score:.0f} %',
            file=sys.stderr,
            flush=True,
        )

    trials = search(
        lambda weights: score(trajectory, robot, weights, deviations),
        options.rounds,
        options.seed,
        report=report,
    )
    best = max(trials, key=lambda trial: trial.score)
    # What was searched for flatters itself; other starts do not.
    fresh = starts(options.starts, options.first, options.seed + 1)
    held_out = [score(trajectory, robot, w, fresh) for w in (trials[0].weights, best.weights)]
    result = {
        'weights': vars(best.weights),
        'score_before': trials[0].score,
        'score': best.score,
        'score_on_other_starts_before': held_out[0],
        'score_on_other_starts': held_out[1],
        'starts': options.starts,
        'rounds': options.rounds,
        'model_hash': robot.hash,
    }
    options.out.mkdir(parents=True, exist_ok=True)
    write_atomically(options.out / 'weights.json', json.dumps(result, indent=2) + '\n')
    draw(trials, options.out / 'search.png')
    print(json.dumps(result, indent=2))
    return 0


if __name__ == '__main__':
    raise SystemExit(main())
