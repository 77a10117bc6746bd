"""How well each estimator knows the rates, against the truth of the simulated machine.

    python bench/observer.py        writes bench/results/observer.md        (1 min)

Two records of 10 s at 500 Hz for each robot: on springs, excited by a multisine of 5 N m RMS, and
balancing with pushes. All estimators replay the same readings: two angles, no gyro.
"""

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from cg_bringup.balancing import balance
from cg_control.balancing.balance import BalanceController, BalanceSettings, balance_gains
from cg_description.model_file import write_atomically
from cg_description.paths import model_path
from cg_dynamics.model import Model
from cg_dynamics.plant import Plant
from cg_dynamics.rig import Setup
from cg_estimation.derivative import Derivative
from cg_estimation.estimator import Estimator, replay
from cg_estimation.high_gain import HighGainObserver
from cg_estimation.kalman import ExtendedKalmanFilter, SteadyKalmanFilter
from cg_sysid.experiments.catalogue import load_experiment
from cg_sysid.experiments.excitation import ExcitationSettings, make_signal

RESULT = Path(__file__).resolve().parent / 'results' / 'observer.md'
RIGID = Model.load(model_path('compass_gait_mit'))
FLEXIBLE = Model.load(model_path('compass_gait_flexible'))
T, LENGTH, SETTLED = 0.002, 10.0, 500
SPRINGS = load_experiment('spring_stabilised_inner').setup
STANDING = Setup(stance='inner')
SEEDS = (1, 2, 3)

Make = Callable[[Model, Setup], Estimator]
ESTIMATORS: tuple[tuple[str, Make], ...] = (
    ('raw derivative', lambda m, s: Derivative(m, s, T)),
    ('first order, 10 Hz', lambda m, s: Derivative(m, s, T, 'first_order', 10.0)),
    ('Chebyshev I, 5th order, 20 Hz', lambda m, s: Derivative(m, s, T, 'chebyshev', 20.0)),
    ('steady Kalman filter', lambda m, s: SteadyKalmanFilter(m, s, T, 20.0)),
    ('extended Kalman filter', lambda m, s: ExtendedKalmanFilter(m, s, T, 2.0)),
    ('observer, eps 0.02', lambda m, s: HighGainObserver(m, s, 0.02)),
    ('observer, eps 0.05', lambda m, s: HighGainObserver(m, s, 0.05)),
    ('observer, eps 0.2', lambda m, s: HighGainObserver(m, s, 0.2)),
    ('observer, eps 0.2, as printed', lambda m, s: HighGainObserver(m, s, 0.2, 'printed')),
)


def record(robot: Model, setup: Setup, torque: Callable[[float], float], x0: np.ndarray):
    """Stamps, torque, readings and true states of an open-loop run."""
    plant = Plant(robot, setup, x0, T, seed=11)
    rows = []
    for k in range(round(LENGTH / T)):
        measurement = plant.measure()
        u = torque(k * T)
        rows.append((measurement.time_ns, u, measurement.outputs, plant.state))
        plant.latch(np.array([u]))
        plant.advance()
    stamps, torques, readings, states = zip(*rows, strict=True)
    outputs = {c: np.array([r[c] for r in readings]) for c in readings[0]}
    return np.array(stamps), np.array(torques), outputs, np.array(states)


def on_springs(robot: Model):
    signal = make_signal(
        ExcitationSettings(kind='multisine', amplitude=5.0, duration=LENGTH, seed=5)
    )
    return SPRINGS, record(robot, SPRINGS, signal, np.array([0.0, 0.1, 0.0, 0.0]))


def balancing(robot: Model):
    settings = BalanceSettings()
    controller = BalanceController(RIGID, settings, balance_gains(RIGID, settings, T))
    plant = Plant(robot, STANDING, np.array([0.04, 0.04, 0.0, 0.0]), T, seed=12)
    observer = HighGainObserver(RIGID, STANDING, 0.1)
    pushes = [(2.0 * k, 0.5 * (-1) ** k) for k in range(1, 5)]
    run = balance(plant, observer, controller, LENGTH, pushes)
    assert run.upright(LENGTH)
    stamps = np.round(run.time * 1e9).astype(int)
    return STANDING, (stamps, run.torque, run.readings, run.states)


def off(model: Model, seed: int) -> Model:
    """All lumps and friction 10 % off, signs at random, such that real bodies have them."""
    rng = np.random.default_rng(seed)
    names = [*(f'c{i}' for i in range(1, 7)), 'viscous_friction.coefficient',
             'coulomb_friction.torque']  # fmt: skip
    for _ in range(100):
        signs = rng.choice([-0.1, 0.1], len(names))
        wrong = model.with_values(
            {n: model.values[n] * (1 + s) for n, s in zip(names, signs, strict=True)}
        )
        if all(value > 0 for value in model.mechanism.consistency(wrong.values)):
            return wrong
    raise ValueError('no consistent set of wrong parameters was drawn')


def rate_error(make: Make, model: Model, setup: Setup, data) -> float:
    stamps, torque, outputs, states = data
    estimates = replay(make(model, setup), stamps, torque, outputs)
    return float(np.sqrt(np.mean((estimates[SETTLED:, 2:4] - states[SETTLED:, 2:4]) ** 2)))


def table() -> Iterator[str]:
    yield '# RMS error of both rates against the truth, rad/s'
    yield ''
    yield (
        '`python bench/observer.py`. Rigid robot: compass_gait_mit. Flexible robot: '
        'compass_gait_flexible, estimated with the rigid model (before a diagnosis) and with its '
        f'own (after). 10 % off: mean over {len(SEEDS)} draws of signs.'
    )
    for name, make_record in (('On springs', on_springs), ('Balancing, with pushes', balancing)):
        setup, rigid = make_record(RIGID)
        _, flexible = make_record(FLEXIBLE)
        yield ''
        yield f'## {name}'
        yield ''
        yield (
            '| estimator | rigid robot, right model | rigid robot, 10 % off '
            '| flexible robot, before | flexible robot, after | after / before |'
        )
        yield '|---|---:|---:|---:|---:|---:|'
        for label, make in ESTIMATORS:
            right = rate_error(make, RIGID, setup, rigid)
            wrong = np.mean([rate_error(make, off(RIGID, s), setup, rigid) for s in SEEDS])
            before = rate_error(make, RIGID, setup, flexible)
            after = rate_error(make, FLEXIBLE, setup, flexible)
            yield (
                f'| {label} | {right:.4f} | {wrong:.4f} | {before:.4f} | {after:.4f} '
                f'| {after / before:.2f} |'
            )


def main() -> None:
    text = '\n'.join(table()) + '\n'
    write_atomically(RESULT, text)
    print(text)


if __name__ == '__main__':
    main()
