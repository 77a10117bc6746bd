"""Balancing upright on one leg: LQR, who may engage when, and what ends it.

    u = -K_stance x + friction,   |u| <= torque_limit                                  (BAL)

K is the sampled LQR of the design model (linearise.py) for that stance leg; its sign comes out
of the model, since +u acts on the inner legs whatever leg stands. The weights are 1/scale^2
(Bryson): a lean of `lean_scale` weighs as much as a torque of `torque_scale`.

The controller is idle (zero torque) until it is armed and the state is inside the stated basin.
It hands over smoothly: the difference to the torque before dies out over `hand_over`, when it
engages, when gains change and when the stance leg changes. It ends with a fall (zero torque until
armed again), and at once when the state is not finite.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from cg_control.balancing.basin import Basin
from cg_control.balancing.linearise import discretise, linearise_stance
from cg_control.balancing.lqr import LqrError, dlqr
from cg_control.friction import FrictionCompensation, FrictionSettings
from cg_dynamics.model import Model
from cg_dynamics.rig import STANCES
from cg_interfaces.settings import setting
from cg_interfaces.stamps import NS_PER_S

IDLE, BALANCING, FALLEN = 'idle', 'balancing', 'fallen'


@dataclass(frozen=True)
class BalanceSettings(FrictionSettings):
    """Parameters of the balance controller."""

    armed: bool = setting(
        True,
        'engage when the state is in the basin; after a fall: set false, then true',
        live=True,
    )
    lean_scale: float = setting(
        0.075, 'lean of the stance leg that weighs as much as torque_scale', unit='rad',
        minimum=1e-6, maximum=1e6, live=True,
    )  # fmt: skip
    swing_scale: float = setting(
        0.3, 'angle of the swing leg that weighs as much as torque_scale', unit='rad',
        minimum=1e-6, maximum=1e6, live=True,
    )  # fmt: skip
    lean_rate_scale: float = setting(
        0.12, 'rate of the stance leg that weighs as much as torque_scale', unit='rad/s',
        minimum=1e-6, maximum=1e6, live=True,
    )  # fmt: skip
    swing_rate_scale: float = setting(
        8.0, 'rate of the swing leg that weighs as much as torque_scale', unit='rad/s',
        minimum=1e-6, maximum=1e6, live=True,
    )  # fmt: skip
    torque_scale: float = setting(
        40.0, 'torque that weighs as much as each of the scales', unit='N m',
        minimum=1e-6, maximum=1e6, live=True,
    )  # fmt: skip
    torque_limit: float = setting(
        0.0, 'largest torque commanded; 0 takes the limit of the model', unit='N m', minimum=0.0,
        live=True,
    )  # fmt: skip
    basin_share: float = setting(
        1.0, 'share of the stated basin inside which the controller engages',
        minimum=0.0, maximum=1.5, live=True,
    )  # fmt: skip
    fall_angle: float = setting(
        0.4, 'lean of the stance leg that counts as a fall', unit='rad', minimum=0.05, maximum=1.5,
        live=True,
    )  # fmt: skip
    largest_swing: float = setting(
        1.7, 'angle of the swing leg that counts as a fall', unit='rad', minimum=0.1, maximum=3.1,
        live=True,
    )  # fmt: skip
    hand_over: float = setting(
        0.02, 'time constant with which the torque before dies out', unit='s', minimum=0.0,
        maximum=1.0, live=True,
    )  # fmt: skip
    output_filter_hz: float = setting(
        0.0, 'cutoff of a first-order filter of the torque, 0 for none', unit='Hz', minimum=0.0,
        live=True,
    )  # fmt: skip


WEIGHTS = ('lean_scale', 'swing_scale', 'lean_rate_scale', 'swing_rate_scale', 'torque_scale')


@dataclass(frozen=True)
class Command:
    """What the controller asks for.

    Attributes:
        torque: Hip torque, N m.
        mode: 'idle', 'balancing' or 'fallen'.
        reason: Why it is not balancing; empty if it is.
    """

    torque: float
    mode: str
    reason: str = ''


class BalanceDesign:
    """The regulators of a model upright, for weights that may change.

    What does not depend on the weights is done once, so that new gains take a millisecond.

    Args:
        model: A compass gait.
        sample_time: Over which the torque is held, s.
        elastic: Feed back the states of the transmission too.
    """

    def __init__(self, model: Model, sample_time: float, elastic: bool = False):
        self.sample_time = sample_time
        self._plants = {}
        for stance in STANCES:
            linear = linearise_stance(model, stance, elastic=elastic)
            to_slow, from_slow = slow_modes(linear.A)
            slow = replace(
                linear,
                A=to_slow @ linear.A @ from_slow,
                B=to_slow @ linear.B,
                rates=to_slow @ linear.rates,
            )
            self._plants[stance] = (discretise(slow, sample_time), to_slow, from_slow)

    def gains(self, settings: BalanceSettings) -> dict[str, np.ndarray]:
        """Stance -> K of (BAL), shape (nx,).

        Args:
            settings: Its scales count.

        Raises:
            LqrError: naming the stance leg for which there is no regulator.
        """
        R = np.array([[self.sample_time / settings.torque_scale**2]])
        gains = {}
        for stance, (sampled, to_slow, from_slow) in self._plants.items():
            scales = [
                settings.lean_scale,
                settings.swing_scale,
                settings.lean_rate_scale,
                settings.swing_rate_scale,
            ]
            if stance == 'outer':
                scales = [scales[1], scales[0], scales[3], scales[2]]
            # The states of a transmission, behind these four, weigh nothing.
            rows = from_slow[:4]
            Q = rows.T @ (rows * (self.sample_time / np.square(scales))[:, None])
            try:
                gains[stance] = (dlqr(sampled.A, sampled.B, Q, R).K @ to_slow)[0]
            except LqrError as error:
                raise LqrError(f'no gains for the {stance} leg as stance: {error}') from None
        return gains


def balance_gains(
    model: Model, settings: BalanceSettings, sample_time: float, elastic: bool = False
) -> dict[str, np.ndarray]:
    """Stance -> K of (BAL), shape (nx,): `BalanceDesign` for weights that stay."""
    return BalanceDesign(model, sample_time, elastic).gains(settings)


def slow_modes(A: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The four slowest modes of dx/dt = A x: x -> modes (4, nx) and back (nx, 4).

    A regulator of these alone neither sees nor is asked to damp the vibration of the transmission,
    which at the gains of balancing no delayed torque could. Of a rigid model these are all.
    """
    if len(A) == 4:
        return np.eye(4), np.eye(4)
    values, vectors = np.linalg.eig(A)
    columns = []
    for index in np.argsort(np.abs(values), kind='stable'):
        if values[index].imag >= 0:
            columns.append(vectors[:, index].real)
        if values[index].imag > 0:
            columns.append(vectors[:, index].imag)
    basis = np.column_stack(columns)
    return np.linalg.inv(basis)[:4], basis[:, :4]


