"""What each way to a velocity does to the balancing loop: seed 4.3 and 4.4 as one table.

    python bench/balance.py             writes bench/results/balance_flexible.md   (2 min)
    python bench/balance.py imu_mount   writes bench/results/balance_imu_mount.md  (2 min)
    python bench/balance.py --basin     writes bench/results/balance_basin.md      (3 min)

The robot is compass_gait_flexible (harmonic drive resonant at 10.6 Hz) or compass_gait_imu_mount
(bracket of the IMU resonant there); either has a drive 3 ms late, an encoder of 20000 counts, a
noisy IMU, 500 Hz. Observer and controller know compass_gait_mit, the rigid model, but for the
rows with the extended model, which is that of the robot.
"""

import argparse
import dataclasses
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from cg_bringup.balancing import BalanceRun, balance, power_above
from cg_control.balancing.balance import BalanceController, BalanceSettings, balance_gains
from cg_control.balancing.basin import shipped_basins
from cg_description.model_file import write_atomically
from cg_description.paths import model_path
from cg_dynamics.model import Model
from cg_dynamics.plant import Plant
from cg_dynamics.rig import STANCES, Setup
from cg_estimation.derivative import Derivative
from cg_estimation.estimator import Estimator
from cg_estimation.high_gain import HighGainObserver
from cg_estimation.kalman import ExtendedKalmanFilter

RESULTS = Path(__file__).resolve().parent / 'results'
RIGID = Model.load(model_path('compass_gait_mit'))
T = 0.002
SETTINGS = BalanceSettings()
LENGTH = 3.0  # s
HOLD = 5.0  # s
START = 0.02  # rad, from which 'balances' is judged
PUSH_AT = 1.0  # s
SHAKING = 5.0  # N m above 8 Hz: an eighth of what the drive can do, for nothing


Make = Callable[[Model, Setup], Estimator]


@dataclasses.dataclass(frozen=True)
class Variant:
    """A row of the table: what estimates, on which model, and which filter the torque passes."""

    name: str
    estimator: Make
    extended: bool = False
    output_filter_hz: float = 0.0


def filtered(kind: str, cutoff: float) -> Make:
    return lambda model, setup: Derivative(model, setup, T, kind, cutoff, use_gyro=True)


def observed(epsilon: float) -> Make:
    return lambda model, setup: HighGainObserver(model, setup, epsilon)


VARIANTS = (
    Variant('raw derivative', filtered('none', 1.0)),
    Variant('first order on input, 5 Hz', filtered('first_order', 5.0)),
    Variant('first order on input, 20 Hz', filtered('first_order', 20.0)),
    Variant('first order on output, 5 Hz', filtered('none', 1.0), output_filter_hz=5.0),
    Variant('first order on output, 20 Hz', filtered('none', 1.0), output_filter_hz=20.0),
    Variant('Chebyshev I, 5th order, 8 Hz', filtered('chebyshev', 8.0)),
    Variant('Chebyshev I, 5th order, 20 Hz', filtered('chebyshev', 20.0)),
    Variant('observer, eps 0.02', observed(0.02)),
    Variant('observer, eps 0.2', observed(0.2)),
    Variant('observer, eps 0.02, extended model', observed(0.02), extended=True),
    Variant('observer, eps 0.2, extended model', observed(0.2), extended=True),
    Variant(
        'extended Kalman filter, extended model',
        lambda model, setup: ExtendedKalmanFilter(model, setup, T, disturbance=5.0),
        extended=True,
    ),
)


class Rig:
    """A robot, and the laws that are designed for it."""

    def __init__(self, robot: Model):
        self.robot = robot
        self.models = {False: RIGID, True: robot}
        self.gains = {
            False: balance_gains(RIGID, SETTINGS, T),
            True: balance_gains(robot, SETTINGS, T, elastic=True),
        }

    def run(
        self,
        variant: Variant,
        stance: str,
        x0: np.ndarray,
        seed: int = 0,
        length: float = LENGTH,
        pushes: tuple[tuple[float, float], ...] = (),
        basins: dict | None = None,
    ) -> BalanceRun:
        """The loop with that variant, from x0, shape (4,)."""
        setup = Setup(stance=stance)
        settings = dataclasses.replace(SETTINGS, output_filter_hz=variant.output_filter_hz)
        controller = BalanceController(RIGID, settings, self.gains[variant.extended], basins)
        plant = Plant(self.robot, setup, x0, T, seed)
        estimator = variant.estimator(self.models[variant.extended], setup)
        return balance(plant, estimator, controller, length, pushes)


def leaning(lean: float) -> np.ndarray:
    return np.array([lean, lean, 0.0, 0.0])


