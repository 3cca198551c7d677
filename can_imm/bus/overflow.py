"""Frames that the kernel threw away because nobody fetched them in time."""

from __future__ import annotations

import os
import socket
import struct
import sys

import can

_SO_MEMINFO = 55
_DROPS = 8
_LAYOUT = struct.Struct("=9I")


class QueueWatch:
    """Counts what was dropped at a bus's receive queue (socketcan, udp_multicast, on Linux).

    The kernel counts for each socket the frames for which its queue had no room; they leave no
    other trace.  Buses without a socket and other systems read as 0.
    """

    def __init__(self, bus: can.BusABC) -> None:
        self._socket: socket.socket | None = None
        self._before = 0
        try:
            fd = bus.fileno()
        except NotImplementedError:
            return
        if fd >= 0 and sys.platform == "linux":
            own = os.dup(fd)
            try:
                self._socket = socket.socket(fileno=own)
            except OSError:  # a device file
                os.close(own)
        self._before = self._total()

    def drops(self) -> int:
        """Frames dropped since this object was made."""
        return self._total() - self._before

    def _total(self) -> int:
        if self._socket is None:
            return 0
        try:
            data = self._socket.getsockopt(socket.SOL_SOCKET, _SO_MEMINFO, _LAYOUT.size)
            return int(_LAYOUT.unpack(data)[_DROPS])
        except (OSError, struct.error):
            return 0  # a kernel before 4.12

    def close(self) -> None:
        """Let go of the bus."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None
