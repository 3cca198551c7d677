"""The most that a radar sends: as many objects in every scan as an ARS408 can list."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from can_imm.bus.frame import Frame
from can_imm.bus.profile import load_profile
from can_imm.bus.radar_encoder import ProfileEncoder
from can_imm.sim.motorway import DT_NS, REPORTING, drive, plain, random_motorway
from can_imm.sim.radar import ego_messages, observe, radar_model
from can_imm.types import VX, VY, Scan, X, Y

PROFILE = "ars408"
OBJECTS = 100
"""In each scan."""
SEED = 0
"""Of the traffic."""
_TRACKS = 60
"""Ids of vehicles; those of posts follow, up to the last one of the radar."""
_LAST_ID = 255
_SPACING, _ASIDE = 5.0, 14.0
"""Posts stand on both sides of the road, so far from each other and from the ego's lane [m]."""


def crowd(seconds: float) -> Iterator[Frame]:
    """Frames of a drive with some two dozen vehicles in view, and posts beside the road.

    Args:
        seconds: of the drive [s].
    """
    settings = replace(plain(REPORTING), duration=seconds, lanes=(7, 7), vehicles=(60, 60))
    rng = np.random.default_rng(SEED)
    truth = drive(random_motorway(rng, settings))
    radar = replace(radar_model(PROFILE), slots=_TRACKS)
    encoder = ProfileEncoder(load_profile(PROFILE))
    ego = ego_messages(truth, rng)
    for scan in observe(truth, radar, rng).scans:
        while ego and ego[0][0] <= scan.t_ns:
            t_ns, speed, yaw_rate = ego.pop(0)
            yield from encoder.encode_ego(speed, yaw_rate, t_ns)
        sample = scan.t_ns // DT_NS
        whole = _with_posts(scan, float(truth.ego.station[sample]), float(truth.ego.speed[sample]))
        yield from encoder.encode(whole, whole.t_ns)


def _with_posts(scan: Scan, station: float, speed: float) -> Scan:
    """The scan and the nearest posts, so that there are `OBJECTS`."""
    whole = Scan(OBJECTS)
    whole.copy_from(scan)
    n = scan.n
    post = int(np.ceil(station / _SPACING)) + 1 + np.arange(OBJECTS - n) // 2
    side = np.arange(OBJECTS - n) % 2
    whole.n = OBJECTS
    whole.ids[n:] = _TRACKS + (2 * post + side) % (_LAST_ID + 1 - _TRACKS)
    whole.z[n:, X], whole.z[n:, VX] = post * _SPACING - station, -speed
    whole.z[n:, Y], whole.z[n:, VY] = np.where(side == 0, _ASIDE, -_ASIDE), 0.0
    whole.valid[n:] = True
    return whole
