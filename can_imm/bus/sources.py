"""Where frames come from: log files and buses."""

from __future__ import annotations

import errno
import gzip
import io
import os
import time
from collections.abc import Generator, Iterable, Iterator
from pathlib import Path
from typing import Any, BinaryIO

import can

from can_imm.bus import candump
from can_imm.bus.errors import one_line
from can_imm.bus.frame import Frame, from_message
from can_imm.types import CanImmError

_READERS: dict[str, Any] = {
    ".asc": can.ASCReader,
    ".blf": can.BLFReader,
    ".csv": can.CSVReader,
    ".db": can.SqliteReader,
    ".mf4": can.MF4Reader,
    ".trc": can.TRCReader,
}

LOG_SUFFIXES = tuple(sorted((*_READERS, ".log")))
"""Log formats; the text ones (.asc .csv .log .trc) also with .gz."""

_GZ_SUFFIXES = (".asc", ".csv", ".log", ".trc")

_GONE = frozenset({errno.ENODEV, errno.ENXIO, errno.EBADF, errno.ENOTSOCK})

GONE_AFTER_S = 5.0
"""A bus from which nothing but failures has come for so long is gone."""


def log_suffix(path: Path) -> tuple[str, bool]:
    """Format suffix of a log's name, and whether it is compressed.

    Raises:
        CanImmError: not a format that we know.
    """
    suffixes = [suffix.lower() for suffix in path.suffixes]
    packed = suffixes[-1:] == [".gz"]
    suffix = "".join(suffixes[-2:-1] if packed else suffixes[-1:])
    if suffix not in (_GZ_SUFFIXES if packed else LOG_SUFFIXES):
        raise CanImmError(
            f"{path}: unknown log format (known: {' '.join(LOG_SUFFIXES)}; "
            f"compressed: {' '.join(s + '.gz' for s in _GZ_SUFFIXES)})"
        )
    return suffix, packed


class LogSource:
    """The frames of a log file, in the order of the file; iterate over it once.

    A line that is no frame is counted and skipped. When the file breaks off, what came before
    stands and ``damage`` says what happened.

    Attributes:
        bad_lines: lines that are no frames (.log only).
        dropped_frames: frames that the recorder says it lost (DROPCOUNT lines, .log only).
        damage: one line on what is wrong with the file, None if nothing is.

    Raises:
        CanImmError: at construction, the file cannot be opened or has an unknown format; at the end
            of the iteration, it does not hold a single frame.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = Path(path)
        self.bad_lines = self.dropped_frames = 0
        self.damage: str | None = None
        suffix, packed = log_suffix(self.path)
        try:
            self._size = self.path.stat().st_size
            self._file: BinaryIO = self.path.open("rb")
        except OSError as error:
            raise CanImmError(f"{self.path}: {one_line(error)}") from error
        opened: Any = self._file
        if packed:
            opened = gzip.GzipFile(fileobj=self._file)
        if suffix == ".log":
            # "replace" keeps garbage bytes from being more than a bad line
            opened = io.TextIOWrapper(opened, "ascii", "replace", newline="\n")
            self._frames = self._candump(opened)
        else:
            if suffix in _GZ_SUFFIXES:
                opened = io.TextIOWrapper(opened, "utf-8", "replace")
            self._frames = self._messages(suffix, opened)
        self._opened = opened

    def __iter__(self) -> Iterator[Frame]:
        return self._checked()

    def __enter__(self) -> LogSource:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the file; the iteration does so at its end."""
        self._frames.close()
        self._opened.close()
        self._file.close()

    def progress(self) -> float | None:
        """How much of the file has been read, 0 to 1; None where the format does not tell (.db)."""
        if self._file.closed:
            return 1.0
        position = self._file.tell()
        return min(1.0, position / self._size) if position else None

    def _checked(self) -> Iterator[Frame]:
        any_frame = False
        try:
            for frame in self._frames:
                any_frame = True
                yield frame
        except Exception as error:  # whatever a reader of python-can may raise on a broken file
            self.damage = f"{self.path}: broken, reading stopped: {one_line(error)}"
        finally:
            self.close()
        if not any_frame:
            bad = f"; {self.bad_lines} lines are not frames" if self.bad_lines else ""
            raise CanImmError(self.damage or f"{self.path}: no CAN frames in this log{bad}")

    def _candump(self, lines: Iterable[str]) -> Generator[Frame, None, None]:
        parse = candump.parse
        for line in lines:
            frame = parse(line)
            if frame is not None:
                yield frame
            elif dropped := candump.dropped(line):
                self.dropped_frames += dropped
            elif line.strip():
                self.bad_lines += 1

    def _messages(self, suffix: str, opened: Any) -> Generator[Frame, None, None]:
        if self._size:
            # sqlite3 opens by name; the others get our file, which is closed whatever happens
            reader = _READERS[suffix](self.path if suffix == ".db" else opened)
            try:
                yield from map(from_message, reader)
            finally:
                reader.stop()


class BusGone(CanImmError):  # noqa: N818 - it says what happened
    """The bus cannot be used any more."""


class BusSource:
    """Frames from an open bus.

    Attributes:
        errors: failed reads that were survived, such as those of a link that is down.
    """

    def __init__(self, bus: can.BusABC) -> None:
        self._bus = bus
        self._failing_since: float | None = None
        self.errors = 0

    def recv(self, timeout_s: float) -> Frame | None:
        """The next frame, None if there is none within ``timeout_s`` seconds or the read failed.

        Raises:
            BusGone: the device is gone, or nothing but failures for long.
        """
        try:
            message = self._bus.recv(timeout_s)
        except (can.CanError, OSError, ValueError) as error:
            self._survive(error, timeout_s)
            return None
        self._failing_since = None
        return None if message is None else from_message(message)

    def _survive(self, error: Exception, timeout_s: float) -> None:
        code = error_code(error)
        self.errors += 1
        now = time.monotonic()
        if self._failing_since is None:
            self._failing_since = now
        # a link that is down may come up again, no matter how late
        long = now - self._failing_since >= GONE_AFTER_S and code != errno.ENETDOWN
        if code in _GONE or long:
            raise BusGone(f"bus {self._bus.channel_info}: {one_line(error)}") from error
        # a failed read returns at once: do not spin
        time.sleep(min(max(timeout_s, 0.0), 0.01))


def error_code(error: BaseException) -> int | None:
    """The errno behind an error of python-can, if it is known."""
    for cause in (error, error.__cause__):
        code = getattr(cause, "error_code", None) or getattr(cause, "errno", None)
        if code is not None:
            return int(code)
    return None
