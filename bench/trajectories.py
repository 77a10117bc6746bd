"""Planning beside plain CasADi and Drake, and TVLQR beside solve_ivp: one run, tables of ratios.

    python bench/trajectories.py             prints the tables
    python bench/trajectories.py --write     stores them as bench/results/trajectories.md

The stance problem: the inner leg stands, the robot goes from a start to the impact pose
(0.2, -0.2) rad at (0.8, 0.2) rad/s, free duration of 0.1 to 2 s, |u| <= 40 N m, 40 intervals of
Hermite-Simpson, cost the integral (trapezoid) of 0.01 u^2 + 0.1, cold start from a straight
line and 0.9 s. No friction, hip body without mass (Drake's has no joint that bisects). A start is
made by driving the model backward in time from the goal under a random torque, so that a motion
is known to exist. Costs are computed by one formula from what each solver returns. Everybody gets
the same starts; a start counts as solved if the solver says so and the end is met. Times are CPU
time of the process; only ratios of one run are a result.
"""

import argparse
import importlib
import importlib.util
import platform
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
from scipy.integrate import solve_ivp

from cg_control.balancing.linearise import design_model
from cg_control.trajectories.collocation import Options, optimise, planning_model, screen
from cg_control.trajectories.program import GUESSES, Program
from cg_control.trajectories.task import Box, Task
from cg_control.trajectories.tvlqr import Weights, balance_regulator, linearised, riccati
from cg_description.paths import model_path
from cg_dynamics.assemble import assemble, parameter_vector
from cg_dynamics.model import Model
from cg_dynamics.rig import Setup
from cg_dynamics.rollout.compiled import compile_model

RESULT = Path(__file__).parent / 'results' / 'trajectories.md'
ROBOT = Model.load(model_path('compass_gait_mit'))
PLANT = planning_model(ROBOT, False).with_values({'c3': 1e-7, 'c6': 0.0})
VALUES = PLANT.values
GOAL = np.array([0.2, -0.2, 0.8, 0.2])
N, LIMIT, SHORTEST, LONGEST = 40, 40.0, 0.1, 2.0
EFFORT, TIME = 0.01, 0.1
MET = 1e-3  # rad and rad/s of the ends
SETUP = Setup()
P = parameter_vector(PLANT, SETUP)
CLASSIC = {
    'leg_length': 1.0, 'total_mass': 20.0, 'c1': 0.0625 + 1e-7, 'c2': 0.0625 + 1e-7, 'c3': 1e-7,
    'c4': 0.125, 'c5': 0.125, 'c6': 0.0,
}  # fmt: skip

# A solution: torque at the knots, duration, states at the ends; None: not solved.
Answer = tuple[np.ndarray, float, np.ndarray, np.ndarray] | None


def feasible_starts(count: int) -> list[np.ndarray]:
    rng, compiled, found = np.random.default_rng(45), compile_model(PLANT, SETUP), []
    while len(found) < count:
        x, duration = GOAL.copy(), rng.uniform(0.3, 1.0)
        knots = rng.uniform(-15, 15, 5)
        n = 200
        for k in range(n):
            u = np.array([np.interp(k / n * 4, range(5), knots)])
            compiled.advance(x, u, P, -duration / n, 1)
        if np.abs(x[:2]).max() < 0.6 and np.abs(x[2:]).max() < 4:
            found.append(x)
    return found


def hard_starts(count: int) -> list[np.ndarray]:
    spread = np.array([0.1, 0.2, 0.4, 0.6])
    return list(np.random.default_rng(46).uniform(-1, 1, (count, 4)) * spread)


def cost_of(torque: np.ndarray, duration: float) -> float:
    mean = ((torque[:-1] ** 2 + torque[1:] ** 2) / 2).mean()
    return duration * (EFFORT * mean + TIME)


def task_from(x0: np.ndarray) -> Task:
    return Task(('inner',), Box.point(x0), Box.point(GOAL), effort=EFFORT, time=TIME)


def ours_planned(x0: np.ndarray) -> Answer:
    """As a user gets it: coarse from several guesses, then fine."""
    try:
        found = optimise(PLANT, task_from(x0), Options(fine=N))
    except ValueError:
        return None
    return found.torque, found.duration, found.states[0], found.states[-1]


def ours_cold(x0: np.ndarray) -> Answer:
    """The fine program alone, from the same guess as the others."""
    program = Program(PLANT, task_from(x0), N)
    found = program.solve(program.guess(GUESSES[0]), 200, 1e-6)
    knots = found.knots[0]
    if not found.converged:
        return None
    return knots[:, 6], found.durations[0], knots[0, :4], knots[-1, :4]


_E = assemble(PLANT, SETUP)
RATES = ca.Function('f', [_E.x, _E.u], [ca.substitute(_E.rates, _E.p, ca.SX(P))])


