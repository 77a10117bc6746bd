"""Gains and basin of a balance controller whose weights change while it runs. No ROS.

Gains are there within a millisecond, in the thread that asks. The basin of new gains comes later,
from a process that was there before (basin_sampler.py). Until then the one before holds, made
smaller in proportion where the torque limit was lowered: how far a limited torque reaches is
proportional to the limit (balance.md, "The basin").
"""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from cg_control.balancing.balance import WEIGHTS, BalanceController, BalanceDesign, BalanceSettings
from cg_control.balancing.basin import SWINGS, Basin, modes_of, shipped_basins
from cg_control.balancing.basin_sampler import BasinError, BasinSampler
from cg_dynamics.model import Model
from cg_dynamics.rig import STANCES

FIRST_BASIN = 60.0  # s that the first basin may take; a compiler needs some of the first


class LiveDesign:
    """The balance controller of a model file, and what keeps it up to date.

    Args:
        path: File of the model.
        model: The same, loaded.
        settings: At the start.
        sample_time: Over which the torque is held, s.
        elastic: Feed back the states of the transmission too.
        log: Takes what the user wants to know.

    Attributes:
        controller: Its gains and basin are those of its settings, or on their way.
    """

    def __init__(
        self,
        path: Path,
        model: Model,
        settings: BalanceSettings,
        sample_time: float,
        elastic: bool = False,
        log: Callable[[str], None] = print,
    ):
        self._design = BalanceDesign(model, sample_time, elastic)
        self._log = log
        self._judged: tuple[BalanceSettings, dict[str, np.ndarray]] | None = None
        gains = self._design.gains(settings)
        self.controller = BalanceController(model, settings, gains)
        limit = self.controller.torque_limit
        basins = shipped_basins(model, gains, limit)
        self._sampler = BasinSampler(path, model)
        if basins is None:
            log('sampling the basin of these gains')
            self._sampler.ask(gains, limit)
            basins = self._answer(lambda: self._sampler.wait(FIRST_BASIN))
        # Nobody knows from where the controller catches the robot: nowhere, then.
        self.controller.basins = basins or {
            stance: Basin(modes_of(model, stance), (0.0,) * len(SWINGS)) for stance in STANCES
        }

    def judge(self, settings: BalanceSettings) -> None:
        """Raise an LqrError if there is no regulator for these settings."""
        if _weights(settings) != _weights(self.controller.settings):
            self._judged = (settings, self._design.gains(settings))

    def adopt(self, settings: BalanceSettings) -> None:
        """Let new settings act from the next step on, and ask for their basin."""
        before, limit = self.controller.settings, self.controller.torque_limit
        gains = None
        if _weights(settings) != _weights(before):
            if self._judged is None or _weights(self._judged[0]) != _weights(settings):
                self.judge(settings)
            assert self._judged is not None
            gains = self._judged[1]
        self.controller.adopt(settings, gains)
        if gains is not None or self.controller.torque_limit != limit:
            self._sampler.ask(self.controller.gains, self.controller.torque_limit)
        lowered = self.controller.torque_limit / limit
        if lowered < 1.0:
            self.controller.basins = {
                stance: replace(basin, bounds=tuple(lowered * bound for bound in basin.bounds))
                for stance, basin in (self.controller.basins or {}).items()
            }

    def collect(self) -> None:
        """Take over a basin that has been sampled since."""
        basins = self._answer(self._sampler.collect)
        if basins is not None:
            self.controller.basins = basins

    def _answer(self, ask: Callable) -> dict | None:
        try:
            basins = ask()
        except BasinError as error:
            self._log(f'no basin of these gains, the one before holds: {error}')
            return None
        if basins is not None:
            bounds = (f'{stance} {basin.bounds[0]:.3f} rad' for stance, basin in basins.items())
            self._log(f'basin sampled: {", ".join(bounds)}')
        return basins

    def close(self) -> None:
        """End the sampling process."""
        self._sampler.close()


def _weights(settings: BalanceSettings) -> tuple[float, ...]:
    return tuple(getattr(settings, name) for name in WEIGHTS)
