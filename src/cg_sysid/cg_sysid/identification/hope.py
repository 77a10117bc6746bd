"""Whether a fit that is out of reach may still come there."""

from collections.abc import Sequence

PATIENCE = 3  # iterations over which a fit that is out of reach has to gain
HOPE = 3.0  # times that gain, within which it may still come there


def out_of_reach(errors: Sequence[float], reach: float) -> bool:
    """Whether errors that fell like this, one an iteration, will not soon come to `reach`."""
    if len(errors) <= PATIENCE:
        return False
    return errors[-1] - reach > HOPE * (errors[-1 - PATIENCE] - errors[-1])
