"""What counts as a gain of the torques."""

import numpy as np
import pytest

from cg_sysid.search.settings import SELECTION
from cg_sysid.search.torque_judging import Gain


def gain(significance: float, relieved: float) -> Gain:
    return Gain(SELECTION.earned + 1, significance, np.array([0.0]), relieved)


@pytest.mark.parametrize(
    ('relieved', 'significance', 'counts'),
    [
        (0.0, 0.5, False),  # what lowers the error has to lower that of others too
        (0.0, 3.0, True),
        (20.0, -0.5, True),  # a rotor in place of a link too heavy: the error stays as it is
        (20.0, -3.0, False),  # that made it worse
    ],
)
def test_records_held_out_gain_or_at_least_do_not_lose(relieved, significance, counts):
    assert gain(significance, relieved).significant == counts
