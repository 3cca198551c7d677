"""The axes of the road from scan to scan: silence, unknown ego motion, and the way back."""

from __future__ import annotations

import math

import numpy as np
import pytest
from small_roads import parameters

from can_imm.estimation import road
from can_imm.road import LONGEST_S, RoadFrame
from can_imm.types import REPORT_DTYPE, Scan

S = 1_000_000_000
NAN = math.nan


def driven(seconds: float, speed: float = 30.0, yaw_rate: float = 0.02) -> RoadFrame:
    frame = RoadFrame(parameters())
    for k in range(int(seconds * 10) + 1):
        frame.move(k * S // 10, speed, yaw_rate)
    return frame


def test_making_one_leaves_the_road_as_it_is() -> None:
    """Compiling must not drive."""
    x, P = road.new_road(parameters())
    frame = RoadFrame(parameters())
    np.testing.assert_array_equal(frame.x, x)
    np.testing.assert_array_equal(frame.P, P)
    assert frame.width == 3.5


def test_the_first_scan_begins_with_the_bend_that_the_ego_drives() -> None:
    frame = driven(0.0)
    assert frame.x[road.CURVATURE] > 1e-4
    assert frame.x[road.OFFSET] == 0.0
    straight = RoadFrame(parameters())
    straight.move(0, NAN, NAN)
    np.testing.assert_array_equal(straight.x, road.new_road(parameters())[0])


@pytest.mark.parametrize(("silence", "anew"), [(0.9, False), (1.1, True), (3600.0, True)])
def test_after_a_long_silence_only_the_width_is_kept(silence: float, anew: bool) -> None:
    frame = driven(10.0)
    frame.x[[road.WIDTH, road.OFFSET]] = 3.8, 1.0
    frame.P[road.WIDTH, road.WIDTH] = 0.001
    frame._guide_slot[4] = 2
    assert (silence > LONGEST_S) == anew
    frame.move(int((10.0 + silence) * S), NAN, NAN)
    assert frame.width == pytest.approx(3.8)
    assert frame.P[road.WIDTH, road.WIDTH] == pytest.approx(0.001)
    assert (frame.x[road.OFFSET] == 0.0) == anew
    assert (frame._guide_slot == road.FREE).all() == anew
    if anew:
        others = np.arange(road.N) != road.WIDTH
        x, P = road.new_road(parameters())
        np.testing.assert_array_equal(frame.x[others], x[others])
        np.testing.assert_array_equal(frame.P[others], P[others])


@pytest.mark.parametrize(("speed", "yaw_rate"), [(NAN, NAN), (30.0, NAN), (NAN, 0.02)])
def test_unknown_ego_motion(speed: float, yaw_rate: float) -> None:
    frame = driven(60.0, speed, yaw_rate)
    assert np.isfinite(frame.x).all()
    assert np.isfinite(frame.P).all()
    assert frame.x[road.CURVATURE] == 0.0, "a yaw rate or a speed alone tells no bend"
    known = driven(60.0)
    assert frame.P[road.HEADING, road.HEADING] > known.P[road.HEADING, road.HEADING]


def test_what_the_bus_stops_telling_is_forgotten() -> None:
    frame = driven(5.0)
    scan = Scan(1)
    scan.n, scan.valid[0], scan.z[0] = 1, True, (40.0, 0.0, 3.5, 0.0)
    for speed, expected in ((30.0, True), (NAN, False)):
        frame.move(int((5.1 if expected else 5.2) * S), speed, 0.02)
        z, r = scan.z.copy(), np.full((1, 4), 0.01)
        frame.localise_(scan, z, r)
        assert (z[0, 2] != scan.z[0, 2]).all()
        assert (z[0, 3] != scan.z[0, 3]) == expected, "lateral speeds are those against the ego"


def test_reports_go_back_to_the_sensors_axes() -> None:
    frame = driven(5.0)
    scan = Scan(3)
    scan.n = 3
    scan.valid[:] = True
    scan.z[:] = [(20.0, 1.0, 0.0, 0.1), (50.0, -5.0, 3.5, 0.0), (90.0, 0.0, -3.0, -0.5)]
    z, r = scan.z.copy(), np.full((3, 4), 0.01)
    frame.localise_(scan, z, r)
    assert np.abs(z[:, 2] - scan.z[:, 2]).min() > 0.01
    reports = np.zeros(3, REPORT_DTYPE)
    reports["x"] = z
    frame.globalise_(reports, 2)
    np.testing.assert_allclose(reports["x"][:2], scan.z[:2], atol=1e-9)
    np.testing.assert_array_equal(reports["x"][2], z[2], "only the first n")
    assert reports["ego_speed"].tolist() == [30.0, 30.0, 0.0]