def opti_route() -> Callable[[np.ndarray], Answer]:
    """The script that one writes, built once: Opti, the start a parameter, IPOPT as it comes."""
    script = ca.Opti()
    start = script.parameter(4)
    X, U, T = script.variable(4, N + 1), script.variable(1, N + 1), script.variable()
    h = T / N
    cost = 0
    for k in range(N):
        x, y, u, w = X[:, k], X[:, k + 1], U[:, k], U[:, k + 1]
        f0, f1 = RATES(x, u), RATES(y, w)
        middle = (x + y) / 2 + h / 8 * (f0 - f1)
        script.subject_to(y - x == h / 6 * (f0 + 4 * RATES(middle, (u + w) / 2) + f1))
        cost += h / 2 * EFFORT * (u**2 + w**2) + h * TIME
    script.minimize(cost)
    script.subject_to(X[:, 0] == start)
    script.subject_to(X[:, N] == GOAL)
    script.subject_to(script.bounded(-LIMIT, U, LIMIT))
    script.subject_to(script.bounded(SHORTEST, T, LONGEST))
    script.solver('ipopt', {'print_time': False}, {'print_level': 0, 'sb': 'yes', 'max_iter': 500})

    def route(x0: np.ndarray) -> Answer:
        line = np.linspace(x0, GOAL, N + 1).T
        line[2:] = ((GOAL - x0)[:2] / 0.9)[:, None]
        script.set_value(start, x0)
        script.set_initial(X, line)
        script.set_initial(U, 0.0)
        script.set_initial(T, 0.9)
        try:
            done = script.solve()
        except RuntimeError:
            return None
        x = done.value(X)
        return np.ravel(done.value(U)), float(done.value(T)), x[:, 0], x[:, -1]

    return route


def opti_rebuilt(x0: np.ndarray) -> Answer:
    """The same, built for every solve."""
    return opti_route()(x0)


def drake_route(name: str) -> Callable[[np.ndarray], Answer]:
    drake: Any = importlib.import_module('pydrake.all')
    plant = drake_plant(drake)
    context = plant.CreateDefaultContext()
    solver = {'IPOPT': drake.IpoptSolver, 'SNOPT': drake.SnoptSolver}[name]()

    def relative(x):
        return np.array([x[0], x[1] - x[0], x[2], x[3] - x[2]])

    def solve(x0: np.ndarray) -> Answer:
        problem = drake.DirectCollocation(
            plant, context, N + 1, SHORTEST / N, LONGEST / N,
            input_port_index=plant.get_actuation_input_port().get_index(),
        )  # fmt: skip
        program = problem.prog()
        problem.AddEqualTimeIntervalsConstraints()
        u = problem.input()
        problem.AddConstraintToAllKnotPoints(u[0] <= LIMIT)
        problem.AddConstraintToAllKnotPoints(u[0] >= -LIMIT)
        a, b = relative(x0), relative(GOAL)
        program.AddBoundingBoxConstraint(a, a, problem.initial_state())
        program.AddBoundingBoxConstraint(b, b, problem.final_state())
        problem.AddRunningCost(EFFORT * u[0] ** 2 + TIME)
        line = np.linspace(a, b, N + 1).T
        line[2:] = ((b - a)[:2] / 0.9)[:, None]
        states = drake.PiecewisePolynomial.FirstOrderHold(np.linspace(0, 0.9, N + 1), line)
        problem.SetInitialTrajectory(drake.PiecewisePolynomial(), states)
        done = solver.Solve(program, program.initial_guess())
        if not done.is_success():
            return None
        times = problem.GetSampleTimes(done)
        torque = problem.GetInputSamples(done)[0]
        x = problem.GetStateSamples(done)
        back = np.array([x[0], x[0] + x[1], x[2], x[2] + x[3]])
        return torque, float(times[-1]), back[:, 0], back[:, -1]

    return solve


