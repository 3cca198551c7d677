"""Where frames go to: log files and buses."""

from __future__ import annotations

import errno
import gzip
import os
import time
from copy import deepcopy
from pathlib import Path
from typing import Any, Protocol

import can

from can_imm.bus.candump import format_frame
from can_imm.bus.errors import one_line
from can_imm.bus.frame import Frame, to_message
from can_imm.bus.sources import BusGone, error_code, log_suffix
from can_imm.types import CanImmError


class Sink(Protocol):
    """What takes frames."""

    def send(self, frame: Frame) -> None:
        """Take one frame."""

    def close(self) -> None:
        """Write everything out and end."""


class LogSink:
    """Writes frames to a log file; the suffix says the format, an older file is replaced.

    Attributes:
        lost: frames that could not be written.
        damage: one line on the first failure, None if there was none.

    Raises:
        CanImmError: at construction, if the file cannot be written or the format is unknown.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = Path(path)
        self.lost = 0
        self.damage: str | None = None
        self._text: Any = None
        self._writer: Any = None
        suffix, packed = log_suffix(self.path)
        try:
            if suffix == ".log":
                opened = gzip.open if packed else open
                self._text = opened(self.path, "wt", encoding="ascii", newline="\n")
            else:
                with self.path.open("wb"):
                    pass  # an SQLite file would be appended to
                self._writer = can.Logger(self.path)
        except OSError as error:
            raise CanImmError(f"{self.path}: {one_line(error)}") from error
        except (NotImplementedError, ImportError, ValueError) as error:
            raise CanImmError(f"{self.path}: {one_line(error)}") from error

    def __enter__(self) -> LogSink:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def send(self, frame: Frame) -> None:
        """Write one frame; a failure is counted."""
        try:
            if self._text is not None:
                self._text.write(format_frame(frame))
            else:
                self._writer.on_message_received(to_message(frame))
        except Exception as error:  # a full disk must not stop a detector
            self.lost += 1
            self._note(error)

    def close(self) -> None:
        """Write everything out and close the file."""
        try:
            if self._text is not None:
                self._text.close()
            elif self._writer is not None:
                if isinstance(self._writer, can.SqliteWriter):
                    _drain(self._writer)
                self._writer.stop()
        except Exception as error:
            self._note(error)
        self._writer = None

    def _note(self, error: Exception) -> None:
        self.damage = self.damage or f"{self.path}: {one_line(error)}"


def _drain(writer: can.SqliteWriter) -> None:
    """Wait until the writer's thread has taken all rows: ``stop`` forgets those still queued."""
    while writer._writer_thread.is_alive() and not writer.buffer.empty():
        time.sleep(0.005)


class BusSink:
    """Sends frames to an open bus; a frame that cannot be sent is counted and forgotten.

    Attributes:
        lost: frames that were not sent (transmit queue full, link down).
    """

    def __init__(self, bus: can.BusABC) -> None:
        self._bus = bus
        self.lost = 0

    def send(self, frame: Frame) -> None:
        """Send one frame now, without waiting for room in a queue.

        Raises:
            BusGone: the device is gone.
        """
        try:
            # None would wait for ever on a virtual bus whose reader is slow
            self._bus.send(to_message(frame), timeout=0)
        except (can.CanError, OSError, ValueError) as error:
            self.lost += 1
            if error_code(error) in (errno.ENODEV, errno.ENXIO, errno.EBADF):
                raise BusGone(f"bus {self._bus.channel_info}: {one_line(error)}") from error

    def rehearse(self, frame: Frame) -> None:
        """Do what is done to send a frame, as far as nobody notices."""
        deepcopy(to_message(frame))

    def close(self) -> None:
        """Nothing to write out: the bus belongs to who opened it."""
