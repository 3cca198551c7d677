"""The cooperative tracker: detections of many vehicles' radars in, one object out, if there is one.

A Bernoulli particle filter (`can_imm.estimation.bernoulli`) behind the checks that a bus makes
necessary.  What sensors contradict each other about needs no check: to the filter a detection
that does not fit is clutter, and a sensor that is silent has missed the object.
"""

from __future__ import annotations

import math

import numpy as np

from can_imm.estimation.bernoulli import BernoulliFilter, BernoulliModel
from can_imm.trackers import TrackerCounts
from can_imm.types import (
    POSE_HEADING,
    POSE_VX,
    POSE_VY,
    POSE_X,
    POSE_Y,
    CanImmError,
    DetectionScan,
    FloatArray,
    IntArray,
    Scan,
)

OBJECT_ID = 1
"""The one object's id."""

REPORT_ABOVE = 0.5
"""The object is reported while its existence is more probable than this ..."""

CONFIRM = 4
"""... from this scan in a row on: a detection says little of the speed across its direction."""

FORGET_S = 2.0
"""After so long without a scan [s] everything begins anew."""

_AHEAD_NS = 1_000_000_000
_MAX_DELAY_S = 1.0
_MAX_RANGE, _MAX_RATE, _MAX_SPEED, _MAX_PLACE = 1e3, 300.0, 500.0, 1e6
"""What lies beyond is not a measurement [s, m, m/s, m/s, m]."""


