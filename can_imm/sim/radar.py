"""What a radar makes of the motorway: noise, gaps, track numbers that are reused, double tracks.

Measurements are as in the sensor's own coordinates but before its quantisation, which the frames
bring.  Latencies are 0.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from math import exp, radians, sqrt

import numpy as np

from can_imm.sim.motorway import DT_NS, MotorwayTruth
from can_imm.sim.motorway_model import Int64Array
from can_imm.types import VX, VY, BoolArray, CanImmError, FloatArray, Manoeuvre, Scan, X, Y

MS = 1_000_000
"""[ns]"""
_NEAREST = 1.0
"""What is nearer along x is not seen [m]."""
EGO_PERIOD_NS = 20_000_000
"""The vehicle tells its own motion so often [ns]."""
_EGO_SPEED_STD, _EGO_YAW_STD, _EGO_YAW_BIAS = 0.05, 0.002, 0.003
"""Errors of the measured ego motion [m/s, rad/s, rad/s]."""


@dataclass(frozen=True)
class RadarModel:
    """One kind of radar.

    Attributes:
        name: of the profile that has its frames.
        period: time between scans [s].
        tick: the scans' times are rounded to multiples of it [s], whole milliseconds.
        polar: it measures range, range rate and bearing instead of coordinates.
        std: white noise; Cartesian: of x, vx, y, vy [m, m/s, m, m/s], NaN what it does not measure;
            polar: of range, range rate [m, m/s] and bearing [rad].
        wander: standard deviation of the slowly changing errors of x and y [m].
        wander_time: their correlation time [s].
        bearing: standard deviation of an error of the bearing that all tracks share and that
            wanders in the same way [rad].
        slots: number of tracks that it can hold; their ids are 0 to slots - 1.
        in_turn: a new track takes the id after the last one given; otherwise the lowest free one.
        hold: a track whose object is out of view ends after so long [s].
        rest: an id is not given again for so long [s].
        missed: probability that one object is missing from a scan.
        dropout: probability that a whole scan is missing.
        duplicates: second tracks that appear on a vehicle, per second of being seen.
        near, far: each (range [m], half the angle of view [rad]).

    Raises:
        CanImmError: a value outside its range.
    """

    name: str
    period: float
    std: tuple[float, ...]
    polar: bool = False
    wander: tuple[float, float] = (0.0, 0.0)
    wander_time: float = 1.0
    bearing: float = 0.0
    slots: int = 64
    in_turn: bool = True
    hold: float = 0.4
    rest: float = 1.0
    missed: float = 0.02
    dropout: float = 0.0
    duplicates: float = 0.0
    tick: float = 0.001
    near: tuple[float, float] = (60.0, radians(45.0))
    far: tuple[float, float] = (200.0, radians(9.5))

    def __post_init__(self) -> None:
        for name in ("missed", "dropout"):
            if not 0.0 <= getattr(self, name) < 1.0:
                raise CanImmError(
                    f"radar: {name} must be a probability below 1, not {getattr(self, name)}"
                )
        if not 0.001 <= self.tick <= self.period:
            raise CanImmError(
                f"radar: tick must be 0.001 s to the period, {self.period:g} s, not {self.tick:g}"
            )
        if self.slots < 1:
            raise CanImmError(f"radar: slots must be 1 or more, not {self.slots}")


_NAN = float("nan")
RADARS = {
    radar.name: radar
    for radar in (
        RadarModel("can_imm", 0.1, (0.1, 0.3, 0.2, 0.3), missed=0.01, dropout=0.005),
        RadarModel(
            "ars408", 1.0 / 14.0, (0.1, 0.3, 0.2, 0.3), slots=100, missed=0.02, dropout=0.002,
            duplicates=0.003,
        ),
        RadarModel(
            "toyota", 0.05, (0.08, 0.06, 0.08, _NAN), wander=(0.12, 0.2), wander_time=0.4,
            bearing=0.004, slots=16, in_turn=False, hold=0.0, rest=0.0, missed=0.01, dropout=0.002,
            duplicates=0.003,
        ),
        RadarModel(
            "toyota-tss2", 0.05, (0.08, 0.06, 0.08, _NAN), wander=(0.12, 0.2), wander_time=0.4,
            bearing=0.004, slots=16, in_turn=False, hold=0.0, rest=0.0, missed=0.01, dropout=0.002,
            duplicates=0.003,
        ),
        RadarModel(
            "esr", 0.05, (0.2, 0.1, radians(0.4)), polar=True, slots=64, in_turn=False, rest=0.2,
            missed=0.02, dropout=0.002, duplicates=0.003,
        ),
    )
}  # fmt: skip
"""The radars whose frames there are profiles for."""


def radar_model(name: str) -> RadarModel:
    """The radar of that name.

    Raises:
        CanImmError: there is none.
    """
    if name not in RADARS:
        raise CanImmError(f"no radar '{name}'; there are {', '.join(RADARS)}")
    return RADARS[name]


@dataclass(frozen=True, eq=False, slots=True)
class Measured:
    """Scans, and what their rows truly are.

    Attributes:
        scans: in order of time.
        objects: per scan (n,) index into `MotorwayTruth.objects` of each row's object; it occurs
            twice where there is a second track on a vehicle.
        samples: per scan (n,) index into that object's arrays of the sample at or before the scan.
        states: per scan (n, 4) the true x, vx, y, vy at the scan's time, of the vehicle's rear.
        second: per scan (n,) the row belongs to a second track.
    """

    scans: list[Scan]
    objects: list[Int64Array]
    samples: list[Int64Array]
    states: list[FloatArray]
    second: list[BoolArray]


@dataclass(slots=True)
class _Track:
    """An id in use: ``until`` when it is kept without being seen again [s], ``error`` the slowly
    changing one of x and y [m], ``offset`` of a second track along the vehicle [m], else 0."""

    id: int
    object: int
    until: float
    error: FloatArray
    offset: float = 0.0
    new: bool = True


def observe(truth: MotorwayTruth, radar: RadarModel, rng: np.random.Generator) -> Measured:
    """Measure all objects in the field of view, every period from 0 on.

    ``counter`` counts the scans that were due, so that a dropout leaves a gap in it.  ``new`` is
    set in an id's first row of each object.  The noise grows by the settings' factor, the stated
    standard deviations do not.
    """
    return _Observer(truth, radar, rng).run()


def measure_ego(
    truth: MotorwayTruth, times: Int64Array, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """The ego's speed [m/s] and yaw rate [rad/s] at times [ns] as its own sensors measure them."""
    ego, t, noise = truth.ego, truth.t_ns, truth.scenario.noise
    bias = _EGO_YAW_BIAS * rng.standard_normal()
    speed, yaw_rate = rng.standard_normal((2, len(times)))
    return (
        np.interp(times, t, ego.speed) + noise * _EGO_SPEED_STD * speed,
        np.interp(times, t, ego.yaw_rate) + noise * (bias + _EGO_YAW_STD * yaw_rate),
    )


