"""What became of the frames that a decoder was fed."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass
class DecodeCounts:
    """What became of the frames.

    Every frame is counted in ``frames`` and in exactly one of ``unknown`` (an id that is not the
    sensor's, or one of the vehicle's with another length), ``bad_kind`` (our id, but an extended,
    FD, remote or error frame), ``bad_length``,
    ``bad_crc`` (in profile 1 the invalid counter 15, too), ``bad_counter`` (a repeated frame),
    ``out_of_range``, ``stray`` (an object without a scan to belong to), ``duplicates`` (an object
    twice in a scan), ``overflow`` (more objects than there is room for), ``empty`` (right, but
    without an object), ``used``, ``ego`` (the vehicle's own motion) and ``other_sensor`` (of a
    sensor of the same kind that is not the one that counts). Beside that: ``checksums_ok`` frames
    with a right checksum, ``lost`` frames missing by their counters, ``not_available`` single
    values that the sensor did not have, ``scans`` finished, ``incomplete_scans`` of these with an
    announced object missing or rejected, ``lost_scans`` missing by their counter.
    """

    frames: int = 0
    unknown: int = 0
    bad_kind: int = 0
    bad_length: int = 0
    bad_crc: int = 0
    bad_counter: int = 0
    out_of_range: int = 0
    stray: int = 0
    duplicates: int = 0
    overflow: int = 0
    empty: int = 0
    used: int = 0
    ego: int = 0
    other_sensor: int = 0
    checksums_ok: int = 0
    lost: int = 0
    not_available: int = 0
    scans: int = 0
    incomplete_scans: int = 0
    lost_scans: int = 0

    @property
    def rejected(self) -> int:
        """Frames of the sensor that failed a check."""
        return (
            self.bad_kind
            + self.bad_length
            + self.bad_crc
            + self.bad_counter
            + self.out_of_range
            + self.stray
            + self.duplicates
            + self.overflow
        )
