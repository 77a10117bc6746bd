"""Could the robot do it at all? What a motion needs, asked before any solver.

Upright, the unstable mode of a stance phase (MODES, basin.py) obeys dz/dt = lambda z + b u, apart
from the other modes. While |u| <= U, it can be brought back only from

    |z| <= Z = |b| U / lambda,   zeta = z / Z                                      (CAPTURE)

and a robot that falls backward, zeta < -1, is lost for good: a step is taken ahead only. Within
these bounds the swing leg pays: the torque that catches the robot drives it away. And a robot that
falls forward has to get its foot ahead first. Both is seen by driving the nonlinear stance phase
with a hundred torques at the limit, switched at most twice, all at once (rollout/batch.py):

    no step      some torque makes |zeta| small while the swing leg's amplitude is below 1.2 rad
    one step     the same, or a landing after which |zeta| is small on the other leg
    more steps   the same, or a landing after which the robot does not fall backward

A motion that ends on an orbit goes on from there, so it need not be able to stop: it may exist
where the robot does not fall backward, now or after its landing.

Linear modes and a finite choice of torques err. The levels leave room for that;
bench/results/trees_screen.md has the shares of wrong noes against a census of many guesses.
"""

from dataclasses import dataclass

import numpy as np

from cg_control.balancing.basin import modes_of
from cg_control.balancing.linearise import linearise_stance
from cg_control.trajectories.collocation import Options
from cg_control.trajectories.program import GUESSES
from cg_dynamics.assemble import parameter_vector
from cg_dynamics.model import Model
from cg_dynamics.rig import STANCES, Setup
from cg_dynamics.rollout.batch import simulate_batch
from cg_dynamics.walking.impact import impact_function, other

STEP, DURATION = 0.025, 0.8  # s, of the torques that are tried
SWITCHES = (0.025, 0.075, 0.125, 0.175, 0.225, 0.3, 0.4, 0.5)  # s, of the first
BETWEEN = (0.075, 0.15, 0.3)  # s, from the first to the second
FALLEN = 0.9  # rad
SHORTER = 0.5  # a landing counts from this share of the least step on: few torques are tried
SWUNG = 1.2  # rad: amplitude of the swing leg from which it is brought back
# Levels of zeta: at the start, at best under torque, after a landing, before more steps.
HELD, CAUGHT, LANDED, AHEAD = 1.2, 0.35, 4.5, -1.5


@dataclass(frozen=True)
class Reach:
    """What B states allow, as far as this can be said without planning.

    Attributes:
        zeta: (CAPTURE) of the states, shape (B,).
        caught: Least |zeta| with the swing leg in bounds, under the torques tried; infinite where
            none was tried, because zeta says no: shape (B,).
        landing: Least |zeta| right after a landing, on the other leg; infinite if no torque that
            was tried makes the foot land ahead: shape (B,).
        ahead: Largest zeta there, minus infinity likewise, shape (B,).
    """

    zeta: np.ndarray
    caught: np.ndarray
    landing: np.ndarray
    ahead: np.ndarray

    def allows(self, steps: int) -> np.ndarray:
        """Whether a motion of so many steps that ends upright may exist, shape (B,)."""
        kept = self.caught <= CAUGHT
        if steps == 0:
            return kept
        # A robot that can be kept up has time for any step.
        return kept | (self.landing <= LANDED if steps == 1 else self.ahead >= AHEAD)

    def allows_orbit(self, steps: int) -> np.ndarray:
        """Whether a motion of so many steps that ends on an orbit may exist, shape (B,)."""
        return self.zeta > -HELD if steps == 0 else self.allows(2)


