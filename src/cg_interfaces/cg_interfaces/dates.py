"""Dates as notes and records have them."""

import time


def iso_now() -> str:
    """This second in ISO 8601, UTC."""
    return time.strftime('%Y-%m-%dT%H:%M:%SZ', time.gmtime())
