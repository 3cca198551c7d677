"""What others do with a log: python-can reads, cantools decodes.  The yardstick of the bench."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import can

from can_imm.bus.codec import load_dbc
from can_imm.bus.frame import Frame
from can_imm.bus.profile import Profile


class Reference:
    """Decodes the sensor's messages with cantools and keeps nothing.

    Args:
        profile: says which messages, and where their DBC is.
        labels: give the labels of a value table, as cantools does by default, and not numbers.
    """

    def __init__(self, profile: Profile, *, labels: bool = True) -> None:
        self._labels = labels
        messages = list(profile.messages)
        if profile.header is not None:
            messages.append(profile.header.message)
        self._ids = frozenset(message.frame_id for message in messages)
        self._database = load_dbc(profile.dbc)

    def decode(self, frames: list[Frame]) -> None:
        """Decode frames that are in memory."""
        for frame in frames:
            self._database.decode_message(frame.id, frame.data)

    def read(self, path: Path, limit: int = -1) -> Iterator[tuple[float, int, dict[str, Any]]]:
        """Time [s], id and signals of the sensor's messages in a log, as python-can reads it.

        Args:
            limit: stop after so many frames of the log.
        """
        with can.LogReader(path) as reader:
            for message in reader:
                if limit == 0:
                    return
                limit -= 1
                if message.arbitration_id in self._ids:
                    signals = self._database.decode_message(
                        message.arbitration_id, message.data, decode_choices=self._labels
                    )
                    yield message.timestamp, message.arbitration_id, signals