class Screen:
    """Tells states from which no motion exists.

    Args:
        model: As planned on.
        torque_limit: In N m; None takes the model's.
        slope: Fall of the ground ahead, rad.
        reach: Least step length, m.
    """

    def __init__(
        self,
        model: Model,
        torque_limit: float | None = None,
        slope: float = 0.0,
        reach: float = 0.1,
    ):
        self._model = model
        self._limit = model.torque_limit if torque_limit is None else torque_limit
        self._tangent, self._shortest = np.tan(slope), SHORTER * reach
        self._torques = self._limit * profiles()
        self._row, self._swing, self._p = {}, {}, {}
        for stance in STANCES:
            linear = linearise_stance(model, stance)
            row, _, *self._swing[stance] = modes_of(model, stance).to_modes
            growth = np.linalg.eigvals(linear.A).real.max()
            held = abs(float((row @ linear.B)[0])) * self._limit / growth
            self._row[stance] = row / max(held, 1e-9)
            self._p[stance] = parameter_vector(model, Setup(stance=stance))

    def zeta(self, stance: str, x: np.ndarray) -> np.ndarray:
        """(CAPTURE) of states (B, 4) on one leg, shape (B,)."""
        return np.asarray(x, float) @ self._row[stance]

    def reach(self, stance: str, x: np.ndarray) -> Reach:
        """What states (B, 4) on one leg allow."""
        x = np.asarray(x, float)
        zeta = self.zeta(stance, x)
        caught, landing = np.full((2, len(zeta)), np.inf)
        ahead = -landing
        tried = np.flatnonzero(zeta > -HELD)
        if len(tried):
            caught[tried], landing[tried], ahead[tried] = self._tried(stance, x[tried])
            caught[zeta > HELD] = np.inf
        return Reach(zeta, caught, landing, ahead)

    def _tried(self, stance: str, x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The attributes of `Reach` but the first, for states (B, 4)."""
        st = STANCES.index(stance)
        count, each = len(x), len(self._torques)
        time = STEP * np.arange(self._torques.shape[1])
        states = simulate_batch(
            self._model, Setup(stance=stance), time,
            np.tile(self._torques[:, :, None], (count, 1, 1)), np.repeat(x, each, axis=0),
            self._p[stance], trajectories=True, largest_step=STEP / 2,
        )  # fmt: skip
        standing, swinging = states[:, :, st], states[:, :, 1 - st]
        # NaN compares false: what ran away counts for nothing.
        up = np.logical_and.accumulate(np.abs(standing) < FALLEN, axis=1)
        cosine, sine = self._swing[stance]
        calm = up & ((states @ cosine) ** 2 + (states @ sine) ** 2 < SWUNG**2)
        best = np.where(calm, np.abs(states @ self._row[stance]), np.inf)
        caught = best.reshape(count, -1).min(axis=1)
        l = self._model.values['leg_length']
        ahead = l * (np.sin(standing) - np.sin(swinging))
        height = l * (np.cos(standing) - np.cos(swinging)) + ahead * self._tangent
        lands = (height[:, :-1] > 0) & (height[:, 1:] <= 0) & (ahead[:, 1:] > self._shortest)
        lands &= up[:, 1:]
        lane, at = np.nonzero(lands)
        least, most = np.full(count, np.inf), np.full(count, -np.inf)
        if len(lane):
            share = height[lane, at] / (height[lane, at] - height[lane, at + 1])
            before = states[lane, at]
            before += share[:, None] * (states[lane, at + 1] - before)
            v = impact_function(self._model, stance)(
                before[:, :2].T, before[:, 2:].T, self._p[stance]
            )[0]
            zeta = self.zeta(other(stance), np.column_stack([before[:, :2], np.asarray(v).T]))
            np.minimum.at(least, lane // each, np.abs(zeta))
            np.maximum.at(most, lane // each, zeta)
        return caught, least, most


def profiles() -> np.ndarray:
    """Torques that are tried, as shares of the limit, at each STEP: shape (n, DURATION / STEP).

    Either way at first, the other way after a switch, at last none or back again; or one torque
    all the time.
    """
    time = STEP * np.arange(round(DURATION / STEP) + 1)
    found = [np.full(len(time), level) for level in (-1.0, -0.5, 0.0, 0.5, 1.0)]
    for sign in (-1.0, 1.0):
        for first in SWITCHES:
            for between in BETWEEN:
                for last in (0.0, sign):
                    late = np.where(time < first + between, -sign, last)
                    found.append(np.where(time < first, sign, late))
    return np.array(found)


def cheap(steps: int, fine: int = 20) -> Options:
    """Options of a plan that is tried for one state of many: what is not found soon is left.

    One guess, and no elastic program: of the fixed guesses the one that found most motions in the
    censuses. Without a step there is time, and the fine program is solved at once: most of what
    `Reach` allows is there. A robot that needs a step falls already.

    Args:
        steps: Of the motion.
        fine: Intervals a phase.
    """
    if steps:
        return Options(
            fine=fine, guesses=1, coarse_iterations=26, starts=(GUESSES[3],), elastic=False
        )
    return Options(
        coarse=fine, fine=fine, guesses=1, coarse_iterations=30, starts=(GUESSES[2],),
        elastic=False,
    )  # fmt: skip
