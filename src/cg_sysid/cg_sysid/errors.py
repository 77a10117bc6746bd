"""Errors of cg_sysid, and the value that stands for a result that is none."""

from dataclasses import dataclass


class RecordingError(ValueError):
    """A recording that cannot be used; the message says what, where and what is allowed."""


@dataclass(frozen=True)
class Failure:
    """Why a fit has no result.

    A value and no exception: of many fits that run in other processes some cannot succeed, and
    the others go on.

    Attributes:
        reason: For people.
    """

    reason: str

    def __str__(self) -> str:
        return self.reason
