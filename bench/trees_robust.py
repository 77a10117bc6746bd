"""Does a tree make a better robot? Pushes and starts, and a robot that is not as it is known.

    python bench/trees_robust.py [--robots 40] [--workers 2] [--write]

The loop is that of the nodes without ROS (cg_bringup/balancing.py), 500 Hz in lock-step, torque
gate and torque limit included. *Starts* are states of the box in which the tree was grown, outside
its goal regions, which a preview of the nominal robot brings home: they are the same for everyone.
*Pushes* hit the hip of a robot that stands upright, forward, with 3 or 4 N s, on either leg.
Where nothing is random these are four cases, and there is no fifth robot to a row. A robot came
home if it is upright for the last half second of 4 s.

    balance     the balance controller alone
    rebalance   that, and the one-step rebalance once the state has left its basin
    funnels     the tree, by its funnels alone
    previews    the tree, with previews on the robot as it is known

Errors: the six lumps and both frictions differ uniformly by up to so much (bench/rebalance.py).
Delay: of the torque. Velocity noise: white, on both rates that the controller is told. Torque
noise: white, on what is commanded. Payloads: a point mass on a leg pair, so high above the foot;
`nominal`: nobody knows of it; `true`: model, balance and previews do; `diagnosed`: they believe in
the model that a diagnosis made of eight records of 6 s of the loaded robot, on springs and with a
leg held (bench/rebalance.py), the whole library tried. The step of `rebalance` is planned for what
is known, the tree is the nominal one throughout. In sums over payloads the same starts and pushes
count once for each, so that their intervals say too much. The state is known exactly unless the
row says otherwise.
"""

import argparse
import multiprocessing
import platform
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import cache
from itertools import product
from pathlib import Path

import numpy as np
from rebalance import diagnosed, wrong_robot
from trees_live import DURATION, EPSILONS, Known, came_home, share

from cg_bringup.balancing import balance
from cg_bringup.recover_run import RecoverOptions, start_of
from cg_control.balancing.balance import (
    BALANCING,
    BalanceController,
    BalanceSettings,
    Command,
    balance_gains,
)
from cg_control.balancing.basin import sample_basin, shipped_basins
from cg_control.following.execution import ExecutionSettings, TrajectoryController
from cg_control.following.planning import plan
from cg_control.trajectories.collocation import Options
from cg_control.trajectories.task import Task
from cg_control.trees.preview import LANDING
from cg_control.trees.recovery import ReadyTree, RecoverySettings, TreeController
from cg_control.trees.tree import Tree
from cg_control.trees.tree_files import tree_path
from cg_description.model_file import write_atomically
from cg_description.paths import model_path
from cg_dynamics.model import Model
from cg_dynamics.plant import Plant
from cg_dynamics.rig import STANCES, Setup
from cg_estimation.high_gain import HighGainObserver

PUSHED_AT = 0.5  # s
LET_GO = 1.2  # depth in the basin at which the one-step rebalance begins
IMPULSES = (3.0, 4.0)  # N s
CASES = len(IMPULSES) * len(STANCES)
CONTROLLERS = ('balance', 'rebalance', 'funnels', 'previews')
PAYLOADS = (('inner', 1.5, 0.4), ('inner', 1.2, 0.9), ('outer', 0.8, 0.7), ('outer', 2.0, 0.3))
BELIEFS = ('nominal', 'diagnosed', 'true')
RESULT = Path(__file__).parent / 'results' / 'trees_robust.md'
MODEL = Model.load(model_path('compass_gait_mit'))

Payload = tuple[str, float, float]  # leg pair, kg, m above the foot


@dataclass(frozen=True)
class Condition:
    """What differs from the exact robot.

    Attributes:
        words: Of the table.
        error: Of lumps and friction, as a share.
        delay: Of the torque, s.
        velocity_noise: Standard deviation, rad/s.
        torque_noise: Likewise, N m.
        epsilon: Of the observer with sensor noise, s; None: the state is known.
        payload: Leg pair, kg, m above the foot.
        belief: In what the controllers believe: 'nominal', 'diagnosed' or 'true'.
    """

    words: str
    error: float = 0.0
    delay: float = 0.0
    velocity_noise: float = 0.0
    torque_noise: float = 0.0
    epsilon: float | None = None
    payload: Payload | None = None
    belief: str = 'nominal'

    def robot(self, seed: int) -> Model:
        """The robot that moves."""
        robot = loaded(self.payload) if self.payload else wrong_robot(self.error, seed)
        if self.delay:
            robot = robot.with_effect('actuator_delay', delay=self.delay)
        return robot

    @property
    def random(self) -> bool:
        """Whether two robots that are pushed alike fare differently."""
        noise = self.velocity_noise or self.torque_noise or self.epsilon is not None
        return bool(self.error or noise)