def drake_plant(drake: Any) -> Any:
    """The two links as a MultibodyPlant; angles are (stance, hip)."""
    l, mt = VALUES['leg_length'], VALUES['total_mass']
    legs = []
    for inertia, moment in (('c1', 'c4'), ('c2', 'c5')):
        mass = 0.3 * mt
        below = VALUES[moment] * mt * l / mass
        legs.append((mass, below, VALUES[inertia] * mt * l**2 - mass * below**2))
    hip = 0.4 * mt
    (m1, d1, i1), swing = legs
    mass = m1 + hip
    centre = (m1 * (l - d1) + hip * l) / mass
    inertia = i1 + m1 * (l - d1 - centre) ** 2 + hip * (l - centre) ** 2
    plant = drake.MultibodyPlant(0.0)
    plant.mutable_gravity_field().set_gravity_vector([0, 0, -VALUES['gravity']])
    parent = plant.world_body()
    parts = (('stance', mass, centre, inertia, 0.0), ('hip', swing[0], -swing[1], swing[2], l))
    for name, m, z, i, place in parts:
        body = plant.AddRigidBody(
            name,
            drake.SpatialInertia.MakeFromCentralInertia(
                m, [0, 0, z], drake.RotationalInertia(i, i, i)
            ),
        )
        frame = plant.AddFrame(
            drake.FixedOffsetFrame(
                f'{name}_joint', parent.body_frame(), drake.RigidTransform([0, 0, place])
            )
        )
        joint = plant.AddJoint(drake.RevoluteJoint(name, frame, body.body_frame(), [0, 1, 0]))
        parent = body
    # +u on our inner leg is -u on Drake's relative joint; u^2 does not mind.
    plant.AddJointActuator('motor', joint)
    plant.Finalize()
    return plant


def tried(route: Callable[[np.ndarray], Answer], x0: np.ndarray) -> tuple[float, float]:
    """Seconds and cost of one start; NaN where it is not solved."""
    began = time.process_time()
    answer = route(x0)
    seconds = time.process_time() - began
    met = answer is not None and (
        max(np.abs(answer[2] - x0).max(), np.abs(answer[3] - GOAL).max()) < MET
    )
    return seconds, cost_of(answer[0], answer[1]) if met and answer else np.nan


def stance_table(counts: dict[str, int]) -> list[str]:
    starts = feasible_starts(200)
    routes: dict[str, Callable[[np.ndarray], Answer]] = {
        'this package, coarse then fine': ours_planned,
        'this package, fine alone, same guess': ours_cold,
        'Opti built once, IPOPT': opti_route(),
        'Opti rebuilt, IPOPT': opti_rebuilt,
    }
    if importlib.util.find_spec('pydrake'):
        for name in ('IPOPT', 'SNOPT'):
            routes[f'Drake DirectCollocation, {name}'] = drake_route(name)
    found: dict[str, list[tuple[float, float]]] = {name: [] for name in routes}
    for route in routes.values():
        route(starts[0])
    # Start by start, so that what else the machine does falls on all routes.
    for k, x0 in enumerate(starts):
        for name, route in routes.items():
            if k < counts.get(name.split()[0], 200):
                found[name].append(tried(route, x0))
    results = {name: tuple(np.array(rows).T) for name, rows in found.items()}
    best_seconds, best_costs = results['this package, coarse then fine']
    lines = [
        '| route | starts | solved | median ms | x ours | cost / ours | dearer | cheaper |',
        '|---|---:|---:|---:|---:|---:|---:|---:|',
    ]
    for name, (seconds, costs) in results.items():
        n = len(seconds)
        ratio = costs / best_costs[:n]
        both = ratio[np.isfinite(ratio)]
        lines.append(
            f'| {name} | {n} | {100 * np.isfinite(costs).mean():.1f} % | '
            f'{1e3 * np.median(seconds):.1f} | '
            f'{np.median(seconds) / np.median(best_seconds[:n]):.1f} | {np.median(both):.4f} | '
            f'{100 * (both > 1.01).mean():.0f} % | {100 * (both < 0.99).mean():.0f} % |'
        )
    return lines


def agreement_lines(count: int) -> list[str]:
    starts, agree, undecided, times = hard_starts(count), 0, 0, {'feasible': [], 'infeasible': []}
    screen(PLANT, task_from(starts[0]))
    feasible = 0
    for x0 in starts:
        task = task_from(x0)
        began = time.process_time()
        said = screen(PLANT, task)
        seconds = time.process_time() - began
        program = Program(PLANT, task, N)
        truth = any(program.solve(program.guess(guess), 100, 1e-6).converged for guess in GUESSES)
        if said.best is not None and not truth:
            start = said.best.resampled(N)
            truth = program.solve(start, 100, 1e-6).converged
        feasible += truth
        if said.verdict == 'undecided':
            undecided += 1
            continue
        agree += (said.verdict == 'feasible') == truth
        times[said.verdict].append(seconds)
    decided = count - undecided
    return [
        f'Of {count} random starts, {feasible} feasible for the fine program from any of '
        f'{len(GUESSES)} guesses or from the coarse motion, the coarse screen agrees on '
        f'{agree} of {decided} = {100 * agree / decided:.1f} %, and leaves {undecided} undecided. '
        f'Median time to say "feasible" {1e3 * np.median(times["feasible"]):.1f} ms, '
        f'"infeasible" {1e3 * np.median(times["infeasible"]):.1f} ms '
        f'(90 %: {1e3 * np.quantile(times["infeasible"], 0.9):.1f} ms).',
    ]


