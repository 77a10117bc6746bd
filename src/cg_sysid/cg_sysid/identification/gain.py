"""What a better model gains: the error of one output before and after."""

from dataclasses import dataclass

NO_GAIN = 1.1  # times the error after, below which the error before is the same


@dataclass(frozen=True)
class Gain:
    """Simulation error of one output before and after, on records held out.

    Attributes:
        channel: Output channel.
        unit: Its unit.
        before: RMS error of the nominal model, identified anew, in `unit`.
        after: RMS error of the extended model.
        noise: Noise floor of the sensor.
    """

    channel: str
    unit: str
    before: float
    after: float
    noise: float