class CooperativeTracker:
    """A `can_imm.trackers.Tracker`: reports the object relative to one of the observing vehicles.

    Attributes:
        counts: what became of scans and detections.
        filter: the Bernoulli filter, in the axes of the sensors' poses.

    Args:
        model: parameters of the filter.
        ego: id of the sensor on the vehicle in whose axes the object is reported.
        particles: N_p; N_p more are born for each detection of ``full_sensors`` sensors.
        seed: of the particles' random numbers.
        full_sensors: number of sensors that see the object in a usual scan.
        sensors, capacity: greatest numbers of sensors and detections in a scan.

    Raises:
        CanImmError: impossible parameters.
    """

    def __init__(
        self,
        model: BernoulliModel | None = None,
        *,
        ego: int = 0,
        particles: int = 1000,
        seed: int = 0,
        full_sensors: int = 5,
        sensors: int = 15,
        capacity: int = 256,
    ) -> None:
        if particles < 1:
            raise CanImmError(f"the cooperative tracker needs particles, not {particles}")
        self.counts = TrackerCounts()
        self.filter = BernoulliFilter(
            model or BernoulliModel(),
            np.random.default_rng(seed),
            particles=particles,
            births=full_sensors * particles,
            sensors=sensors,
            capacity=capacity,
        )
        self._ego = ego
        self._ego_pose: FloatArray = np.zeros(5)
        self._ego_ns: int | None = None
        self._t_ns: int | None = None
        self._counter: dict[int, tuple[int, int]] = {}
        self._reported = False
        self._probable = 0
        self._scans = 0
        self._scan = Scan(1)
        self._scan.ids[0] = OBJECT_ID
        self._scan.valid[0] = True
        # the usable part of a scan
        self._pose: FloatArray = np.zeros((sensors, 5))
        self._delay: FloatArray = np.zeros(sensors)
        self._sensor: IntArray = np.zeros(capacity, np.int32)
        self._z: FloatArray = np.zeros((capacity, 3))

    def step(self, t_ns: int, detections: DetectionScan | None) -> Scan | None:
        """Take in the scan that came in the step at ``t_ns`` [ns], if any; see `Tracker.step`."""
        if detections is None:
            self._forget_after_silence(t_ns)
            return None
        rows = self._usable_rows(t_ns, detections)
        if not rows:
            self.counts.late_scans += 1
            return None
        at_ns, n = self._collect(detections, rows)
        self._forget_after_silence(at_ns)
        dt = 0.0 if self._t_ns is None else (at_ns - self._t_ns) * 1e-9
        self._t_ns = at_ns
        s = len(rows)
        ok = self.filter.step(dt, self._pose[:s], self._delay[:s], self._sensor[:n], self._z[:n])
        self.counts.scans += 1
        self.counts.detections += n
        self.counts.numeric_failures += not ok
        self._follow_ego(detections, rows)
        return self._report(at_ns)

    def _forget_after_silence(self, t_ns: int) -> None:
        if self._t_ns is not None and t_ns - self._t_ns > FORGET_S * 1e9:
            self.counts.resets += 1
            self.filter.forget()
            self._t_ns = self._ego_ns = None
            self._probable = 0
            self._note(exists=False)

    def _usable_rows(self, t_ns: int, scan: DetectionScan) -> list[int]:
        """Rows of the sensors whose part of the scan can be used."""
        rows: list[int] = []
        for row in range(scan.n_sensors):
            pose, delay = scan.pose[row], float(scan.delay[row])
            sane = (
                0.0 <= delay <= _MAX_DELAY_S
                and bool(np.isfinite(pose).all())
                and abs(pose[:2]).max() <= _MAX_PLACE
                and abs(pose[3:]).max() <= _MAX_SPEED
            )
            at_ns = scan.t_ns + round(delay * 1e9) if sane else 0
            name, counter = int(scan.sensor_id[row]), int(scan.counter[row])
            last = self._counter.get(name)
            if not sane or at_ns > t_ns + _AHEAD_NS:
                self.counts.invalid += 1
            elif last is not None and last[0] == counter and at_ns - last[1] < FORGET_S * 1e9:
                self.counts.repeated_sensors += 1
            elif self._t_ns is not None and at_ns <= self._t_ns:
                self.counts.late_sensors += 1
            elif len(rows) == len(self._pose):
                self.counts.overflow += 1
            else:
                self._counter[name] = counter, at_ns
                rows.append(row)
        return rows

    def _collect(self, scan: DetectionScan, rows: list[int]) -> tuple[int, int]:
        """Copy these sensors and their possible detections; returns time [ns] and number."""
        first_s = min(float(scan.delay[row]) for row in rows)
        n = 0
        for place, row in enumerate(rows):
            self._pose[place] = scan.pose[row]
            self._delay[place] = scan.delay[row] - first_s
            for i in np.flatnonzero(scan.sensor[: scan.n] == row):
                distance, bearing, rate = scan.z[i].tolist()
                if not (
                    0.0 <= distance <= _MAX_RANGE
                    and abs(bearing) <= math.tau
                    and (math.isnan(rate) or abs(rate) <= _MAX_RATE)
                ):
                    self.counts.invalid += 1
                elif n == len(self._z):
                    self.counts.overflow += 1
                else:
                    self._sensor[n] = place
                    self._z[n] = distance, bearing, rate
                    n += 1
        return scan.t_ns + round(first_s * 1e9), n

    def _follow_ego(self, scan: DetectionScan, rows: list[int]) -> None:
        for row in rows:
            if scan.sensor_id[row] == self._ego:
                self._ego_pose[:] = scan.pose[row]
                self._ego_ns = scan.t_ns + round(float(scan.delay[row]) * 1e9)

    def _note(self, *, exists: bool) -> None:
        self._scan.new[0] = exists and not self._reported
        self.counts.births += exists and not self._reported
        self.counts.deaths += self._reported and not exists
        self._reported = exists

    def _report(self, at_ns: int) -> Scan:
        """The object in the axes of the ego vehicle; an ego that is silent is taken to drive on."""
        scan, f = self._scan, self.filter
        scan.t_ns = at_ns
        scan.counter = self._scans = (self._scans + 1) % 65536
        self._probable = self._probable + 1 if f.q > REPORT_ABOVE else 0
        exists = self._probable >= CONFIRM and self._ego_ns is not None
        self._note(exists=exists)
        scan.n = int(exists)
        if not exists or self._ego_ns is None:
            return scan
        ego, age = self._ego_pose, (at_ns - self._ego_ns) * 1e-9
        c, s = math.cos(ego[POSE_HEADING]), math.sin(ego[POSE_HEADING])
        x, vx, y, vy = f.mean.tolist()
        dx, dy = x - ego[POSE_X] - age * ego[POSE_VX], y - ego[POSE_Y] - age * ego[POSE_VY]
        dvx, dvy = vx - ego[POSE_VX], vy - ego[POSE_VY]
        scan.z[0] = c * dx + s * dy, c * dvx + s * dvy, c * dy - s * dx, c * dvy - s * dvx
        turn = np.array([[c, 0, s, 0], [0, c, 0, s], [-s, 0, c, 0], [0, -s, 0, c]])
        variance = np.einsum("ij,jk,ik->i", turn, f.cov, turn)
        scan.std[0] = np.sqrt(np.maximum(variance, 1e-12))
        scan.existence[0] = f.q
        return scan
