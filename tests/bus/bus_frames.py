"""Frames made by cantools and a checksum of our own: nothing here comes from can_imm.bus."""

from __future__ import annotations

from pathlib import Path

import cantools

ROOT = Path(__file__).parents[2]
REAL_DATA = ROOT.parent / "shared" / "data" / "comma2k19"
MS = 1_000_000


def crc8_p01(data: bytes, data_id: int) -> int:
    """E2E profile 1, bit by bit: polynomial 0x1D from 0 over the id's two bytes and the payload."""
    crc = 0
    for byte in bytes([data_id & 0xFF, data_id >> 8]) + data[1:]:
        crc ^= byte
        for _ in range(8):
            crc = (crc << 1 ^ (0x1D if crc & 0x80 else 0)) & 0xFF
    return crc


def protect(data: bytes, data_id: int) -> bytes:
    """``data`` with the right CRC in byte 0."""
    return bytes([crc8_p01(data, data_id)]) + data[1:]


class Radar:
    """A sensor that speaks can_imm.dbc: counters run, any signal can be set (raw with an int)."""

    def __init__(self, db: cantools.database.Database) -> None:
        self._db = db
        self.counters = {"RadarScan": 0, "RadarObject": 0}
        self.scans = 0

    def _payload(self, name: str, values: dict[str, float]) -> bytes:
        message = self._db.get_message_by_name(name)
        values = {"Crc": 0, "AliveCounter": self.counters[name], **values}
        data = message.encode(values, strict=False)
        self.counters[name] = (self.counters[name] + 1) % 15
        return protect(data, message.frame_id)

    def scan(self, count: int, **changes: float) -> tuple[int, bytes]:
        self.scans += 1
        values = {"ObjectCount": count, "ScanCounter": self.scans, **changes}
        return 0x300, self._payload("RadarScan", values)

    def object(self, object_id: int = 1, **changes: float) -> tuple[int, bytes]:
        values = {
            "ObjectId": object_id, "ObjectValid": 1, "ObjectNew": 0,
            "DistLong": 50.0, "DistLat": 1.0, "VrelLong": -0.98, "VrelLat": 0.35,
        }  # fmt: skip
        return 0x301, self._payload("RadarObject", {**values, **changes})
