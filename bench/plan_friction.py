"""Planning with dry friction: how far the exact model leaves a plan, by where friction is kept.

    python bench/plan_friction.py                  prints the table
    python bench/plan_friction.py --write          stores it as bench/results/plan_friction.md
    python bench/plan_friction.py --starts 16      fewer starts

Starts are drawn uniformly from +-(0.06, 0.15) rad of stance and swing leg and +-(0.15, 0.3) rad/s
of their rates; a motion brings them to rest upright on the same leg or, by one step, on the other
one. The robot with its friction (1.84 N m dry, turning its sign within 0.01 rad/s, and viscous) is
then simulated without feedback under the nominal torque, held for 2 ms, for 0.6 s: longer plans
would measure how much the upright robot amplifies. The error is the largest of the angles at the
end, and of the rates divided by ten.

    in the dynamics   collocation's equations of motion have the friction: what was done before
    given back        u is what is left for the motion; the plan's torque has friction on top
    compensated       as before, but the controller adds friction, at the rate that is planned
    compensated, x    or at the rate that is measured when the sample begins
"""

import argparse
import platform
import time
from pathlib import Path

import numpy as np

from cg_control.friction import friction_torque
from cg_control.trajectories import collocation
from cg_control.trajectories.collocation import Options, PlanningError, optimise, planning_model
from cg_control.trajectories.task import Box, Task
from cg_control.trajectories.trajectory import Trajectory
from cg_description.paths import model_path
from cg_dynamics.assemble import parameter_vector
from cg_dynamics.model import Model
from cg_dynamics.rig import Setup
from cg_dynamics.walking.hybrid import WalkOptions, walk

ROBOT = Model.load(model_path('compass_gait_mit'))
FULL = planning_model(ROBOT)
TAKEN, P = friction_torque(FULL), parameter_vector(FULL, Setup())
SPREAD = np.array([0.06, 0.15, 0.15, 0.3])
HORIZON, HOLD = 0.6, 0.002  # s
NO_STEP = 10.0  # m: what is looked at ends before the impact; feet pass until then
ROUTES = ('in the dynamics', 'given back', 'compensated', 'compensated, x')
RESULT = Path(__file__).parent / 'results' / 'plan_friction.md'


def error(plan: Trajectory, route: str) -> float:
    def command(t, stance, x):
        point = plan.at(t + HOLD / 2)
        rates = x if route.endswith('x') else point.state
        added = float(TAKEN(rates[2] - rates[3], P)) if route.startswith('comp') else 0.0
        return np.array([point.torque + added])

    # Before the impact, whose instant differs.
    end = min(HORIZON, *(0.9 * t for t in plan.impact_times), plan.duration)
    done = walk(
        FULL, plan.modes[0], plan.states[0], end, command,
        WalkOptions(step=5e-4, sample_time=HOLD, minimum_step=NO_STEP),
    )  # fmt: skip
    return float((np.abs(done.state[:4] - plan.at(end).state) * [1, 1, 0.1, 0.1]).max())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split('\n', 1)[0])
    parser.add_argument('--starts', type=int, default=40)
    parser.add_argument('--write', action='store_true')
    options = parser.parse_args()
    starts = np.random.default_rng(5).uniform(-1, 1, (options.starts, 4)) * SPREAD
    kept = collocation.given_back
    lines = [
        f'Made by `python bench/plan_friction.py`, {options.starts} starts, '
        f'Python {platform.python_version()}, {platform.machine()}.',
        '',
        '| modes | intervals | friction | not found | error: median | 90 % | CPU of a plan, ms |',
        '|---|---:|---|---:|---:|---:|---:|',
    ]
    for modes in (('inner',), ('inner', 'outer')):
        for fine in (20, 40):
            for route in ROUTES:
                collocation.given_back = (lambda *_: ()) if route == ROUTES[0] else kept
                errors, spent = [], []
                for x in starts:
                    began = time.process_time()
                    try:
                        plan = optimise(
                            ROBOT, Task(modes, Box.point(x), reach=0.2), Options(fine=fine),
                            friction=not route.startswith('comp'),
                        )  # fmt: skip
                    except PlanningError:
                        continue
                    spent.append(time.process_time() - began)
                    errors.append(error(plan, route))
                lines.append(
                    f'| {" -> ".join(modes)} | {fine} | {route} | {len(starts) - len(errors)} | '
                    f'{np.median(errors):.2g} | {np.quantile(errors, 0.9):.2g} | '
                    f'{1e3 * np.median(spent):.1f} |'
                )
                print(lines[-1], flush=True)
    text = '# Planning with dry friction\n\n' + '\n'.join(lines) + '\n'
    if options.write:
        RESULT.write_text(text)


if __name__ == '__main__':
    main()
