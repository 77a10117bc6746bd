"""The index of the encoder, while a person turns the joint (CiA 402, touch probe). No ROS.

The drive holds no torque. It latches the counts at the rising edge of the encoder's index, however
fast that goes by, and the host reads them when they are there. As nothing acts, a drive that says
nothing for some cycles, or is in a fault, does not end it; one that answers no transfer does.
"""

from cg_hardware.drive import cia402
from cg_hardware.drive.objects import Objects
from cg_hardware.drive.procedure import Procedure, Steps

LOOKS_EVERY = 0.05  # s


class IndexByHand(Procedure):
    """One turn by hand."""

    name, moves_zero = 'index by hand', False

    def _find(self) -> Steps[None]:
        yield from self.done(self._arm)
        while not (yield from self.done(self._latched)):
            looked = self.clock()
            while self.clock() - looked < LOOKS_EVERY:
                yield cia402.DISABLE_VOLTAGE
        self.index = yield from self.done(
            lambda objects: objects.read(cia402.PROBE_POSITION, signed=True)
        )

    @staticmethod
    def _arm(objects: Objects) -> None:
        objects.write(cia402.PROBE, 0, 0, 2)
        objects.write(cia402.PROBE, 0, cia402.PROBE_AT_INDEX, 2)

    @staticmethod
    def _latched(objects: Objects) -> bool:
        return bool(objects.read(cia402.PROBE_STATUS) & cia402.PROBE_LATCHED)

    def _restore(self, objects: Objects) -> None:
        objects.write(cia402.PROBE, 0, 0, 2)
