"""The roadside tracker: detections of lidars in, one vehicle with its motion out.

An IMM of unscented Kalman filters (`can_imm.estimation.ukf`) with the life of a track around it:
which detections are believed, when a track begins, when it is given up.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from can_imm.estimation import ukf
from can_imm.estimation.models import generator_from_matrix, transition_table
from can_imm.trackers import TrackerCounts
from can_imm.types import (
    BEARING,
    POSE_HEADING,
    POSE_X,
    POSE_Y,
    RANGE,
    CanImmError,
    DetectionScan,
    FloatArray,
    Scan,
)

_STEP_S = 0.01
"""Resolution of the table of transition probabilities [s]."""
_TOGETHER_NS = 1_000_000
"""Lidars that measured within this time of each other make one update [ns]."""
_AHEAD_NS = 1_000_000_000
"""A measurement from further in the future is a broken time stamp [ns]."""
_COUNTER_MODULUS = 65536
_MAX_DELAY_S = 1.0
_MAX_RANGE = 1000.0
"""What lies beyond is not a measurement [s, m]."""
_MU_FLOOR = 1e-6
_BIRTH_SPEED = 15.0
"""Standard deviation of each component of the velocity at a track's birth [m/s]."""


@dataclass(frozen=True)
class Motion:
    """One model of the filter.

    Attributes:
        kind: `ukf.CV` or `ukf.CT`.
        q: spectral density of the acceleration [m²/s³].
        q_turn: spectral density of the turn rate's derivative [rad²/s³].
        turn: mean and standard deviation of the turn rate of who begins to move like this [rad/s].
    """

    kind: int
    q: float
    q_turn: float
    turn: tuple[float, float]


@dataclass(frozen=True)
class RoadsideSettings:
    """Everything that can be set.

    Attributes:
        models: 1 to `ukf.MAX_MODELS` of them.
        transitions: probability of going from model i to model j within ``period_s``.
        birth: probability of each model at a track's birth.
        period_s: the time that ``transitions`` belongs to [s].
        range_std, bearing_std: of the lidars [m, rad].
        gate: a detection is an outlier if its squared distance is larger (chi-square, 2 degrees of
            freedom); infinite: everything is believed.
        max_outliers: after so many scans in a row with outliers and nothing else the track is
            given up, and the next detection begins another.
        coast_s: a track that was not measured for longer than this ends [s].
        confirm: detections that a track needs before it is reported.
        object_id: under which the vehicle is reported.
    """

    models: tuple[Motion, ...]
    transitions: tuple[tuple[float, ...], ...]
    birth: tuple[float, ...]
    period_s: float = 0.05
    range_std: float = 0.05
    bearing_std: float = 0.05
    gate: float = 30.0
    max_outliers: int = 5
    coast_s: float = 1.0
    confirm: int = 4
    object_id: int = 1


IMM_UKF = RoadsideSettings(
    models=(
        Motion(ukf.CV, q=0.001, q_turn=1e-4, turn=(0.0, 0.01)),
        Motion(ukf.CT, q=0.001, q_turn=0.001, turn=(0.5, 0.15)),
        Motion(ukf.CT, q=0.001, q_turn=0.001, turn=(-0.5, 0.15)),
        Motion(ukf.CV, q=3.0, q_turn=1e-4, turn=(0.0, 0.01)),
    ),
    transitions=(
        (0.9795, 0.01, 0.01, 0.0005),
        (0.005, 0.9944, 0.0001, 0.0005),
        (0.005, 0.0001, 0.9944, 0.0005),
        (0.05, 0.01, 0.01, 0.93),
    ),
    birth=(0.88, 0.05, 0.05, 0.02),
)
"""Straight on, a bend to the left, a bend to the right, and rarely anything else.

Two models of turns instead of one around 0: a turn rate near 0 is not a turn, so that a straight
can be told from a bend.  The last model is a constant velocity with so much noise that a vehicle
which brakes or speeds up is not lost; on a road without that it costs a tenth of the accuracy.
The first three models' numbers were found as ``can-imm study tune-roadside`` does, and rounded; how
soon a turn ends was chosen afterwards on seeds 100 to 139.
"""


