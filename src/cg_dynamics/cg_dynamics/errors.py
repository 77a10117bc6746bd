"""Errors that a caller of cg_dynamics can act on."""


class DynamicsError(ValueError):
    """Base of the errors of this package."""


class ModelError(DynamicsError):
    """A model that makes no sense: unknown effect, wrong unit, value out of range."""


class SetupError(DynamicsError):
    """A set-up that the mechanism does not have."""


class SimulationError(DynamicsError):
    """A simulation that cannot go on.

    Attributes:
        time: When it stopped, in s from its start.
    """

    def __init__(self, message: str, time: float):
        super().__init__(message)
        self.time = time
