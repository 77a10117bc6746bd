"""States and words of a CiA 402 drive. Pure: no bus, no clock.

From IEC 61800-7-201 (CiA 402-2). A drive tells its state by bits of the statusword, and is led
from one to the next by the controlword:

    switch on disabled --shutdown--> ready to switch on --switch on--> switched on
        --enable operation--> operation enabled
    any of them --fault--> fault reaction active --> fault --fault reset--> switch on disabled
"""

from enum import Enum

CONTROLWORD, STATUSWORD = 0x6040, 0x6041
MODE, MODE_NOW = 0x6060, 0x6061  # int8
CYCLIC_TORQUE, HOMING = 10, 6
TARGET_TORQUE, ACTUAL_TORQUE = 0x6071, 0x6077  # int16, per mille of the rated torque
RATED_TORQUE = 0x6076  # uint32, mN m
MAX_TORQUE = 0x6072  # uint16, per mille of the rated torque, in every mode
POSITION = 0x6064  # int32, counts
INPUTS = 0x60FD  # uint32, digital; the upper half is free for what is wired to them
OUTPUTS = 0x60FE  # uint32, digital: 1 what is wanted, 2 which of it the host may set
DC_LINK = 0x6079  # uint32, mV
ABORT_CONNECTION = 0x6007  # what the drive does when the wire is silent; 1 is a fault
# Homing: method, speeds (1 to the switch, 2 to the index), acceleration, where zero is from home.
HOMING_METHOD, HOMING_SPEEDS, HOMING_ACCELERATION, HOME_OFFSET = 0x6098, 0x6099, 0x609A, 0x607C
START_HOMING = 1 << 4  # of the controlword
HOMING_REACHED, HOMING_ATTAINED, HOMING_ERROR = 1 << 10, 1 << 12, 1 << 13  # of the statusword
TO_INDEX = (33, 34)  # homing methods: to the index, in negative and in positive direction
IN_PLACE = (35, 37)  # home is where the shaft stands
# Touch probe 1: what latches, what was latched, where that was at the rising edge.
PROBE, PROBE_STATUS, PROBE_POSITION = 0x60B8, 0x60B9, 0x60BA
PROBE_AT_INDEX = 1 << 0 | 1 << 2 | 1 << 4  # on, by the encoder's index, at its rising edge
PROBE_LATCHED = 1 << 1
PER_MILLE = 1000
LARGEST_TARGET = 32767


class State(Enum):
    """Of the drive, by its statusword."""

    NOT_READY = 'not ready to switch on'
    DISABLED = 'switch on disabled'
    READY = 'ready to switch on'
    SWITCHED_ON = 'switched on'
    ENABLED = 'operation enabled'
    QUICK_STOP = 'quick stop active'
    REACTING = 'fault reaction active'
    FAULT = 'fault'


# (mask, value, state) in the order of the standard's table
_TABLE = (
    (0x4F, 0x00, State.NOT_READY),
    (0x4F, 0x40, State.DISABLED),
    (0x6F, 0x21, State.READY),
    (0x6F, 0x23, State.SWITCHED_ON),
    (0x6F, 0x27, State.ENABLED),
    (0x6F, 0x07, State.QUICK_STOP),
    (0x4F, 0x0F, State.REACTING),
    (0x4F, 0x08, State.FAULT),
)

DISABLE_VOLTAGE, SHUTDOWN, SWITCH_ON, ENABLE = 0x00, 0x06, 0x07, 0x0F
FAULT_RESET = 0x80


def state_of(statusword: int) -> State:
    """The state that a statusword tells.

    Raises:
        ValueError: It is none of the standard's.
    """
    for mask, value, state in _TABLE:
        if statusword & mask == value:
            return state
    raise ValueError(f'statusword 0x{statusword:04x} is no state of CiA 402')


def word_to_enable(state: State) -> int:
    """The controlword that leads one state on towards operation enabled.

    A fault stays one: resetting it is a person's decision, FAULT_RESET.
    """
    return {
        State.DISABLED: SHUTDOWN,
        State.READY: SWITCH_ON,
        State.SWITCHED_ON: ENABLE,
        State.ENABLED: ENABLE,
    }.get(state, DISABLE_VOLTAGE)


# Error codes of the emergency object that people meet (CiA 301, CiA 402); others are told as they
# are.
ERRORS = {
    0x2310: 'current too large',
    0x2340: 'short circuit',
    0x3110: 'mains voltage too high',
    0x3210: 'DC link voltage too high',
    0x3220: 'DC link voltage too low',
    0x4210: 'device too hot',
    0x4310: 'drive too hot',
    0x7121: 'motor blocked',
    0x7305: 'encoder fault',
    0x8110: 'CAN messages were lost',
    0x8120: 'CAN controller is error passive',
    0x8130: 'heartbeat of the host is missing',
    0x8140: 'recovered from bus off',
    0x8250: 'commands on the bus are missing',
    0x8611: 'following error',
}


def error_text(code: int) -> str:
    """An error code in words."""
    return f'{ERRORS.get(code, "error of the maker")} (0x{code:04x})'
