"""From where the balance controller catches the robot: sampled, balance.md, "The basin".

Upright, a stance phase has one unstable, one stable and one oscillating mode. In the coordinates
of these modes a state is

    capture   z, the unstable coordinate, as a lean in rad: legs parallel at rest leaning z;
    stable    the coordinate that dies out by itself, in the same measure;
    swing     a, the amplitude in rad of the swing leg's oscillation.                  (MODES)

A limited torque cannot catch a large z whatever else is true, and the more the swing leg is
already moving, the less it can. So the basin is a sampled bound c(a) on |z|: from every one of the
sampled states with |z| = c(a) / MARGIN, stable coordinate within |z| and any phase of the swing,
the closed loop of the nonlinear model, friction and torque limit included, came to rest. That loop
knows its state; MARGIN leaves room for an observer, delay and elasticity.

All states of one amplitude and one bound are rolled out at once, so a leg takes a fraction of a
second. The basins of the default weights are shipped all the same (config/balance_basins.yaml,
made by bench/balance_basins.py): a machine without a C compiler needs minutes.
"""

import functools
from collections.abc import Mapping as Mapped
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cg_control.balancing.linearise import linearise_stance
from cg_description.reading import parse_yaml, read_text
from cg_description.schema import Key, ListOf, Mapping, Number, Text
from cg_dynamics.assemble import parameter_vector
from cg_dynamics.linearise import without_extra_states
from cg_dynamics.model import Model
from cg_dynamics.rig import STANCES, Setup
from cg_dynamics.rollout.batch import Feedback, simulate_batch
from cg_dynamics.rollout.compiled import compile_model

SWINGS = (0.0, 0.1, 0.2, 0.3)  # rad
SAMPLES = 24  # states tried at each swing amplitude and capture coordinate
HALVINGS = 6
LARGEST = 0.16  # rad: beyond what 40 N m can hold back in the linear model
DURATION = 4.0  # s
SAMPLE_TIME = 0.002  # s
MARGIN = 0.9
AT_REST = 0.05  # rad and rad/s of the stance leg at the end
FALLEN = 0.5  # rad
NUMBERS = ListOf(Number())
SHIPPED = ListOf(Mapping({
    'model': Key(Text(), 'name of the robot'),
    'model_sha256': Key(Text(), 'hash of the model'),
    'torque_limit': Key(Number(positive=True), unit='N m'),
    'gains': Key(Mapping({s: Key(NUMBERS) for s in STANCES}), 'K of the four states'),
    'bounds': Key(Mapping({s: Key(NUMBERS) for s in STANCES}), 'c(a)', unit='rad'),
}))  # fmt: skip


@dataclass(frozen=True)
class Modes:
    """(MODES) of one stance leg.

    Attributes:
        to_modes: x -> (capture, stable, swing cosine, swing sine), shape (4, 4).
        to_state: Its inverse.
    """

    to_modes: np.ndarray
    to_state: np.ndarray

    def split(self, x: np.ndarray) -> tuple[float, float, float]:
        """Capture, stable coordinate and swing amplitude of a state, rad."""
        capture, stable, cosine, sine = self.to_modes @ x[:4]
        return float(capture), float(stable), float(np.hypot(cosine, sine))

    def state(self, capture: float, stable: float, swing: float, phase: float) -> np.ndarray:
        """State (4,) of these coordinates."""
        modes = [capture, stable, swing * np.cos(phase), swing * np.sin(phase)]
        return self.to_state @ np.array(modes)


def modes_of(model: Model, stance: str) -> Modes:
    """(MODES) of a model's linearisation upright; friction, which damps the swing, left out."""
    for effect in model.effects:
        if effect.place == 'joint' or effect.friction:
            model = model.without_effect(effect.label)
    linear = linearise_stance(model, stance)
    values, left = np.linalg.eig(linear.A.T)
    parallel = np.array([1.0, 1.0, 0.0, 0.0])
    swinging = np.array([0.0, 1.0, 0.0, 0.0] if stance == 'inner' else [1.0, 0.0, 0.0, 0.0])
    rows = []
    for value in (values.real.argmax(), values.real.argmin()):
        row = left[:, value].real
        rows.append(row / (row @ parallel))
    row = left[:, values.imag.argmax()]
    row = row / (row @ swinging)
    to_modes = np.array([*rows, row.real, row.imag])
    return Modes(to_modes, np.linalg.inv(to_modes))


