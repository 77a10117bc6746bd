"""ROS node of the balance controller.

The law is in balancing/balance.py, what it shares with others in state_feedback.py.

in    /state, /applied_torque
out   /torque_command, /diagnostics
"""

from dataclasses import dataclass
from typing import Any

from cg_control.balancing.balance import BALANCING, BalanceController
from cg_control.state_feedback import FeedbackNode, FeedbackSettings
from cg_interfaces.ros import run
from cg_interfaces.settings import setting


@dataclass(frozen=True)
class BalanceNodeSettings(FeedbackSettings):
    """Parameters of the balance node."""

    elastic: bool = setting(
        False, 'design on the transmission too; the observer must have the same model'
    )


class BalanceNode(FeedbackNode):
    """Publishes /torque_command."""

    well = (BALANCING,)
    controller: BalanceController

    def __init__(self, **kwargs: Any):
        super().__init__('balance', BalanceNodeSettings, **kwargs)
        self.started = True

    def elastic(self) -> bool:
        """As its parameter says."""
        return self.declared.values.elastic

    def law(self) -> BalanceController:
        """The balance controller itself."""
        return self.design.controller

    def interrupt(self) -> None:
        """It engages anew."""
        self.controller.stop()

    def figures(self) -> dict[str, Any]:
        """How often the robot fell."""
        return {'falls': self.controller.falls}


def main(args: list[str] | None = None) -> int:
    """Entry point of `ros2 run cg_control balance_node`."""
    return run(BalanceNode, BalanceNodeSettings, args)


if __name__ == '__main__':
    raise SystemExit(main())
