"""When a sample was taken, on the host's clock, from the tick that the device put on it.

A sample arrives late, by a time that changes: the wire, the adapter's buffer, the scheduler. It
never arrives early. So the host's time of a tick is a straight line that lies under all arrivals
and touches the earliest of them:

    host = offset + period ticks,   arrival = host + latency,   latency >= 0           (CLOCK)

The line is the lower edge of the convex hull of the arrivals of the last WINDOW_S; its slope is
the drift of the device's clock, its place the shortest latency that the wire has. What is known of
that one, the time that the bytes need on the wire, is taken off.
"""

import math
from collections import deque
from dataclasses import dataclass

from cg_interfaces.stamps import NS_PER_S

WINDOW_S = 30.0  # s of arrivals that the line is laid under
BUCKET_S = 0.1  # s of which the earliest arrival is kept
LARGEST_DRIFT = 1e-3  # of a quartz, ten times what data sheets allow
SETTLING_S = 2.0  # s of arrivals below which the nominal period is better than a fitted one
JUMP_S = 0.25  # s off the line at which the clock is another one: a replug, or a host that slept


@dataclass(frozen=True)
class _Arrival:
    """The earliest arrival of a bucket: device's and host's time in s from the first sample."""

    device: float
    host: float


class DeviceClock:
    """The host's time of the ticks of a device.

    Args:
        ticks_per_s: Nominal.
        wrap: Ticks after which the counter begins anew; 0 for never.
        latency_s: That every sample needs at least, from its instant to the host, in s.

    Attributes:
        drift: Of the device's clock against the host's, [1]: positive if its seconds are long.
        jumps: How often the clock began anew.
    """

    def __init__(self, ticks_per_s: float, wrap: int = 0, latency_s: float = 0.0):
        self._ticks_per_s, self._wrap, self._latency_s = ticks_per_s, wrap, latency_s
        self.jumps = 0
        self._restart()

    def _restart(self) -> None:
        self._first: tuple[int, int] | None = None  # ticks and host's ns of the first sample
        self._last_ticks = 0
        self._turns = 0
        self._kept: deque[_Arrival] = deque()
        self._bucket: _Arrival | None = None
        self._bucket_since = 0.0
        self.drift = 0.0
        self._floor = math.inf  # offset in s that the kept arrivals allow
        self._offset = 0.0  # s

    def stamp(self, ticks: int, received_ns: int) -> int:
        """The instant in ns of a sample.

        Args:
            ticks: Of the device when it took the sample; they never run backwards but at a wrap.
            received_ns: When it arrived, on the host's clock.
        """
        if self._first is not None:
            self._follow(ticks)
            expected = self._host(self._device(ticks))
            if abs((received_ns - self._first[1]) / NS_PER_S - expected) > JUMP_S:
                self.jumps += 1
                self._restart()
        if self._first is None:
            self._first, self._last_ticks = (ticks, received_ns), ticks
        device = self._device(ticks)
        self._learn(_Arrival(device, (received_ns - self._first[1]) / NS_PER_S))
        seconds = self._host(device) - self._latency_s
        return self._first[1] + round(seconds * NS_PER_S)

    def _follow(self, ticks: int) -> None:
        if self._wrap and ticks - self._last_ticks < -self._wrap // 2:
            self._turns += 1
        self._last_ticks = ticks

    def _device(self, ticks: int) -> float:
        assert self._first is not None
        return (ticks + self._turns * self._wrap - self._first[0]) / self._ticks_per_s

    def _host(self, device: float) -> float:
        return self._offset + (1 + self.drift) * device

    def _learn(self, arrival: _Arrival) -> None:
        """Lay the line under one more arrival."""
        if self._bucket is None or arrival.device - self._bucket_since >= BUCKET_S:
            if self._bucket is not None:
                self._kept.append(self._bucket)
                while self._kept[0].device < arrival.device - WINDOW_S:
                    self._kept.popleft()
                self._lay()
            self._bucket, self._bucket_since = arrival, arrival.device
        elif self._lead(arrival) < self._lead(self._bucket):
            self._bucket = arrival
        self._offset = min(self._floor, self._lead(self._bucket))

    def _lead(self, arrival: _Arrival) -> float:
        """Offset of a line of the present slope through an arrival."""
        return arrival.host - (1 + self.drift) * arrival.device

    def _lay(self) -> None:
        """The edge of the lower hull that spans the middle of the window."""
        hull: list[_Arrival] = []
        for point in self._kept:
            while len(hull) > 1 and _turns_down(hull[-2], hull[-1], point):
                hull.pop()
            hull.append(point)
        span = self._kept[-1].device - self._kept[0].device
        if span >= SETTLING_S:
            middle = (self._kept[-1].device + self._kept[0].device) / 2
            after = next(k for k in range(1, len(hull)) if hull[k].device >= middle)
            a, b = hull[after - 1], hull[after]
            slope = (b.host - a.host) / (b.device - a.device) - 1
            self.drift = min(max(slope, -LARGEST_DRIFT), LARGEST_DRIFT)
        self._floor = min(map(self._lead, hull))


def _turns_down(a: _Arrival, b: _Arrival, c: _Arrival) -> bool:
    """Whether b lies on or above the line from a to c."""
    left = (b.host - a.host) * (c.device - a.device)
    return left >= (c.host - a.host) * (b.device - a.device)