@dataclass
class RoadsideCounts(TrackerCounts):
    """`TrackerCounts`, and what became of the other detections.

    Attributes:
        outliers: detections too far from anything the vehicle could do.
        extra: detections beside one that was used: of the same lidar in one scan, where the
            likeliest is used, and at a track's birth, where the nearest is.
    """

    outliers: int = 0
    extra: int = 0


class RoadsideTracker:
    """Follows one vehicle; a `can_imm.trackers.Tracker`.

    All lidars that measured at the same time make one update; where the times differ, one update
    per time.  A scan in which nobody saw the vehicle moves the track on.  The object is reported
    in the axes of the lidars' poses, at the time of the scan's last measurement.

    Attributes:
        counts: what became of scans and detections.
        track: record of `ukf.TRACK_DTYPE`, the estimate after the last scan, if `alive`.
        alive: there is a track.

    Args:
        settings: models and limits.
        sensors: greatest number of lidars in a scan; further ones are left out.
        capacity: greatest number of detections at one time; further ones are left out.

    Raises:
        CanImmError: impossible settings.
    """

    def __init__(
        self, settings: RoadsideSettings = IMM_UKF, *, sensors: int = 15, capacity: int = 64
    ) -> None:
        if sensors < 1 or capacity < 1:
            raise CanImmError("the roadside tracker needs room for a sensor and a detection")
        self.settings = settings
        self.counts = RoadsideCounts()
        self.alive = False
        self._parameters = _parameters(settings)
        self.track: Any = np.zeros(1, ukf.TRACK_DTYPE)[0]
        self._scratch = np.zeros(1, ukf.SCRATCH_DTYPE)[0]
        self._scan = Scan(1)
        self._scan.ids[0] = settings.object_id
        self._scan.valid[0] = True
        self._places: FloatArray = np.zeros((capacity, 2))
        self._z: FloatArray = np.zeros((capacity, 2))
        self._r: FloatArray = np.empty((capacity, 2))
        self._r[:] = settings.range_std**2, settings.bearing_std**2
        self._d2: FloatArray = np.zeros(capacity)
        self._one: FloatArray = np.zeros(capacity)
        self._row = np.zeros(capacity, np.int64)  # of the lidar in the scan
        self._seen: FloatArray = np.zeros((ukf.N_POINTS, 2 * capacity))
        self._mean: FloatArray = np.zeros(2 * capacity)
        self._S: FloatArray = np.zeros((2 * sensors, 2 * sensors))
        self._C: FloatArray = np.zeros((ukf.N, 2 * sensors))
        self._sensors, self._capacity = sensors, capacity
        self._reset()
        self._warm_up()

    def _reset(self) -> None:
        self.counts = RoadsideCounts()
        self.alive = False
        self._t_ns = -1  # of the estimate
        self._measured_ns = -1  # of the last detection that was used
        self._counter: dict[int, int] = {}  # last one of each lidar
        self._hits = 0
        self._strange = 0  # updates in a row with nothing but outliers
        self._new = True
        self._scan.counter = -1

    def _warm_up(self) -> None:
        """Compile every kernel, or load it from the cache, before the clock starts."""
        scan = DetectionScan(1, 1)
        scan.n_sensors = scan.n = 1
        scan.z[0] = 10.0, 0.0, np.nan
        for k in range(2):
            scan.t_ns, scan.counter[0] = k * 50_000_000, k
            self.step(scan.t_ns, scan)
        self._reset()

    @property
    def turning(self) -> float:
        """Probability of the constant-turn models."""
        models = enumerate(self.settings.models)
        return sum(float(self.track["mu"][j]) for j, model in models if model.kind == ukf.CT)

    def step(self, t_ns: int, detections: DetectionScan | None) -> Scan | None:
        """Take in the scan that came in the step at ``t_ns`` [ns], if any; see `Tracker.step`."""
        if detections is None:
            self._bury(t_ns)
            return None
        parts = self._parts(t_ns, detections)
        if not parts:
            return None
        self.counts.scans += 1
        first = 0
        for i in range(1, len(parts) + 1):
            if i == len(parts) or parts[i][0] - parts[first][0] > _TOGETHER_NS:
                self._take(parts[first][0], self._collect(detections, parts[first:i]))
                first = i
        return self._report()

    def _parts(self, t_ns: int, detections: DetectionScan) -> list[tuple[int, int]]:
        """Time [ns] and row of every lidar whose measurement can be used, in order of time."""
        parts: list[tuple[int, int]] = []
        for row in range(detections.n_sensors):
            delay = float(detections.delay[row])
            usable = 0.0 <= delay <= _MAX_DELAY_S and np.isfinite(detections.pose[row, :3]).all()
            at = detections.t_ns + round(delay * 1e9) if usable else 0
            name, counter = int(detections.sensor_id[row]), int(detections.counter[row])
            if not usable or at > t_ns + _AHEAD_NS:
                self.counts.invalid += 1
            elif self._counter.get(name) == counter:
                self.counts.repeated_sensors += 1
            elif at <= self._t_ns:
                self.counts.late_sensors += 1
            elif len(parts) == self._sensors:
                self.counts.overflow += 1
            else:
                self._counter[name] = counter
                parts.append((at, row))
        if not parts:
            self.counts.late_scans += 1
        return sorted(parts)

    def _collect(self, detections: DetectionScan, parts: list[tuple[int, int]]) -> int:
        """Copy these lidars' possible detections to the first n rows; returns n."""
        rows = [row for _, row in parts]
        n = 0
        for i in range(detections.n):
            row = int(detections.sensor[i])
            if row not in rows:
                continue
            distance, bearing = detections.z[i, RANGE], detections.z[i, BEARING]
            if not (0.0 <= distance <= _MAX_RANGE and abs(bearing) <= 2.0 * math.pi):
                self.counts.invalid += 1
                continue
            if n == self._capacity:
                self.counts.overflow += 1
                continue
            pose = detections.pose[row]
            self._row[n] = row
            self._places[n] = pose[POSE_X], pose[POSE_Y]
            self._z[n] = distance, pose[POSE_HEADING] + bearing
            n += 1
        return n

    def _take(self, at: int, n: int) -> None:
        """Move the track on to the time ``at`` [ns] and correct it by n detections."""
        self._bury(at)
        before, self._t_ns = self._t_ns, at
        if not self.alive:
            if n:
                self._begin(at, n)
            return
        seconds = (at - before) * 1e-9
        ok = ukf.advance_(self._parameters, self.track, self._scratch, seconds)
        if ok and n:
            n = self._choose(n)
            if n:
                ok = ukf.update_(
                    self._parameters,
                    self.track,
                    self._scratch,
                    n,
                    self._places,
                    self._z,
                    self._r,
                    self._seen,
                    self._mean,
                    self._S,
                    self._C,
                )
        if not ok:
            self.counts.numeric_failures += 1
            self._end()
        elif n > 0:
            self.counts.detections += n
            self._measured_ns = at
            self._hits += n
            self._strange = 0
        elif self._strange > self.settings.max_outliers:
            self._end()

    def _begin(self, at: int, n: int) -> None:
        """Begin a track at the detection whose place is known best: the nearest."""
        k = int(np.argmin(self._z[:n, RANGE]))
        ukf.begin_(
            self._parameters,
            self.track,
            self._places[k],
            self._z[k],
            self._r[k],
            _BIRTH_SPEED**2,
        )
        self.alive = self._new = True
        self.counts.detections += 1
        self.counts.extra += n - 1
        self._measured_ns = at
        self._hits, self._strange = 1, 0

    def _choose(self, n: int) -> int:
        """Keep the likeliest detection of every lidar if it is likely at all; returns their number.

        The arrays' first rows hold them afterwards.
        """
        ok = ukf.gate_(
            self._parameters,
            self.track,
            self._scratch,
            n,
            self._places,
            self._z,
            self._r,
            self._d2,
            self._one,
            self._seen,
            self._mean,
        )
        best: dict[int, int] = {}
        for k in range(n):
            if not (ok and self._d2[k] <= self.settings.gate):
                self.counts.outliers += 1
                continue
            row = int(self._row[k])
            if row in best:
                self.counts.extra += 1
            if row not in best or self._d2[k] < self._d2[best[row]]:
                best[row] = k
        kept = sorted(best.values())
        for to, k in enumerate(kept):
            self._places[to] = self._places[k]
            self._z[to] = self._z[k]
        self._strange += not kept
        return len(kept)

    def _bury(self, t_ns: int) -> None:
        if self.alive and t_ns - self._measured_ns > self.settings.coast_s * 1e9:
            self.counts.resets += 1
            self._end()

    def _end(self) -> None:
        self.alive = False
        self.counts.deaths += self._new is False

    def _report(self) -> Scan:
        scan = self._scan
        scan.t_ns = self._t_ns
        scan.counter = (scan.counter + 1) % _COUNTER_MODULUS
        scan.n = int(self.alive and self._hits >= self.settings.confirm)
        if scan.n:
            scan.z[0] = self.track["mean"][:4]
            scan.std[0] = np.sqrt(np.diagonal(self.track["cov"])[:4])
            scan.new[0] = self._new
            self.counts.births += self._new
            self._new = False
        return scan


