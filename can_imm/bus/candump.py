"""The candump log format, ``(seconds.microseconds) channel ID#DATA``, one frame per line.

python-can's reader gives up at the first line that it does not understand and takes four times as
long; logs of real drives do hold such lines.
"""

from __future__ import annotations

import re

from can_imm.bus.frame import BRS, DLC_SHIFT, ERROR, ESI, EXTENDED, FD, REMOTE, TX, Frame

_new_frame = tuple.__new__

_ERROR_BIT = 0x2000_0000
_HEAD = r"\((\d{1,12})\.(\d{1,9})\)\s+(\S+)\s+([0-9A-Fa-f]{3}|[0-9A-Fa-f]{8})#"
# the digit after "_" is a length code above 8, which says nothing about the data
_CLASSIC = re.compile(_HEAD + r"([0-9A-Fa-f]{0,16})(?:_[9A-Fa-f])?(\s+[RrTt])?\s*", re.A).fullmatch
_OTHER = re.compile(
    _HEAD + r"(?:#([0-9A-Fa-f])([0-9A-Fa-f]{0,128})|[Rr]([0-8]?)(?:_[9A-Fa-f])?)(\s+[RrTt])?\s*",
    re.A,
).fullmatch
_DROPPED = re.compile(r"DROPCOUNT: dropped (\d+) CAN frames").match


_KNOWN_IDS: dict[str, int] = {}
"""11-bit ids by how they are written, as far as they have been seen and checked."""


def parse(line: str) -> Frame | None:
    """The frame in a line of a candump log, None if there is none that makes sense."""
    # What nearly all lines look like: "(1700000000.123456) can0 210#9338", with or without " R".
    # Whatever is odd about a line leaves it to the patterns.
    parts = line.split()
    n = len(parts)
    if (n == 3 or (n == 4 and parts[3] == "R")) and line[:1] == "(" and line.isascii():
        time, channel, body = parts[:3]
        stamp = time[1:-8] + time[-7:-1]
        known = _KNOWN_IDS.get(body[:3], -1)
        if (
            known >= 0
            and 4 <= len(body) <= 20
            and body[3] == "#"
            and 10 <= len(time) <= 21
            and time[-8] == "."
            and time[-1] == ")"
            and stamp.isdecimal()
        ):
            try:
                data = bytes.fromhex(body[4:])
            except ValueError:
                return _parse_slowly(line)
            return _new_frame(Frame, (int(stamp) * 1000, known, data, channel, 0))
    return _parse_slowly(line)


def _parse_slowly(line: str) -> Frame | None:
    match = _CLASSIC(line)
    if match is None:
        return _parse_other(line)
    seconds, fraction, channel, frame_id, digits, direction = match.groups()
    if len(digits) & 1:
        return None
    number = int(frame_id, 16)
    flags = 0
    if len(frame_id) == 8 or number > 0x7FF or (direction is not None and direction[-1:] in "Tt"):
        number, flags = _id_and_flags(frame_id, direction)
        if number < 0:
            return None
    elif len(frame_id) == 3:
        _KNOWN_IDS[frame_id] = number
    return Frame(_time(seconds, fraction), number, bytes.fromhex(digits), channel, flags)


def format_frame(frame: Frame) -> str:
    """The line of a candump log for ``frame``, with the line's end."""
    t_us, flags, data = frame.t_ns // 1000, frame.flags, frame.data.hex().upper()
    if flags & ERROR:
        head = f"{frame.id | _ERROR_BIT:08X}#"
    else:
        head = f"{frame.id:08X}#" if flags & EXTENDED else f"{frame.id:03X}#"
    if flags & REMOTE:
        head += f"R{flags >> DLC_SHIFT & 0xF or ''}"
    elif flags & FD:
        head += f"#{bool(flags & BRS) | bool(flags & ESI) << 1:X}"
    # candump's own name for a channel; a log line cannot do without one
    channel = frame.channel or "can0"
    if channel.isdecimal():
        channel = f"can{channel}"
    return f"({t_us // 1_000_000}.{t_us % 1_000_000:06d}) {channel} {head}{data}\n"


def dropped(line: str) -> int:
    """Number of frames that a DROPCOUNT line says were lost, 0 for any other line."""
    match = _DROPPED(line)
    return int(match[1]) if match else 0


def _parse_other(line: str) -> Frame | None:
    """CAN FD and remote frames."""
    match = _OTHER(line)
    if match is None:
        return None
    seconds, fraction, channel, frame_id, fd, digits, length, direction = match.groups()
    number, flags = _id_and_flags(frame_id, direction)
    if number < 0:
        return None
    if fd is None:
        flags |= REMOTE | int(length or 0) << DLC_SHIFT
        return Frame(_time(seconds, fraction), number, b"", channel, flags)
    if len(digits) & 1:
        return None
    bits = int(fd, 16)
    flags |= FD | BRS * (bits & 1) | ESI * (bits >> 1 & 1)
    return Frame(_time(seconds, fraction), number, bytes.fromhex(digits), channel, flags)


def _time(seconds: str, fraction: str) -> int:
    if len(fraction) != 6:
        fraction = fraction[:6].ljust(6, "0")
    return int(seconds + fraction) * 1000


def _id_and_flags(frame_id: str, direction: str | None) -> tuple[int, int]:
    """Number and flags of an id as it is written; the number is -1 if there is no such id."""
    number = int(frame_id, 16)
    flags = TX if direction is not None and direction.strip() in "Tt" else 0
    if len(frame_id) == 3:
        return (number if number <= 0x7FF else -1), flags
    if number & _ERROR_BIT and number < _ERROR_BIT << 1:
        return number ^ _ERROR_BIT, flags | ERROR
    return (number if number < _ERROR_BIT else -1), flags | EXTENDED
