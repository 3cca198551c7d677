"""One CAN frame as it passes through the program, and its translation to and from python-can."""

from __future__ import annotations

from typing import Any, NamedTuple

import can

EXTENDED, FD, BRS, ESI, REMOTE, ERROR, TX = (1 << bit for bit in range(7))
"""Bits of `Frame.flags`; bits 8 to 11 hold the length code of a remote frame."""

DLC_SHIFT = 8


class Frame(NamedTuple):
    """A CAN frame.

    ``t_ns`` time on the bus clock [ns], a multiple of 1000: logs hold microseconds, and a frame has
    the same time live and replayed; ``id`` arbitration id; ``channel`` the bus it came from;
    ``flags`` the bits above, 0 for a classic data frame with an 11-bit id that was received.
    """

    t_ns: int
    id: int
    data: bytes
    channel: str | None = None
    flags: int = 0


def from_message(message: can.Message) -> Frame:
    """Translate a python-can message; its time is rounded to whole microseconds."""
    flags = (
        EXTENDED * message.is_extended_id
        | FD * message.is_fd
        | BRS * message.bitrate_switch
        | ESI * message.error_state_indicator
        | REMOTE * message.is_remote_frame
        | ERROR * message.is_error_frame
        | TX * (not message.is_rx)
    )
    if message.is_remote_frame:
        flags |= message.dlc << DLC_SHIFT
    channel = message.channel
    return Frame(
        round(message.timestamp * 1e6) * 1000,
        message.arbitration_id,
        bytes(message.data),
        None if channel is None else str(channel),
        flags,
    )


class _Message(can.Message):
    """A message of which copies are cheap: python-can's virtual bus has `deepcopy` make one for
    every receiver, and that takes longer to copy eight bytes than all the rest of sending them."""

    __slots__ = ()

    def __deepcopy__(self, memo: dict[int, Any] | None) -> can.Message:
        copy = self.__copy__()
        copy.data = self.data[:]
        return copy


def to_message(frame: Frame) -> can.Message:
    """Translate to a python-can message; a channel that is a number becomes an int, as python-can
    has it."""
    flags, channel = frame.flags, frame.channel
    remote = bool(flags & REMOTE)
    return _Message(
        timestamp=frame.t_ns / 1e9,
        arbitration_id=frame.id,
        is_extended_id=bool(flags & EXTENDED),
        is_remote_frame=remote,
        is_error_frame=bool(flags & ERROR),
        is_fd=bool(flags & FD),
        bitrate_switch=bool(flags & BRS),
        error_state_indicator=bool(flags & ESI),
        is_rx=not flags & TX,
        channel=int(channel) if channel is not None and channel.isdecimal() else channel,
        dlc=flags >> DLC_SHIFT & 0xF if remote else None,
        data=None if remote else frame.data,
    )
