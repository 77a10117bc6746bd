"""The object dictionary of a drive, over SDO (CiA 301): one transfer at a time. No ROS.

A transfer waits for its answer, up to TIMEOUT. What must not wait, as the cycle of the torque,
has it done `later`, in the one thread that does them all, in order.
"""

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

import can
import canopen
from canopen.sdo.exceptions import SdoAbortedError, SdoError

TIMEOUT = 0.3  # s
ABSENT = (0x0602_0000, 0x0609_0011)  # abort codes: no such object, no such sub-index

T = TypeVar('T')


class DriveError(Exception):
    """A drive that is not there, refuses its set-up, or reports a fault."""


class AbsentError(DriveError):
    """The drive has no such object."""


class Objects:
    """Reads and writes them.

    Args:
        node: The drive on its network.
    """

    def __init__(self, node: canopen.RemoteNode):
        self._sdo = node.sdo
        self._sdo.RESPONSE_TIMEOUT = TIMEOUT
        self._thread = ThreadPoolExecutor(1, 'objects')

    def read(self, index: int, sub: int = 0, signed: bool = False) -> int:
        """The value of an object, as long as the drive has it.

        Raises:
            DriveError: naming the object and why it was not told.
        """
        try:
            return int.from_bytes(self._sdo.upload(index, sub), 'little', signed=signed)
        except (SdoError, can.CanError, OSError) as error:
            raise _told(index, sub, error) from error

    def write(self, index: int, sub: int, value: int, size: int) -> None:
        """Set an object of so many bytes.

        Raises:
            DriveError: naming the object and why it was not taken.
        """
        try:
            self._sdo.download(index, sub, value.to_bytes(size, 'little', signed=value < 0))
        except (SdoError, can.CanError, OSError) as error:
            raise _told(index, sub, error) from error

    def later(self, work: 'Callable[[Objects], T]') -> 'Future[T]':
        """Have transfers done in their own thread."""
        return self._thread.submit(work, self)

    def close(self) -> None:
        """Do nothing that has not begun."""
        self._thread.shutdown(wait=False, cancel_futures=True)


def _told(index: int, sub: int, error: Exception) -> DriveError:
    absent = isinstance(error, SdoAbortedError) and error.code in ABSENT
    kind = AbsentError if absent else DriveError
    return kind(f'object 0x{index:04x}:{sub}: {error}')
