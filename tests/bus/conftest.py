"""Fixtures of the bus tests."""

from __future__ import annotations

from collections.abc import Callable

import cantools
import pytest
from bus_frames import ROOT, Radar


@pytest.fixture(scope="session")
def own_db() -> cantools.database.Database:
    return cantools.database.load_file(ROOT / "dbc" / "can_imm.dbc")


@pytest.fixture(scope="session")
def toyota_db() -> cantools.database.Database:
    return cantools.database.load_file(ROOT / "dbc" / "toyota.dbc")


@pytest.fixture
def radar(own_db: cantools.database.Database) -> Radar:
    return Radar(own_db)


@pytest.fixture
def track(toyota_db: cantools.database.Database) -> Callable[..., tuple[int, bytes]]:
    """A frame of a Toyota track slot with a right checksum."""

    def make(slot: int, counter: int, **changes: float) -> tuple[int, bytes]:
        message = toyota_db.get_message_by_frame_id(0x210 + slot)
        values = {
            "COUNTER": counter, "LONG_DIST": 30.0, "LAT_DIST": 2.0, "REL_SPEED": -1.5,
            "NEW_TRACK": 0, "VALID": 1, "CHECKSUM": 0,
        }  # fmt: skip
        data = message.encode({**values, **changes})
        return message.frame_id, data[:7] + bytes([(sum(data[:7]) + 2 + 16 + slot + 8) & 0xFF])

    return make