CONDITIONS = (
    Condition('exact'),
    Condition('errors of 5 %', error=0.05),
    Condition('errors of 10 %', error=0.10),
    Condition('observer, sensor noise', epsilon=EPSILONS[0]),
    Condition('observer, sensor noise, errors of 5 %', error=0.05, epsilon=EPSILONS[0]),
    Condition('delay of 4 ms', delay=0.004),
    Condition('delay of 8 ms', delay=0.008),
    Condition('velocity noise of 0.1 rad/s', velocity_noise=0.1),
    Condition('velocity noise of 0.3 rad/s', velocity_noise=0.3),
    Condition('torque noise of 5 N m', torque_noise=5.0),
    Condition('torque noise of 15 N m', torque_noise=15.0),
    *(
        Condition(f'{mass:g} kg on the {leg} pair, {height:g} m, {what}',
                  payload=(leg, mass, height), belief=what)
        for leg, mass, height in PAYLOADS for what in BELIEFS
    ),
)  # fmt: skip


@cache
def loaded(payload: Payload | None) -> Model:
    """The nominal robot with a payload."""
    if payload is None:
        return MODEL
    site, mass, height = payload
    return MODEL.with_effect('payload', site, mass=mass, distance=height)


DIAGNOSED: dict[Payload, Model] = {}


def take_diagnosed(models: dict[Payload, Model]) -> None:
    """In a worker: what was diagnosed before it began."""
    DIAGNOSED.update(models)


@cache
def believed(belief: str, payload: Payload | None) -> Model:
    """The robot as the controllers know it."""
    if belief == 'diagnosed':
        return DIAGNOSED[payload]
    return loaded(payload) if belief == 'true' else MODEL


@cache
def design(belief: str, payload: Payload | None) -> tuple:
    """Gains and basins of the balance controller."""
    known = believed(belief, payload)
    gains = balance_gains(known, BalanceSettings(), LANDING.sample_time)
    basins = shipped_basins(known, gains, known.torque_limit) or {
        leg: sample_basin(known, leg, gains[leg], known.torque_limit) for leg in STANCES
    }
    return gains, basins


class Rebalance:
    """Balances, and takes a planned step when the state leaves the basin."""

    def __init__(self, balancing: BalanceController, known: Model, steps: dict):
        settings = ExecutionSettings(start_tolerance=1.0)
        self._controller = TrajectoryController(balancing, known, settings)
        self._balancing, self._steps = balancing, steps

    @property
    def mode(self) -> str:
        """As `TreeController.mode`."""
        mode = self._controller.mode
        return BALANCING if mode == 'caught' else mode

    @property
    def torque_limit(self) -> float:
        """N m."""
        return self._balancing.torque_limit

    def step(self, stamp_ns: int, stance: str, x: np.ndarray) -> Command:
        """The torque for a state."""
        command = self._controller.step(stamp_ns, stance, x)
        if self.mode == BALANCING and self._balancing.basins[stance].depth(x) > LET_GO:
            self._controller.start(self._steps[stance])
        return command


class Shaky:
    """A controller whose commands, and whose knowledge of the rates, are noisy."""

    def __init__(self, controller, condition: Condition, seed: int):
        self._controller, self._condition = controller, condition
        self._rng = np.random.default_rng([seed, 5])

    def __getattr__(self, name: str):
        return getattr(self._controller, name)

    def step(self, stamp_ns: int, stance: str, x: np.ndarray) -> Command:
        """The torque for a state."""
        told = np.array(x, float)
        told[2:4] += self._condition.velocity_noise * self._rng.standard_normal(2)
        command = self._controller.step(stamp_ns, stance, told)
        if not self._condition.torque_noise or command.torque == 0.0:
            return command
        noisy = command.torque + self._condition.torque_noise * self._rng.standard_normal()
        limit = self._controller.torque_limit
        return replace(command, torque=float(np.clip(noisy, -limit, limit)))


@cache
def tree() -> Tree:
    """The one that comes along."""
    return Tree.load(tree_path(RecoverOptions().tree), MODEL)


@cache
def starts(count: int) -> list[tuple[str, np.ndarray]]:
    """States that a preview of the nominal robot brings home."""
    return [start_of(tree(), MODEL, seed) for seed in range(1, count + 1)]


@cache
def steps(belief: str, payload: Payload | None) -> dict:
    """Leg that stands -> the one-step rebalance to the other one."""
    known = believed(belief, payload)
    return {
        leg: plan(known, Task((leg, other), reach=0.2), Options(fine=25))
        for leg, other in (STANCES, STANCES[::-1])
    }


@cache
def ready(belief: str, payload: Payload | None) -> ReadyTree:
    """The tree on a robot as it is known."""
    return ReadyTree.of(tree(), believed(belief, payload))


