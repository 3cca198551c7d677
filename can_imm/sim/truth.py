"""The true motion of the objects of a scenario, sampled every 10 ms.

Each object is a kinematic bicycle whose reference point, the middle of the rear axle, is the point
that the sensor sees.  A Stanley controller steers its front axle along a piecewise-linear path.
The path's knots lie where a vehicle that follows it exactly is at the times of the scenario table,
so each lane change takes the time that the table gives it (to a few ms: the rear axle cuts the
corners).  Stanley's law keeps the front axle of a kinematic bicycle on the path, so that the gain
matters only off it; what the sensor sees trails by a wheelbase.  The vehicle's speed along its own
heading is the ego's plus the profile of the table: a trapezoid inside each window.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
import numpy.typing as npt

from can_imm.sim.model import SPEED_LABELS, Scenario, ScenarioObject, windows
from can_imm.types import VX, VY, FloatArray, Manoeuvre, X, Y

DT_NS = 10_000_000
"""Time between samples [ns]."""
_SUBSTEPS = 10
"""Integration steps per sample (1 ms each): a finer step moves no sample by a millimetre."""
_DT = DT_NS * 1e-9

Int8Array = npt.NDArray[np.int8]
Int64Array = npt.NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Truth:
    """One object's motion, in N samples until the run ends or the gap is 0.

    Attributes:
        object_id: as in the scenario.
        t_ns: (N,) time from 0 on [ns].
        state: (N, 4) x, vx, y, vy relative to the ego [m, m/s, m, m/s].
        label: (N,) value of `Manoeuvre`.
        direction: (N,) during a lane change +1 left, -1 right, else 0.
        lane: (N,) nearer lane, 0 right, 1 left.
        speed: (N,) speed over ground [m/s].
        steer: (N,) steering angle [rad], positive to the left.
        heading: (N,) [rad], positive to the left.
        dt_ns: time between samples [ns].
    """

    object_id: int
    t_ns: Int64Array
    state: FloatArray
    label: Int8Array
    direction: Int8Array
    lane: Int8Array
    speed: FloatArray
    steer: FloatArray
    heading: FloatArray
    dt_ns: int = DT_NS


def simulate(scenario: Scenario) -> list[Truth]:
    """Drive all objects of the scenario; one `Truth` each, in the scenario's order."""
    return [_drive(scenario, target) for target in scenario.objects]


def _drive(scenario: Scenario, target: ScenarioObject) -> Truth:
    n = int(scenario.duration / _DT + 1e-6) + 1
    profile = _SpeedProfile.of(scenario, target)
    fine = np.arange((n - 1) * _SUBSTEPS + 1, dtype=np.float64) * (_DT / _SUBSTEPS)
    t = np.arange(n, dtype=np.float64) * _DT
    speed = profile.speed(t)
    path_x, path_y = _path(scenario, target, profile)
    motion = np.empty((n, 4))
    kept = _integrate(
        profile.distance(fine),
        speed,
        path_x,
        path_y,
        target.gap,
        scenario.ego_speed,
        scenario.vehicle.wheelbase,
        scenario.vehicle.stanley_gain,
        motion,
    )
    motion, speed, t = motion[:kept], speed[:kept], t[:kept]
    heading = motion[:, 2]
    state = np.empty((kept, 4))
    state[:, X] = motion[:, 0]
    state[:, VX] = speed * np.cos(heading) - scenario.ego_speed
    state[:, Y] = motion[:, 1]
    state[:, VY] = speed * np.sin(heading)
    label, direction = _labels(scenario, target, t, state[:, X])
    return Truth(
        object_id=target.id,
        t_ns=np.arange(kept, dtype=np.int64) * DT_NS,
        state=state,
        label=label,
        direction=direction,
        lane=(state[:, Y] > scenario.lane_width / 2).astype(np.int8),
        speed=speed,
        steer=motion[:, 3].copy(),
        heading=heading.copy(),
    )


@dataclass(frozen=True, slots=True)
class _SpeedProfile:
    """Piecewise-linear speed: from ``time[i]`` on it is ``start[i] + slope[i] (t - time[i])``."""

    time: FloatArray
    start: FloatArray
    slope: FloatArray
    travelled: FloatArray

    @classmethod
    def of(cls, scenario: Scenario, target: ScenarioObject) -> _SpeedProfile:
        """The ego's speed, plus one trapezoid per overtaking, receding or approaching."""
        acceleration = scenario.vehicle.acceleration
        rows: list[tuple[float, float, float]] = []
        for segment, end in windows(scenario, target):
            v = scenario.ego_speed
            if segment.label not in SPEED_LABELS:
                rows.append((segment.start, v, 0.0))
                continue
            sign = -1.0 if segment.label is Manoeuvre.APPROACHING else 1.0
            peak = sign * segment.peak
            ramp = segment.peak / acceleration
            if ramp > 0.0:
                rows.append((segment.start, v, sign * acceleration))
            rows.append((segment.start + ramp, v + peak, 0.0))
            if ramp > 0.0:
                rows.append((end - ramp, v + peak, -sign * acceleration))
        time, start, slope = np.array(rows).T.copy()
        step = np.diff(time)
        travelled = np.zeros(len(time))
        np.cumsum(start[:-1] * step + 0.5 * slope[:-1] * step**2, out=travelled[1:])
        return cls(time, start, slope, travelled)

    def _piece(self, t: FloatArray) -> tuple[npt.NDArray[np.intp], FloatArray]:
        # the tolerance lets a sample at a row's own time see that row in spite of rounding
        i = np.searchsorted(self.time, t + 1e-9, side="right") - 1
        return i, t - self.time[i]

    def speed(self, t: FloatArray) -> FloatArray:
        """Speed [m/s] at the times t [s]."""
        i, since = self._piece(t)
        return np.asarray(self.start[i] + self.slope[i] * since)

    def distance(self, t: FloatArray) -> FloatArray:
        """Distance travelled since 0 [m] at the times t [s]."""
        i, since = self._piece(t)
        return np.asarray(
            self.travelled[i] + self.start[i] * since + 0.5 * self.slope[i] * since**2
        )