@dataclass(frozen=True)
class Basin:
    """|capture| <= bound(swing), |stable| <= bound(swing).

    Attributes:
        modes: Coordinates in which it is said.
        bounds: c(a) in rad at the amplitudes SWINGS; beyond the last one nothing is inside.
    """

    modes: Modes
    bounds: tuple[float, ...]

    def bound(self, swing: float) -> float:
        """c(a) in rad; zero beyond the amplitudes that were sampled."""
        return float(np.interp(swing, SWINGS, self.bounds, right=0.0))

    def depth(self, x: np.ndarray) -> float:
        """How far out a state is, as a share of the bound: inside if 1 or less."""
        capture, stable, swing = self.modes.split(x)
        bound = self.bound(swing)
        return max(abs(capture), abs(stable)) / bound if bound > 0 else float('inf')

    def depth_to_leave(self, x: np.ndarray) -> float:
        """As `depth`, for a robot that is inside and swings its leg further than was sampled.

        The last bound counts then, and up to twice the last amplitude is inside: there is no jump
        that noise of the rates could fall over.
        """
        capture, stable, swing = self.modes.split(x)
        bound = self.bound(min(swing, SWINGS[-1]))
        if bound <= 0:
            return float('inf')
        beyond = swing / (2.0 * SWINGS[-1])
        return max(abs(capture) / bound, abs(stable) / bound, beyond if beyond > 1.0 else 0.0)

    def draw(self, rng: np.random.Generator, share: float = 1.0) -> np.ndarray:
        """A random state (4,) inside, or inside a share of it."""
        swing = rng.uniform(0.0, SWINGS[-1])
        reach = share * self.bound(swing)
        return self.modes.state(
            rng.uniform(-reach, reach),
            rng.uniform(-reach, reach),
            swing,
            rng.uniform(0, 2 * np.pi),
        )


def sample_basin(
    model: Model, stance: str, gain: np.ndarray, torque_limit: float, seed: int = 0
) -> Basin:
    """Sample the basin of u = clip(-K x) on the nonlinear model.

    Args:
        model: Its effects without extra states take part, dry friction among them.
        stance: Stance leg.
        gain: K, of the first four states, shape (4,).
        torque_limit: In N m.
        seed: Of the directions.
    """
    modes = modes_of(model, stance)
    closed_loop = _ClosedLoop(model, stance, gain, torque_limit)
    bounds: list[float] = []
    for swing in SWINGS:
        rng = np.random.default_rng(seed)
        shapes = [
            ((-1.0) ** i, rng.uniform(-1, 1), rng.uniform(0, 2 * np.pi)) for i in range(SAMPLES)
        ]
        low, high = 0.0, bounds[-1] if bounds else LARGEST
        for _ in range(HALVINGS):
            z = (low + high) / 2
            states = [modes.state(sign * z, s * z, swing, phase) for sign, s, phase in shapes]
            low, high = (z, high) if closed_loop.catches(np.array(states)) else (low, z)
        bounds.append(low)
    return Basin(modes, tuple(round(MARGIN * bound, 5) for bound in bounds))


class _ClosedLoop:
    """The nonlinear model under u = clip(-K x)."""

    def __init__(self, model: Model, stance: str, gain: np.ndarray, torque_limit: float):
        self.model, self.setup = without_extra_states(model), Setup(stance=stance)
        self.p = parameter_vector(self.model, self.setup)
        self.standing = STANCES.index(stance)
        self.time = np.arange(round(DURATION / SAMPLE_TIME) + 1) * SAMPLE_TIME
        rows, nu = len(self.time), compile_model(self.model, self.setup).nu
        gains = np.zeros((rows, nu, 4))
        gains[:, 0] = np.asarray(gain, float).ravel()[:4]
        limit = np.full(nu, np.inf)
        limit[0] = torque_limit
        # Inputs beside the torque are factors: one means that nothing is switched off.
        self.u = np.ones((rows, nu))
        self.u[:, 0] = 0.0
        self.feedback = Feedback(gains, np.zeros((rows, 4)), limit)

    def catches(self, x0: np.ndarray) -> bool:
        """True if the robot comes to rest from all these states, shape (n, 4)."""
        x = simulate_batch(
            self.model, self.setup, self.time, self.u, x0, self.p,
            trajectories=True, feedback=self.feedback,
        )  # fmt: skip
        lean, rate = x[:, :, self.standing], x[:, :, 2 + self.standing]
        upright = np.abs(lean).max(axis=1) < FALLEN
        at_rest = (np.abs(lean[:, -1]) < AT_REST) & (np.abs(rate[:, -1]) < AT_REST)
        return bool((upright & at_rest).all())


def shipped_file() -> Path:
    """Where the shipped basins are: beside the sources, or in the share directory."""
    package = Path(__file__).resolve().parents[1]
    name = Path('config') / 'balance_basins.yaml'
    for folder in (package.parent, *(p / 'share' / 'cg_control' for p in package.parents)):
        if (folder / name).is_file():
            return folder / name
    return package.parent / name


@functools.cache
def _shipped_entries() -> list[dict]:
    path = shipped_file()
    if not path.is_file():
        return []
    return SHIPPED.of(parse_yaml(read_text(path), str(path)), str(path))


def shipped_basins(
    model: Model, gains: Mapped[str, np.ndarray], torque_limit: float
) -> dict[str, Basin] | None:
    """The shipped basins, if they are of this model, these gains and this limit."""
    for entry in _shipped_entries():
        same = entry['torque_limit'] == torque_limit and entry['model_sha256'] == model.hash
        # Gains are printed with 6 digits; a basin does not change with the seventh.
        if same and all(
            np.allclose(gains[s][:4], entry['gains'][s], rtol=1e-5, atol=1e-5) for s in STANCES
        ):
            return {s: Basin(modes_of(model, s), tuple(entry['bounds'][s])) for s in STANCES}
    return None
