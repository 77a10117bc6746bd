"""States and words of CiA 402, from the tables of the standard."""

import pytest

from cg_hardware.drive import cia402
from cg_hardware.drive.can_drive import Scale
from cg_hardware.drive.cia402 import State


@pytest.mark.parametrize(
    ('word', 'state'),
    [
        (0x0000, State.NOT_READY), (0x0250, State.DISABLED), (0x0231, State.READY),
        (0x0233, State.SWITCHED_ON), (0x0237, State.ENABLED), (0x1637, State.ENABLED),
        (0x0217, State.QUICK_STOP), (0x021F, State.REACTING), (0x0218, State.FAULT),
        (0x8638, State.FAULT),
    ],
)  # fmt: skip
def test_states(word, state):
    # Bit 5 is the quick stop's, low while it acts; bit 4, voltage, and the upper half are free.
    assert cia402.state_of(word) == state


def test_a_word_that_is_no_state_is_refused():
    with pytest.raises(ValueError, match='statusword 0x0022 is no state of CiA 402'):
        cia402.state_of(0x0022)


def test_the_way_to_operation_enabled_and_no_way_out_of_a_fault():
    words = [cia402.word_to_enable(s) for s in (State.DISABLED, State.READY, State.SWITCHED_ON)]
    assert words == [0x06, 0x07, 0x0F]
    assert cia402.word_to_enable(State.ENABLED) == 0x0F
    for state in (State.FAULT, State.REACTING, State.QUICK_STOP, State.NOT_READY):
        assert cia402.word_to_enable(state) == cia402.DISABLE_VOLTAGE


def test_torque_in_per_mille():
    scale = Scale(rated=25.0, sign=-1.0)
    assert scale.target(2.5) == -100
    assert scale.torque(-100) == 2.5
    assert scale.target(1e9) == -32767


def test_errors_are_told_in_words():
    assert cia402.error_text(0x8130) == 'heartbeat of the host is missing (0x8130)'
    assert cia402.error_text(0xFF01) == 'error of the maker (0xff01)'