def _parameters(settings: RoadsideSettings) -> Any:
    """Check the settings and fill the record that the kernels read."""
    n = len(settings.models)
    if not 1 <= n <= ukf.MAX_MODELS:
        raise CanImmError(f"roadside tracker: 1 to {ukf.MAX_MODELS} models are possible, not {n}")
    for model in settings.models:
        if not (model.q > 0.0 and model.q_turn > 0.0 and model.turn[1] > 0.0):
            raise CanImmError(
                "roadside tracker: q, q_turn and the turn's deviation must be above 0"
            )
    if not (settings.range_std > 0.0 and settings.bearing_std > 0.0 and settings.gate > 0.0):
        raise CanImmError("roadside tracker: range_std, bearing_std and gate must be above 0")
    Pi = np.array(settings.transitions)
    if Pi.shape != (n, n) or not (np.all(Pi >= 0.0) and np.allclose(Pi.sum(axis=1), 1.0)):
        raise CanImmError(f"roadside tracker: transitions must be {n} rows of {n} that sum to 1")
    birth = np.array(settings.birth)
    if birth.shape != (n,) or not (np.all(birth > 0.0) and np.isclose(birth.sum(), 1.0)):
        raise CanImmError(f"roadside tracker: birth must be {n} probabilities that sum to 1")
    par = np.zeros(1, ukf.PARAMETERS_DTYPE)[0]
    par["n_models"] = n
    par["kind"][:n] = [model.kind for model in settings.models]
    par["q"][:n] = [model.q for model in settings.models]
    par["q_omega"][:n] = [model.q_turn for model in settings.models]
    par["entry_mean"][:n] = [model.turn[0] for model in settings.models]
    par["entry_var"][:n] = [model.turn[1] ** 2 for model in settings.models]
    par["mu0"][:n] = birth
    par["mu_floor"] = _MU_FLOOR
    par["step_s"] = _STEP_S
    generator = generator_from_matrix(Pi, settings.period_s)
    par["Pi"][:, :n, :n] = transition_table(generator, _STEP_S, ukf.MAX_STEPS)
    ukf.set_spread_(par, kappa=0.0)
    return par