def _path(
    scenario: Scenario, target: ScenarioObject, profile: _SpeedProfile
) -> tuple[FloatArray, FloatArray]:
    """Knots of the path: x over ground from the front axle's place at t = 0, and y [m].

    A leg's length is the distance that the vehicle travels between the knots' times, so that the
    leg's extent along the road is the other side of a right triangle.
    """
    side = (0.0, scenario.lane_width)
    lane = target.lane
    knots = [(0.0, side[lane])]
    for segment, end in windows(scenario, target):
        if segment.label is Manoeuvre.LANE_CHANGE:
            knots += [(segment.start, side[lane]), (end, side[1 - lane])]
            lane = 1 - lane
        elif segment.label is Manoeuvre.OVERTAKING:
            knots += [
                (segment.start, side[0]),
                (segment.start + segment.pull_out, side[1]),
                (end - segment.pull_in, side[1]),
                (end, side[0]),
            ]
    time, y = np.array(knots).T.copy()
    along = np.diff(profile.distance(time))
    x = np.concatenate(([0.0], np.cumsum(np.sqrt(along**2 - np.diff(y) ** 2))))
    keep = np.concatenate(([True], np.diff(x) > 1e-9))  # not the knots that coincide
    return np.append(x[keep], np.inf), np.append(y[keep], side[lane])


def _labels(
    scenario: Scenario, target: ScenarioObject, t: FloatArray, gap: FloatArray
) -> tuple[Int8Array, Int8Array]:
    """Label and lane-change direction of each sample: the row that has started by then."""
    start = np.array([segment.start for segment in target.segments])
    row = np.searchsorted(start, t + 1e-9, side="right") - 1
    label = np.array([segment.label for segment in target.segments], np.int8)[row]
    direction = np.array([segment.direction for segment in target.segments], np.int8)[row]
    label[(label == Manoeuvre.APPROACHING) & (gap <= scenario.rear_end_gap)] = Manoeuvre.REAR_END
    return label, direction


@numba.njit(cache=True)
def _steering(
    x: float,
    y: float,
    heading: float,
    speed: float,
    knot_x: float,
    knot_y: float,
    path_heading: float,
    wheelbase: float,
    gain: float,
) -> float:
    """Stanley's law: heading error plus arctan(k e / v), e measured at the front axle."""
    front_x = x + wheelbase * (np.cos(heading) - 1.0)  # from the front axle's place at t = 0
    front_y = y + wheelbase * np.sin(heading)
    error = (knot_y - front_y) * np.cos(path_heading) + (front_x - knot_x) * np.sin(path_heading)
    return float(path_heading - heading + np.arctan(gain * error / speed))


@numba.njit(cache=True)
def _integrate(
    distance: FloatArray,
    speed: FloatArray,
    path_x: FloatArray,
    path_y: FloatArray,
    gap: float,
    ego_speed: float,
    wheelbase: float,
    gain: float,
    out: FloatArray,
) -> int:
    """Midpoint rule over the distance travelled; returns how many samples precede gap 0.

    Args:
        distance: ((n-1) _SUBSTEPS + 1,) distance travelled at each integration step [m].
        speed: (n,) at each sample [m/s].
        path_x, path_y: (k,) knots [m], see `_path`.
        out: (n, 4) gap, y, heading, steering angle per sample.
    """
    step = _DT / _SUBSTEPS
    x, y, heading = 0.0, path_y[0], 0.0
    leg = 0
    path_heading = np.arctan2(path_y[1] - path_y[0], path_x[1] - path_x[0])
    for k in range(len(out)):
        for i in range(max(k - 1, 0) * _SUBSTEPS, k * _SUBSTEPS):
            ds = distance[i + 1] - distance[i]
            v = ds / step
            while (
                leg < len(path_x) - 2
                and x + wheelbase * (np.cos(heading) - 1.0) >= path_x[leg + 1] - 1e-9
            ):
                leg += 1
                path_heading = np.arctan2(
                    path_y[leg + 1] - path_y[leg], path_x[leg + 1] - path_x[leg]
                )
            px, py = path_x[leg], path_y[leg]
            steer = _steering(x, y, heading, v, px, py, path_heading, wheelbase, gain)
            mx = x + 0.5 * ds * np.cos(heading)
            my = y + 0.5 * ds * np.sin(heading)
            mh = heading + 0.5 * ds * np.tan(steer) / wheelbase
            steer = _steering(mx, my, mh, v, px, py, path_heading, wheelbase, gain)
            x += ds * np.cos(mh)
            y += ds * np.sin(mh)
            heading += ds * np.tan(steer) / wheelbase
        out[k, 0] = gap + x - ego_speed * k * _DT
        out[k, 1] = y
        out[k, 2] = heading
        out[k, 3] = _steering(
            x, y, heading, speed[k], path_x[leg], path_y[leg], path_heading, wheelbase, gain
        )
        if out[k, 0] <= 0.0:
            return k
    return len(out)