def motions_table() -> list[str]:
    walker = planning_model(ROBOT, False).with_values(CLASSIC)
    anywhere = Box.anywhere()
    free = {'periodic': True, 'durations': (0.2, 1.5)}
    tasks = {
        'passive gait on 3 degrees, 20 intervals': (
            walker, Task(('inner',), anywhere, anywhere, torque_limit=0.0, slope=0.0525,
                         reach=0.2, **free), 20, GUESSES[1],
        ),
        'gait on flat ground, 20 intervals': (
            walker, Task(('inner',), anywhere, anywhere, reach=0.4, **free), 20, GUESSES[1],
        ),
        'one-step rebalance, 2 x 20 intervals, no friction': (
            planning_model(ROBOT, False), Task(('inner', 'outer'), reach=0.2), 20, GUESSES[0],
        ),
        'one-step rebalance, 2 x 20 intervals, friction': (
            ROBOT, Task(('inner', 'outer'), reach=0.2), 20, GUESSES[0],
        ),
    }  # fmt: skip
    lines = [
        '| motion | one solve from a guess, ms | coarse then fine, ms | cost |',
        '|---|---:|---:|---:|',
    ]
    for name, (model, task, n, guess) in tasks.items():
        program = Program(planning_model(model), task, n)
        cold, whole = [], []
        for _ in range(11):
            began = time.process_time()
            one = program.solve(program.guess(guess), 200, 1e-6)
            cold.append(time.process_time() - began)
            began = time.process_time()
            done = optimise(model, task, Options(fine=n))
            whole.append(time.process_time() - began)
        said = f'{1e3 * np.median(cold):.1f}' if one.converged else 'not solved'
        lines.append(
            f'| {name} | {said} | {1e3 * np.median(whole):.1f} | {done.provenance["cost"]:.4f} |'
        )
    return lines


def tvlqr_lines() -> list[str]:
    step = optimise(ROBOT, Task(('inner', 'outer'), reach=0.2), Options(fine=49))
    phase, weights, design = step.phases[0], Weights(), design_model(ROBOT)
    S = balance_regulator(ROBOT, 'inner').S
    Q, R = weights.Q('inner'), weights.R

    def backward(t, s):
        M, point = s.reshape(4, 4), phase.at(t)
        A, B = (m[0] for m in linearised(
            design, 'inner', point.state[None], np.array([point.torque])
        ))  # fmt: skip
        return -(Q + M @ A + A.T @ M - M @ B @ B.T @ M / R[0, 0]).ravel()

    def ivp():
        return solve_ivp(backward, (phase.end, phase.start), S.ravel(), rtol=1e-6, atol=1e-6)

    def timed(what, repetitions):
        what()
        found = []
        for _ in range(repetitions):
            began = time.process_time()
            what()
            found.append(time.process_time() - began)
        return float(np.median(found))

    ours = timed(lambda: riccati(design, phase, Q, R, S), 50)
    theirs = timed(ivp, 9)
    S0 = riccati(design, phase, Q, R, S)[1][0]
    exact = (
        solve_ivp(
            backward, (phase.end, phase.start), S.ravel(), rtol=1e-10, atol=1e-10, method='LSODA'
        )
        .y[:, -1]
        .reshape(4, 4)
    )
    error = np.abs(S0 - exact).max() / np.abs(exact).max()
    return [
        f'TVLQR of one phase with 50 knots: {1e3 * ours:.2f} ms; solve_ivp (RK45, tolerance 1e-6, '
        f'the same linearisation) {1e3 * theirs:.1f} ms, {theirs / ours:.0f} x. '
        f'S(0) differs from a fine integration by {100 * error:.4f} %.',
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--write', action='store_true', help=f'store {RESULT}')
    parser.add_argument('--opti', type=int, default=100, help='starts for Opti [100]')
    parser.add_argument('--drake', type=int, default=40, help='starts for Drake [40]')
    arguments = parser.parse_args()
    counts = {'Opti': arguments.opti, 'Drake': arguments.drake}
    lines = [
        '# Trajectories',
        '',
        f'Command: `python bench/trajectories.py --write`. Python {platform.python_version()}, '
        f'casadi {ca.__version__}, numpy {np.__version__}; CPU time. What is compared is said at '
        'the top of `bench/trajectories.py`.',
        '',
        *stance_table(counts),
        '',
        'Cost is the median of the ratios. "Dearer" and "cheaper": share of the starts whose cost '
        'is more than 1 % off ours.',
        '',
        *agreement_lines(200),
        '',
        *motions_table(),
        '',
        *tvlqr_lines(),
        '',
    ]
    text = '\n'.join(lines)
    print(text)
    if arguments.write:
        RESULT.write_text(text)


if __name__ == '__main__':
    main()
