"""Parameters of the drive node: the bus, the joint, homing, readings, feet. No ROS."""

import math
import typing
from dataclasses import dataclass
from typing import Any

from cg_description.reading import DocumentError, parse_yaml, path_of, read_text, shown
from cg_hardware.drive import cia402, drivers
from cg_hardware.drive.homing import HomingPlan
from cg_hardware.drive.readings import Limits, Quantity
from cg_hardware.drive.watch import WATCHES
from cg_hardware.safety import GateSettings
from cg_interfaces.settings import setting

METHODS = (*cia402.TO_INDEX, *cia402.IN_PLACE)


@dataclass(frozen=True)
class DriveSettings(GateSettings):
    """Parameters of the drive node: those of the gate, and these."""

    driver: str = setting(drivers.CIA402, 'cia402, or a driver of yours (drive/drivers.py)')
    interface: str = setting('socketcan', "python-can's name of the adapter")
    channel: str = setting('can0', 'of the adapter')
    bitrate: int = setting(1_000_000, 'of the bus', unit='bit/s', minimum=10_000)
    node_id: int = setting(1, 'number of the drive on the bus', minimum=1, maximum=126)
    watch: str = setting(
        'heartbeat', 'how the drive sees that the host is there', choices=tuple(WATCHES)
    )
    sign: float = setting(
        1.0, '1, or -1 where positive torque of the drive turns the joint backward',
        minimum=-1.0, maximum=1.0,
    )  # fmt: skip
    gear: float = setting(
        1.0, 'torque at the joint per torque of the motor', minimum=1e-3, maximum=1e4
    )
    counts_per_turn: float = setting(
        20_000.0, 'counts of the encoder per turn of the joint; negative where it counts backward'
    )

    zero_file: str = setting(
        '', 'file that keeps how the zero of the hip was found, YAML; empty for none'
    )
    absolute_encoder: bool = setting(
        False, 'the encoder keeps its counts without power, so that the zero of zero_file holds'
    )
    index_offset: float = setting(
        0.0, 'from the index of the encoder to the zero of the hip, forward positive',
        unit='rad', minimum=-math.pi, maximum=math.pi, live=True,
    )  # fmt: skip
    homing_method: int = setting(
        34, 'of ~/home: 33 and 34 go to the index, in negative and positive direction of the '
        'counts of the drive; 35 and 37 take the place where the hip is',
        minimum=min(METHODS), maximum=max(METHODS), live=True,
    )  # fmt: skip
    homing_speed: float = setting(
        0.1, 'of the joint while the drive homes', unit='rad/s', minimum=0.001, maximum=2.0,
        live=True,
    )  # fmt: skip
    homing_acceleration: float = setting(
        0.5, 'of the joint while the drive homes', unit='rad/s^2', minimum=0.01, maximum=50.0,
        live=True,
    )  # fmt: skip
    homing_torque: float = setting(
        10.0, 'largest torque at the joint while the drive homes (0x6072); 0 leaves it to the '
        'drive', unit='N m', minimum=0.0, maximum=200.0, live=True,
    )  # fmt: skip
    homing_travel: float = setting(
        0.5, 'way of the joint after which a homing without an index has failed; 0 for no limit',
        unit='rad', minimum=0.0, maximum=2 * math.pi, live=True,
    )  # fmt: skip
    homing_timeout: float = setting(
        20.0, 'time after which a homing has failed', unit='s', minimum=1.0, maximum=300.0,
        live=True,
    )  # fmt: skip
    hand_timeout: float = setting(
        60.0, 'time in which a person turns the hip through the index', unit='s', minimum=1.0,
        maximum=600.0, live=True,
    )  # fmt: skip
    speed_unit: float = setting(
        1.0, 'speed of the encoder that the drive calls 1 in 0x6099 and, by s, 0x609A',
        unit='counts/s', minimum=1e-6, maximum=1e6,
    )  # fmt: skip

    inner_foot: int = setting(
        16, 'bit of the digital inputs (0x60FD) that is the switch of the inner feet, -1 for none',
        minimum=-1, maximum=31,
    )  # fmt: skip
    outer_foot: int = setting(
        17, 'bit of the digital inputs that is the switch of the outer feet, -1 for none',
        minimum=-1, maximum=31,
    )  # fmt: skip
    inner_retraction: int = setting(
        -1, 'bit of the digital outputs (0x60FE) that draws the inner feet in, -1 for none',
        minimum=-1, maximum=31,
    )  # fmt: skip
    outer_retraction: int = setting(
        -1, 'bit of the digital outputs that draws the outer feet in, -1 for none',
        minimum=-1, maximum=31,
    )  # fmt: skip
    retraction_stale_after: float = setting(
        0.5, 'age of a request beyond which a foot goes out again', unit='s', minimum=0.01,
        maximum=10.0,
    )  # fmt: skip

    readings_period: float = setting(
        1.0, 'from one reading of voltage and temperature to the next', unit='s', minimum=0.05,
        maximum=60.0,
    )  # fmt: skip
    temperature_index: int = setting(
        0, "object of the drive's temperature, as its maker has it; 0 for none", minimum=0,
        maximum=0xFFFF,
    )  # fmt: skip
    temperature_subindex: int = setting(0, 'of that object', minimum=0, maximum=254)
    temperature_scale: float = setting(
        0.1, 'temperature per count of that object', unit='degC', minimum=1e-6, maximum=1e3
    )
    temperature_warn: float = setting(
        70.0, 'of the drive at which people are warned, 0 for none', unit='degC', minimum=0.0,
        maximum=300.0, live=True,
    )  # fmt: skip
    temperature_error: float = setting(
        85.0, 'of the drive at which it is disabled, 0 for none', unit='degC', minimum=0.0,
        maximum=300.0, live=True,
    )  # fmt: skip
    voltage_low_error: float = setting(
        0.0, 'of the DC link (0x6079), so low that the drive is disabled, 0 for none', unit='V',
        minimum=0.0, maximum=1000.0, live=True,
    )  # fmt: skip
    voltage_low_warn: float = setting(
        0.0, 'of the DC link, so low that people are warned, 0 for none', unit='V', minimum=0.0,
        maximum=1000.0, live=True,
    )  # fmt: skip
    voltage_high_warn: float = setting(
        0.0, 'of the DC link, so high that people are warned, 0 for none', unit='V', minimum=0.0,
        maximum=1000.0, live=True,
    )  # fmt: skip
    voltage_high_error: float = setting(
        0.0, 'of the DC link, so high that the drive is disabled, 0 for none', unit='V',
        minimum=0.0, maximum=1000.0, live=True,
    )  # fmt: skip

    def __post_init__(self) -> None:
        super().__post_init__()
        drivers.found(self.driver)
        if abs(self.sign) != 1.0:
            raise ValueError(f'sign is {self.sign:g}; it must be 1 or -1')
        if not 1 <= abs(self.counts_per_turn) < math.inf:
            raise ValueError(f'counts_per_turn is {self.counts_per_turn:g}; 1 or more are needed')
        if self.homing_method not in METHODS:
            raise ValueError(
                f'homing_method is {self.homing_method}; allowed are '
                f'{", ".join(map(str, METHODS))}'
            )
        for one, other in (
            ('inner_foot', 'outer_foot'), ('inner_retraction', 'outer_retraction'),
        ):  # fmt: skip
            bit = getattr(self, one)
            if bit >= 0 and bit == getattr(self, other):
                raise ValueError(f'{one} and {other} are both bit {bit}; each needs its own')

    @property
    def bus(self) -> dict:
        """What python-can opens."""
        return {'interface': self.interface, 'channel': self.channel, 'bitrate': self.bitrate}

    @property
    def counts_per_rad(self) -> float:
        """Of the joint; negative where the encoder counts backward."""
        return self.counts_per_turn / (2 * math.pi)

    @property
    def switches(self) -> dict[str, int]:
        """Leg -> bit of the inputs that its foot switch has."""
        return _wired(inner=self.inner_foot, outer=self.outer_foot)

    @property
    def retractions(self) -> dict[str, int]:
        """Leg -> bit of the outputs that draws its foot in."""
        return _wired(inner=self.inner_retraction, outer=self.outer_retraction)

    @property
    def temperature(self) -> Quantity | None:
        """What is read of it; None where no object is named."""
        if self.temperature_index == 0:
            return None
        return Quantity(
            'temperature of the drive', 'degC', self.temperature_index, self.temperature_subindex,
            self.temperature_scale, signed=True,
        )  # fmt: skip

    @property
    def temperature_limits(self) -> Limits:
        """Of it."""
        return Limits(self.temperature_error, self.temperature_warn)

    @property
    def voltage_limits(self) -> Limits:
        """Of the DC link."""
        return Limits(
            self.voltage_high_error, self.voltage_high_warn,
            self.voltage_low_warn, self.voltage_low_error,
        )  # fmt: skip

    def homing_plan(self, per_mille: float) -> HomingPlan:
        """How to home.

        Args:
            per_mille: What the drive calls a torque of 1 N m at the joint.
        """
        per_rad = abs(self.counts_per_rad)
        return HomingPlan(
            method=self.homing_method,
            speed=max(1, round(self.homing_speed * per_rad / self.speed_unit)),
            acceleration=max(1, round(self.homing_acceleration * per_rad / self.speed_unit)),
            torque=max(1, round(self.homing_torque * per_mille)) if self.homing_torque else 0,
            travel=round(self.homing_travel * per_rad),
            time_limit=self.homing_timeout,
        )


VOLTAGE = Quantity('DC link', 'V', cia402.DC_LINK, 0, 1e-3, signed=False)


def read_settings(path: str) -> dict[str, Any]:
    """Parameters of the drive node in a YAML file: a mapping of names and values.

    Raises:
        DocumentError: naming the file, the parameter, and what is allowed.
    """
    found = parse_yaml(read_text(path_of(path)), path)
    if not isinstance(found, dict):
        raise DocumentError(f'{path}: must be a mapping of parameters of the drive node')
    kinds = typing.get_type_hints(DriveSettings)
    for name, value in found.items():
        if name not in kinds:
            raise DocumentError(f'{path}: the drive node has no parameter {shown(name)}')
        if kinds[name] is float and type(value) is int:
            found[name] = float(value)
        elif type(value) is not kinds[name]:
            raise DocumentError(
                f'{path}: {name} is {shown(value)}; a {kinds[name].__name__} is needed'
            )
    try:
        DriveSettings(**found)
    except ValueError as error:
        raise DocumentError(f'{path}: {error}') from error
    return found


def _wired(**bits: int) -> dict[str, int]:
    return {leg: bit for leg, bit in bits.items() if bit >= 0}
