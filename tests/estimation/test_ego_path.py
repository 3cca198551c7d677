"""Dead reckoning and places along a line, against a circle."""

from __future__ import annotations

import math

import numpy as np
import pytest

from can_imm.estimation.ego_path import project, reckon_, straighten_rows_

RADIUS, SPEED = 400.0, 25.0


def test_dead_reckoning_on_a_circle() -> None:
    t = np.cumsum(np.full(400, 0.07)) - 0.07
    pose = np.zeros((400, 3))
    reckon_(t, np.full(400, SPEED), np.full(400, SPEED / RADIUS), pose)
    turned = SPEED * t / RADIUS
    np.testing.assert_allclose(pose[:, 0], RADIUS * np.sin(turned), atol=0.02)
    np.testing.assert_allclose(pose[:, 1], RADIUS * (1.0 - np.cos(turned)), atol=0.02)
    np.testing.assert_allclose(pose[:, 2], turned, atol=1e-9)


def test_who_stands_does_not_turn() -> None:
    t = np.arange(100) * 0.1
    pose = np.zeros((100, 3))
    reckon_(t, np.zeros(100), np.full(100, 0.01), pose)
    np.testing.assert_array_equal(pose, 0.0)


def circle(step: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """Points of a bend to the left, and their stations."""
    angle = np.arange(0.0, 500.0, step) / RADIUS
    line = np.stack([RADIUS * np.sin(angle), RADIUS * (1.0 - np.cos(angle))], axis=1)
    return line, np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(line, axis=0).T))))


@pytest.mark.parametrize("at", [0, 150, 480])
def test_places_beside_a_bend_wherever_the_search_begins(at: int) -> None:
    line, station = circle()
    for way, left in ((10.0, 0.0), (123.4, 3.5), (300.0, -7.0), (498.0, 1.0)):
        turned, radius = way / RADIUS, RADIUS - left
        x, y = radius * math.sin(turned), RADIUS - radius * math.cos(turned)
        _, along, across, direction = project(line, station, at, x, y)
        assert along == pytest.approx(way, abs=0.05)
        assert across == pytest.approx(left, abs=0.01)
        assert direction == pytest.approx(turned, abs=0.002)


def test_before_the_beginning_and_beyond_the_end_the_line_goes_on() -> None:
    line, station = np.array([[0.0, 0.0], [1.0, 0.0], [2.0, 0.0]]), np.arange(3.0)
    assert project(line, station, 1, -5.0, 2.0)[1:] == pytest.approx((-5.0, 2.0, 0.0))
    assert project(line, station, 0, 9.0, -1.0)[1:] == pytest.approx((9.0, -1.0, 0.0))


@pytest.mark.parametrize("mounting", [0.0, 0.02])
def test_a_vehicle_in_a_bend_goes_straight_along_it(mounting: float) -> None:
    """Seen from an ego at the bend's beginning, by a radar that is mounted askew."""
    line, station = circle()
    turned, left, speed, across = 120.0 / RADIUS, 3.5, 30.0, 0.8
    radius = RADIUS - left
    x, y = radius * math.sin(turned), RADIUS - radius * math.cos(turned)
    vx = speed * math.cos(turned) - across * math.sin(turned) - SPEED
    vy = speed * math.sin(turned) + across * math.cos(turned)
    cos, sin = math.cos(mounting), math.sin(mounting)
    z = np.array([[x * cos + y * sin, vx * cos + vy * sin, y * cos - x * sin, vy * cos - vx * sin]])
    out = np.zeros((1, 4))
    for known in (True, False):
        r = np.array([[1.0, 1.0, 1.0, 1.0 if known else np.inf]])
        straighten_rows_(
            z, r, np.array([0]), np.zeros((1, 3)), np.array([SPEED]), mounting, line, station, out
        )
        assert out[0, 0] == pytest.approx(120.0, abs=0.05)
        assert out[0, 2] == pytest.approx(left, abs=0.02)
        assert out[0, 1] == pytest.approx(speed, abs=0.1 if known else 0.4)
        assert out[0, 3] == pytest.approx(across if known else 0.0, abs=0.1)