def controller_of(name: str, belief: str, payload: Payload | None):
    """A fresh controller."""
    # Nobody who believes in the nominal robot asks what it carries.
    payload = None if belief == 'nominal' else payload
    known, (gains, basins) = believed(belief, payload), design(belief, payload)
    settings = RecoverySettings(preview=name == 'previews')
    balancing = BalanceController(known, settings, gains, basins)
    if name == 'balance':
        return balancing
    if name == 'rebalance':
        return Rebalance(balancing, known, steps(belief, payload))
    found = TreeController(balancing, settings)
    found.take(ready(belief, payload))
    return found


def fares(job: tuple[int, str, str, int, int]) -> bool:
    """Whether one robot comes home.

    Args:
        job: Condition, controller, 'start' or 'push', number, how many there are.
    """
    number, name, kind, k, count = job
    condition = CONDITIONS[number]
    stance, x, pushes = STANCES[k % 2], np.zeros(4), []
    if kind == 'start':
        stance, x = starts(count)[k]
    else:
        pushes = [(PUSHED_AT, IMPULSES[k // 2 % len(IMPULSES)])]
    setup = Setup(stance=stance, on_blocks=False)
    plant = Plant(condition.robot(k), setup, x, seed=k, minimum_step=LANDING.minimum_step)
    if condition.epsilon is None:
        observer = Known(plant)
    else:
        known = believed(condition.belief, condition.payload)
        observer = HighGainObserver(known, setup, condition.epsilon)
    law = controller_of(name, condition.belief, condition.payload)
    controller = Shaky(law, condition, k)
    return came_home(balance(plant, observer, controller, DURATION, pushes))


def row_of(words: str, hits: np.ndarray, of: np.ndarray) -> str:
    """A row of the table: how many came home, by controller, of starts and then of pushes."""
    cells = [share(int(some), int(every)) for some, every in zip(hits, of, strict=True)]
    return f'| {words} | ' + ' | '.join(cells) + ' |'


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition('\n')[0])
    parser.add_argument('--robots', type=int, default=40, help='starts, and pushes, of a row')
    parser.add_argument('--workers', type=int, default=multiprocessing.cpu_count())
    parser.add_argument('--write', action='store_true', help='store the table')
    options = parser.parse_args()
    count, lines, named = options.robots, [], []
    for payload in PAYLOADS:
        leg, mass, height = payload
        DIAGNOSED[payload], causes = diagnosed(loaded(payload))
        numbers = ', '.join(
            f'{name} {value:.3g}' for name, value in DIAGNOSED[payload].values.items()
            if name.startswith(tuple(f'{cause}.' for cause in causes.split(', ')))
        )  # fmt: skip
        named.append(f'| {mass:g} kg on the {leg} pair, {height:g} m | {numbers or causes} |')
        print(named[-1], flush=True)
    head = ' | '.join(f'{kind}: {name}' for kind in ('starts', 'pushes') for name in CONTROLLERS)
    with ProcessPoolExecutor(
        options.workers, multiprocessing.get_context('spawn'), take_diagnosed, (DIAGNOSED,)
    ) as pool:
        hits, of = np.zeros((2, len(CONDITIONS), 2 * len(CONTROLLERS)), int)
        for number, condition in enumerate(CONDITIONS):
            for column, (kind, name) in enumerate(product(('start', 'push'), CONTROLLERS)):
                same = kind == 'push' and not condition.random
                robots = range(min(count, CASES) if same else count)
                jobs = [(number, name, kind, k, count) for k in robots]
                hits[number, column] = sum(pool.map(fares, jobs, chunksize=4))
                of[number, column] = len(jobs)
            lines.append(row_of(condition.words, hits[number], of[number]))
            print(lines[-1], flush=True)
    for belief in BELIEFS:
        rows = [k for k, c in enumerate(CONDITIONS) if c.payload and c.belief == belief]
        words = f'all {len(rows)} payloads, {belief}'
        lines.append(row_of(words, hits[rows].sum(axis=0), of[rows].sum(axis=0)))
    text = '\n'.join([
        '# A tree against errors, noise, delay and payloads',
        '',
        f'`python bench/trees_robust.py --robots {count} --write`, Python '
        f'{platform.python_version()}, {multiprocessing.cpu_count()} cores. What is compared is '
        f'said at the top of the script. Tree: {len(tree().nodes)} nodes. Intervals are of 95 %.',
        '',
        f'| robot | {head} |',
        '|---|' + '---|' * (2 * len(CONTROLLERS)),
        *lines,
        '',
        '| hidden payload | named by the diagnosis |',
        '|---|---|',
        *named,
        '',
    ])  # fmt: skip
    print(text)
    if options.write:
        write_atomically(RESULT, text)


if __name__ == '__main__':
    main()
