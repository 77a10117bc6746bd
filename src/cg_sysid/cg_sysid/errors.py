"""Errors of the recording side of cg_sysid."""


class RecordingError(ValueError):
    """A recording that cannot be used; the message says what, where and what is allowed."""