class BalanceController:
    """(BAL) with its conditions. The same object runs in the node, the benches and the tests.

    Args:
        model: A compass gait.
        settings: May be replaced between steps by `adopt`.
        gains: Stance -> K.
        basins: Stance -> where it may engage; None: anywhere.
    """

    def __init__(
        self,
        model: Model,
        settings: BalanceSettings,
        gains: Mapping[str, np.ndarray],
        basins: Mapping[str, Basin] | None = None,
    ):
        self.friction = FrictionCompensation(model)
        self.model_limit = model.torque_limit
        self.settings, self.gains, self.basins = settings, dict(gains), basins
        self.mode = IDLE
        self.falls = 0
        self._designs = 0
        self._law: tuple[str, int] | None = None
        self._last_ns: int | None = None
        self._torque = 0.0
        self._offset = 0.0
        self._filtered = 0.0

    @property
    def torque_limit(self) -> float:
        """Largest torque commanded, N m."""
        return min(self.settings.torque_limit or math.inf, self.model_limit)

    def adopt(
        self, settings: BalanceSettings, gains: Mapping[str, np.ndarray] | None = None
    ) -> None:
        """New settings, and new gains with them, from the next step on."""
        self.settings = settings
        if gains is not None:
            self.gains = dict(gains)
            self._designs += 1

    def stop(self) -> None:
        """Zero torque; engages again when the state allows it."""
        self.mode = IDLE if self.mode == BALANCING else self.mode
        self._torque = self._filtered = self._offset = 0.0
        self._law, self._last_ns = None, None

    def take_over(self, torque: float) -> None:
        """Take the robot over at the next step from a controller that asks for this torque, N m.

        The difference dies out over `hand_over`, as with any other law.
        """
        self.stop()
        self._torque = self._filtered = torque

    def step(self, stamp_ns: int, stance: str, x: np.ndarray) -> Command:
        """The torque for a state.

        Args:
            stamp_ns: Instant of the state, ns.
            stance: Stance leg.
            x: (q_inner, q_outer), rates, states of the transmission if elastic, shape (nx,).
        """
        x = np.asarray(x, float)
        reason = self._doubt(stance, x)
        if reason:
            self.stop()
            return Command(0.0, self.mode, reason)
        wanted = -float(self.gains[stance] @ x[: len(self.gains[stance])])
        wanted = min(max(wanted, -self.torque_limit), self.torque_limit)
        # A different law must not make the torque jump: the difference dies out.
        law = (stance, self._designs)
        elapsed = 0.0 if self._last_ns is None else (stamp_ns - self._last_ns) / NS_PER_S
        if self.settings.hand_over == 0.0:
            self._offset = 0.0
        elif law != self._law:
            self._offset = self._torque - wanted
        else:
            self._offset *= math.exp(-max(elapsed, 0.0) / self.settings.hand_over)
        self._law = law
        torque = self._smoothed(wanted + self._offset, elapsed)
        self._torque, self._last_ns = torque, stamp_ns
        torque += self.friction.torque(x[0] - x[1], x[2] - x[3], self.settings)
        torque = min(max(torque, -self.torque_limit), self.torque_limit)
        return Command(torque, self.mode)

    def _doubt(self, stance: str, x: np.ndarray) -> str:
        """Why the torque must be zero; empty if it need not."""
        if not np.isfinite(x).all():
            return 'the state is not finite'
        if len(x) < len(self.gains[stance]):
            return f'the state has {len(x)} entries, the gains need {len(self.gains[stance])}'
        standing = STANCES.index(stance)
        if not self.settings.armed:
            self.mode = IDLE
            return 'not armed'
        if self.mode == FALLEN:
            return 'fallen; set armed to false, then to true'
        lean, swing = x[standing], x[1 - standing]
        if abs(lean) > self.settings.fall_angle or abs(swing) > self.settings.largest_swing:
            if self.mode == BALANCING:
                self.mode = FALLEN
                self.falls += 1
                return 'fallen; set armed to false, then to true'
            return f'leaning by {lean:.3g} rad, swing leg at {swing:.3g} rad'
        if self.mode == IDLE:
            depth = 0.0 if self.basins is None else self.basins[stance].depth(x)
            if not depth <= self.settings.basin_share:
                return f'outside the basin: {depth:.3g} of its bound'
            self.mode = BALANCING
        return ''

    def _smoothed(self, torque: float, elapsed: float) -> float:
        cutoff = self.settings.output_filter_hz
        if cutoff == 0.0:
            self._filtered = torque
        else:
            weight = 1.0 - math.exp(-2.0 * math.pi * cutoff * max(elapsed, 0.0))
            self._filtered += weight * (torque - self._filtered)
        return self._filtered