def largest(holds: Callable[[float], bool], high: float, halvings: int = 5) -> float:
    """The largest value up to `high` for which `holds`, by bisection; 0 if none is found."""
    low = 0.0
    for _ in range(halvings):
        middle = (low + high) / 2
        low, high = (middle, high) if holds(middle) else (low, middle)
    return low


def row(rig: Rig, variant: Variant, stance: str) -> str:
    run = rig.run
    motion = run(variant, stance, leaning(START), length=HOLD)
    half = motion.torque[len(motion.torque) // 2 :]
    cells = [variant.name, stance]
    if not motion.upright(HOLD):
        fell = f'falls after {motion.time[-1]:.1f} s'
        return '| ' + ' | '.join([*cells, fell, '', '', '', '', '']) + ' |'
    reach = largest(lambda a: run(variant, stance, leaning(a)).upright(LENGTH), 0.1)
    push = largest(
        lambda P: run(variant, stance, leaning(0.0), pushes=((PUSH_AT, P),)).upright(LENGTH), 4.0
    )
    nudged = run(variant, stance, leaning(0.0), pushes=((PUSH_AT, 0.5),))
    before = np.abs(nudged.lean[nudged.time < PUSH_AT]).max()
    after = np.abs(nudged.lean[nudged.time >= PUSH_AT]).max()
    high = power_above(half, T, 8.0)
    cells += [
        'shaking' if high > SHAKING else 'yes',
        f'{reach:.3f}',
        f'{np.sqrt(np.mean(half**2)):.2f}',
        f'{high:.2f}',
        f'{1e3 * max(after - before, 0.0):.0f}',
        f'{push:.2f}',
    ]
    return '| ' + ' | '.join(cells) + ' |'


def table(rig: Rig, name: str) -> Iterator[str]:
    yield f'# Ways to a velocity, in the balancing loop of {rig.robot.name}'
    yield ''
    yield f'`python bench/balance.py {name}`; what follows from it: balance.md.'
    yield ''
    yield (
        '| velocities from | stance | balances from 0.02 rad | from how far, rad '
        '| torque RMS, N m | of that above 8 Hz, N m | lean after 0.5 N s, mrad '
        '| largest push, N s |'
    )
    yield '|---|---|---|---:|---:|---:|---:|---:|'
    for variant in VARIANTS:
        for stance in STANCES:
            yield row(rig, variant, stance)


def basin(rig: Rig) -> Iterator[str]:
    run = rig.run
    variant = next(v for v in VARIANTS if v.name == 'observer, eps 0.2')
    basins = shipped_basins(RIGID, rig.gains[False], RIGID.torque_limit)
    yield '# Starts inside the stated basin, and ten minutes'
    yield ''
    yield '`python bench/balance.py --basin`; observer with eps 0.2, rigid model.'
    yield ''
    yield '| stance | stated bound of the capture coordinate, rad | starts | caught |'
    yield '|---|---|---:|---:|'
    for stance in STANCES:
        rng = np.random.default_rng(7)
        caught = sum(
            run(variant, stance, basins[stance].draw(rng), seed, basins=basins).upright(LENGTH)
            for seed in range(100)
        )
        bounds = ', '.join(f'{b:.3f}' for b in basins[stance].bounds)
        yield f'| {stance} | {bounds} | 100 | {caught} |'
    yield ''
    yield '| stance | held, s | pushes, N s | largest lean after the first 2 s, rad | torque RMS |'
    yield '|---|---:|---|---:|---:|'
    pushes = tuple((10.0 * k, 0.5 * (-1) ** k) for k in range(1, 60))
    for stance in STANCES:
        motion = run(variant, stance, leaning(0.06), 1, 600.0, pushes, basins)
        late = motion.time > 2.0
        yield (
            f'| {stance} | {motion.time[-1] + T:.0f} | {len(pushes)} of 0.5, both ways '
            f'| {np.abs(motion.lean[late]).max():.3f} '
            f'| {np.sqrt(np.mean(motion.torque[late] ** 2)):.2f} N m |'
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('robot', nargs='?', choices=('flexible', 'imu_mount'), default='flexible')
    parser.add_argument('--basin', action='store_true', help='100 starts and ten minutes')
    options = parser.parse_args()
    rig = Rig(Model.load(model_path(f'compass_gait_{options.robot}')))
    text = '\n'.join(basin(rig) if options.basin else table(rig, options.robot)) + '\n'
    name = 'balance_basin.md' if options.basin else f'balance_{options.robot}.md'
    write_atomically(RESULTS / name, text)
    print(text)


if __name__ == '__main__':
    main()