def ego_messages(truth: MotorwayTruth, rng: np.random.Generator) -> list[tuple[int, float, float]]:
    """Time [ns], speed [m/s] and yaw rate [rad/s] of what the ego says of itself in a drive."""
    times = np.arange(0, int(truth.t_ns[-1]) + 1, EGO_PERIOD_NS, dtype=np.int64)
    speed, yaw_rate = measure_ego(truth, times, rng)
    return list(zip(times.tolist(), speed.tolist(), yaw_rate.tolist(), strict=True))


class _Observer:
    def __init__(self, truth: MotorwayTruth, radar: RadarModel, rng: np.random.Generator) -> None:
        self.truth, self.radar, self.rng = truth, radar, rng
        self.noise = truth.scenario.noise
        self.tracks: dict[int, _Track] = {}
        self.free: deque[int] = deque(range(radar.slots))
        self.resting: deque[tuple[float, int]] = deque()
        objects = truth.objects
        self.first = np.array([o.first for o in objects], np.int64)
        self.length = np.array([len(o.t_ns) for o in objects], np.int64)
        self.start = np.cumsum(self.length) - self.length
        self.state = np.concatenate([np.empty((0, 4)), *(o.state for o in objects)])
        std = np.array([*radar.std, 1.0][:4])
        self.valid = np.isfinite(std) & ([True, True, True, not radar.polar])
        self.std = np.where(self.valid, std, 1.0)
        self.stay = exp(-radar.period / radar.wander_time)
        self.bearing = radar.bearing * self.noise * rng.standard_normal()

    def run(self) -> Measured:
        truth, radar, rng = self.truth, self.radar, self.rng
        measured = Measured([], [], [], [], [])
        end = int(truth.t_ns[-1])
        n_scans = int(end * 1e-9 / radar.period + 1e-9) + 1
        tick_ns = round(radar.tick * 1000.0) * MS
        times = np.rint(np.arange(n_scans) * radar.period / radar.tick).astype(np.int64) * tick_ns
        times = times[times <= end]
        dropped = rng.random(len(times)) < radar.dropout
        ego_speed, ego_yaw_rate = measure_ego(truth, times, rng)
        for k, t_ns in enumerate(times.tolist()):
            tracks, states = self.follow(t_ns)
            seen = rng.random(len(tracks)) >= radar.missed
            errors = rng.standard_normal((len(tracks), 4))
            if dropped[k]:
                continue
            tracks = [track for track, flag in zip(tracks, seen, strict=True) if flag]
            scan = self.scan(tracks, states[seen], errors[seen])
            scan.t_ns, scan.counter = t_ns, k
            scan.ego_speed, scan.ego_yaw_rate = float(ego_speed[k]), float(ego_yaw_rate[k])
            objects = np.array([track.object for track in tracks], np.int64)
            measured.scans.append(scan)
            measured.objects.append(objects)
            measured.samples.append(t_ns // DT_NS - self.first[objects])
            measured.states.append(states[seen])
            measured.second.append(np.array([track.offset != 0.0 for track in tracks], np.bool_))
        return measured

    def follow(self, t_ns: int) -> tuple[list[_Track], FloatArray]:
        """Begin and end tracks; return those whose objects are in view, and the true states."""
        radar, t = self.radar, t_ns * 1e-9
        sample, part = divmod(t_ns, DT_NS)
        at = sample - self.first
        there = np.flatnonzero((at >= 0) & (at + (part > 0) < self.length))
        index = self.start[there] + at[there]
        states = self.state[index]
        if part:
            states = states + part / DT_NS * (self.state[index + 1] - states)
        distance = np.hypot(states[:, X], states[:, Y])
        seen = np.flatnonzero(self.in_view(states, distance))
        seen = seen[np.argsort(distance[seen], kind="stable")][: radar.slots]
        state_of = {int(there[i]): states[i] for i in seen}

        while self.resting and self.resting[0][0] <= t:
            self.free.append(self.resting.popleft()[1])
        for track in list(self.tracks.values()):
            in_view = track.object in state_of
            if in_view and track.offset == 0.0:
                track.until = t + radar.hold
            elif t > track.until or not (in_view or track.offset == 0.0):
                del self.tracks[track.id]
                self.give_back(t, track.id)
        self.begin(t, state_of)
        shown = [track for _, track in sorted(self.tracks.items()) if track.object in state_of]
        for track in shown:
            track.error = self.stay * track.error + sqrt(1.0 - self.stay**2) * self.wander()
        return shown, np.array([state_of[track.object] for track in shown]).reshape(-1, 4)

    def in_view(self, states: FloatArray, distance: FloatArray) -> BoolArray:
        (near, wide), (far, narrow) = self.radar.near, self.radar.far
        bearing = np.abs(np.arctan2(states[:, Y], states[:, X]))
        within = (distance < near) & (bearing < wide) | (distance < far) & (bearing < narrow)
        return np.asarray(within & (states[:, X] > _NEAREST))

    def begin(self, t: float, state_of: dict[int, FloatArray]) -> None:
        """Tracks for the objects that have none, and second ones now and then."""
        radar = self.radar
        once = {track.object for track in self.tracks.values() if track.offset == 0.0}
        for number in state_of:
            if number not in once and (track_id := self.take()) is not None:
                self.tracks[track_id] = _Track(track_id, number, t + radar.hold, self.wander())
        twice = {track.object for track in self.tracks.values() if track.offset != 0.0}
        for number in self.vehicles_in(state_of):
            if self.rng.random() >= radar.duplicates * radar.period or number in twice:
                continue
            until, offset = t + self.rng.uniform(1.0, 6.0), self.rng.uniform(0.2, 1.5)
            if (track_id := self.take()) is not None:
                self.tracks[track_id] = _Track(track_id, number, until, self.wander(), offset)

    def vehicles_in(self, state_of: dict[int, FloatArray]) -> list[int]:
        labels = (self.truth.objects[number].label[0] for number in state_of)
        return [
            number
            for number, label in zip(state_of, labels, strict=True)
            if label != Manoeuvre.STATIONARY
        ]

    def take(self) -> int | None:
        """An id that is free, None if there is none."""
        if not self.free:
            return None
        if self.radar.in_turn:
            return self.free.popleft()
        lowest = min(self.free)
        self.free.remove(lowest)
        return lowest

    def give_back(self, t: float, track_id: int) -> None:
        if self.radar.rest > 0.0:
            self.resting.append((t + self.radar.rest, track_id))
        else:
            self.free.append(track_id)

    def wander(self) -> FloatArray:
        return self.rng.standard_normal(2) * self.radar.wander * self.noise

    def scan(self, tracks: list[_Track], states: FloatArray, errors: FloatArray) -> Scan:
        """A scan of these tracks; ``errors`` are standard normal."""
        radar, n = self.radar, len(tracks)
        scan = Scan(radar.slots)
        scan.n = n
        if n == 0:
            return scan
        scan.ids[:n] = [track.id for track in tracks]
        scan.new[:n] = [track.new for track in tracks]
        for track in tracks:
            track.new = False
        scan.valid[:n] = self.valid
        states = states.copy()
        states[:, X] += [track.offset for track in tracks]
        if radar.polar:
            distance = np.hypot(states[:, X], states[:, Y])
            rate = (states[:, X] * states[:, VX] + states[:, Y] * states[:, VY]) / distance
            bearing = np.arctan2(states[:, Y], states[:, X])
            noise = errors[:, :3] * self.std[:3] * self.noise
            scan.z[:n, X] = np.maximum(distance + noise[:, 0], 0.1)
            scan.z[:n, VX] = rate + noise[:, 1]
            scan.angle[:n] = bearing + noise[:, 2]
            scan.std[:n, :2] = self.std[:2]
            scan.std[:n, Y] = scan.z[:n, X] * self.std[2]
            return scan
        if radar.bearing:
            fresh = sqrt(1.0 - self.stay**2) * radar.bearing * self.noise
            self.bearing = self.stay * self.bearing + fresh * self.rng.standard_normal()
        error = np.array([track.error for track in tracks])
        error[:, 1] += self.bearing * states[:, X]
        scan.z[:n] = np.where(self.valid, states + errors * self.std * self.noise, 0.0)
        scan.z[:n, X] += error[:, 0]
        scan.z[:n, Y] += error[:, 1]
        scan.std[:n] = self.std
        scan.std[:n, X] = np.hypot(self.std[X], radar.wander[0])
        scan.std[:n, Y] = np.hypot(self.std[Y], radar.wander[1])
        return scan
