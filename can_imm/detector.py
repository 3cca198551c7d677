"""The detector: object slots around the estimator, and the order of operations of one step."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from can_imm.estimation import layout
from can_imm.estimation.entry import Processor, entry_point
from can_imm.estimation.noise import noise_state
from can_imm.estimation.particles import N_COLUMNS, N_SCRATCH
from can_imm.estimation.tracks import TALLY, assign_, bury_, settle_, straighten_
from can_imm.manoeuvres import ModeBank
from can_imm.relations import MEMORY_DTYPE, hesitate_, relate_, shift_lanes_
from can_imm.reporting import extrapolate_all_, fill_reports_
from can_imm.road import RoadFrame
from can_imm.types import REPORT_DTYPE, BoolArray, CanImmError, FloatArray, IntArray, Scan

FASTEST, SHARPEST = 150.0, 5.0
"""No vehicle drives [m/s] or turns [rad/s] faster: a bus that says so does not know."""


def possible(value: float, most: float) -> float:
    """The value, or NaN (unknown) if it is larger than ``most`` in either direction."""
    return value if abs(value) <= most else math.nan


@dataclass(slots=True)
class DetectorCounts:
    """What happened since the start; every scan and every measurement ends up in one place.

    Attributes:
        scans: scans that were used.
        late_scans: older than the last used one, or older than the table of elapsed steps reaches.
        repeated_scans: the last used one once more, by its time or by its counter.
        measurements: object measurements that updated a track or began one.
        outliers: measurements too far from anything the object could do; the track coasts.
        invalid: measurements that are no numbers, whose standard deviation or angle is none, or
            without any valid component.
        numeric_failures: cycles that gave no finite result; the track starts anew.
        overflow: measurements for which no slot was free.
        duplicates: second and later measurements of one id in one scan.
        ego_invalid: scans whose speed or yaw rate of the ego no vehicle has; taken as unknown.
        births, deaths: tracks begun and ended.
        reused_ids: births because the sensor said that an id names another object, or because a
            track was an outlier for too long.
    """

    scans: int = 0
    late_scans: int = 0
    repeated_scans: int = 0
    measurements: int = 0
    outliers: int = 0
    invalid: int = 0
    numeric_failures: int = 0
    overflow: int = 0
    duplicates: int = 0
    ego_invalid: int = 0
    births: int = 0
    deaths: int = 0
    reused_ids: int = 0


class History(Protocol):
    """Who writes down what the detector thinks of its tracks; see `smoothing`."""

    def scan(
        self,
        now: int,
        objects: Any,
        ids: IntArray,
        measured: BoolArray,
        reports: np.ndarray[Any, np.dtype[np.void]],
        road: RoadFrame | None,
        moved: int,
        scan: Scan,
        slot: IntArray,
    ) -> None:
        """A scan was used; all arrays are the detector's own and change with the next one.

        Args:
            now: number of the step.
            objects: (capacity,) of `layout.OBJECT_DTYPE`.
            ids: (capacity,) object id of each slot, -1 for a free one.
            measured: (capacity,) the slot was updated by this scan.
            reports: (n,) of the slots in use, in their order, in the road's axes and unrelated.
            road: as it is after the scan, None without a road.
            moved: lanes that the ego has moved to the left since the last scan.
            scan: what was measured.
            slot: (N,) slot of each of the scan's rows, -1 for none.
        """

    def end(self, slot: int) -> None:
        """The track in this slot ended; another one may begin there."""


class Detector:
    """Runs the constrained IMM for every object; one call per step of the loop.

    Everything is allocated and compiled here, before the clock starts.

    Attributes:
        reports: (capacity,) of `REPORT_DTYPE`; the first n rows, n as returned by `step`, are what
            is said after a scan, in the order of the slots.
        predicted: (capacity,) of `REPORT_DTYPE`: `predict` writes the first `n_tracked` rows.
        counts: `DetectorCounts`.
        n_tracked: number of objects tracked now.
        history: is told of every scan and of every track's end; None: nobody is.

    Args:
        bank: mode bank; its step is the loop's.
        capacity: object slots.
        seed: of the particles' random numbers.
        coast_s: a track that was not measured for longer than this ends [s].
        gate: a measurement is an outlier if its squared distance from what is possible
            (`imm.surprise`) is larger; chi-square with 4 degrees of freedom.
        max_outliers: after so many outliers in a row the id is taken to name another object.
    """

    def __init__(
        self,
        bank: ModeBank,
        *,
        capacity: int = 64,
        seed: int = 0,
        coast_s: float = 0.5,
        gate: float = 25.0,
        max_outliers: int = 3,
    ) -> None:
        if capacity < 1:
            raise CanImmError(f"the detector needs at least one object slot, not {capacity}")
        self.bank = bank
        self.capacity = capacity
        self.counts = DetectorCounts()
        self.history: History | None = None
        self.reports: np.ndarray[Any, np.dtype[np.void]] = np.zeros(capacity, REPORT_DTYPE)
        self.predicted: np.ndarray[Any, np.dtype[np.void]] = np.zeros(capacity, REPORT_DTYPE)
        self._step_ns = bank.step_ns
        self._coast_steps = min(int(coast_s * 1e9) // bank.step_ns, layout.MAX_STEPS - 1)
        self._gate = float(gate)
        self._max_outliers = max_outliers
        self._noise = noise_state(np.random.default_rng(seed))
        self._objects = np.zeros(capacity, layout.OBJECT_DTYPE)
        self._work = np.zeros(1, layout.WORK_DTYPE)
        self._particles: FloatArray = np.zeros((capacity, N_COLUMNS, bank.n_particles))
        self._spare: FloatArray = np.zeros((N_SCRATCH, bank.n_particles))
        self._weights: FloatArray = np.zeros(bank.n_particles)
        # per slot
        self._id: IntArray = np.full(capacity, -1, np.int32)
        self._updated = np.zeros(capacity, np.int64)  # step number of the last measurement
        self._age: IntArray = np.zeros(capacity, np.int32)
        self._outliers: IntArray = np.zeros(capacity, np.int32)
        self._measured = np.zeros(capacity, np.bool_)
        self._nobody = np.zeros(capacity, np.bool_)
        # the free slots, and those set free in a step: by an id's reuse, a failure and by coasting
        self._free: IntArray = np.zeros(4 * capacity, np.int32)
        self._free[:capacity] = range(capacity - 1, -1, -1)
        self._n_free = np.array([capacity, 0])
        self._tally = np.zeros(len(TALLY), np.int64)
        self._next_burial = 0
        variance = bank.measurement_variance
        self._variance: FloatArray = np.zeros(0) if variance is None else variance
        # per row of a scan; a scan may hold more rows than there are slots
        self._slot: IntArray = np.zeros(0, np.int32)
        self._steps: IntArray = np.zeros(0, np.int32)
        self._status = np.zeros(0, np.int8)
        self._z: FloatArray = np.zeros((0, 4))
        self._r: FloatArray = np.zeros((0, 4))
        self._valid: BoolArray = np.zeros((0, 4), np.bool_)
        self._angle: FloatArray = np.zeros(0)
        # what lies between objects and between scans
        self._memory = np.zeros(capacity, MEMORY_DTYPE)
        self._road = None if bank.road is None else RoadFrame(bank.road)
        self._ego_speed = math.nan
        self._ego_yaw_rate = math.nan
        self._last_t_ns = -1
        self._last_counter = -1
        self._warm_up()

    @property
    def n_tracked(self) -> int:
        """Number of objects tracked now."""
        return self.capacity - int(self._n_free[0])

    @property
    def road(self) -> RoadFrame | None:
        """The axes of the road, None with a bank that has none."""
        return self._road

    def _grow_rows(self, n: int) -> None:
        """Room for scans of up to n rows; happens once, for the first scan of a decoder."""
        if len(self._slot) < n:
            self._slot = np.zeros(n, np.int32)
            self._steps = np.zeros(n, np.int32)
            self._status = np.zeros(n, np.int8)
            self._z = np.zeros((n, 4))
            self._r = np.zeros((n, 4))
            self._valid = np.zeros((n, 4), np.bool_)
            self._angle = np.zeros(n)
            self._processor = self._pack()

    def _warm_up(self) -> None:
        """Compile, or load from the cache, every kernel that `step` and `predict` call."""
        scan = Scan(1)
        self._grow_rows(self.capacity)
        if self._road is not None:
            self._road.warm_up(
                self.bank, self._objects, self._slot, self._status, self._age,
                self._id, self.reports,
            )  # fmt: skip
        hesitate_(self._id, self._memory, 0.5, self.reports, 0)
        relate_(self._id, self._memory, self.reports, 0)
        shift_lanes_(self._memory, 0)
        self._processor.run(self._processor.address, 0, 0.0, 0.0, 0.0)
        arguments = self._assign_arguments(scan, 0, 0)
        self._assign = entry_point(assign_, *arguments)
        self._assign(*arguments)
        straighten_(*self._straighten_arguments(0))
        arguments = self._settle_arguments(0, 0)
        self._settle = entry_point(settle_, *arguments)
        self._settle(*arguments)
        self._bury(0)
        arguments = self._report_arguments(0)
        self._fill = entry_point(fill_reports_, *arguments)
        self._fill(*arguments)
        self.predict(0)

    def step(self, t_ns: int, scan: Scan | None) -> int:
        """One step of the loop.

        Args:
            t_ns: time of the step [ns], a multiple of the step time.
            scan: what the sensor finished since the last step, or None.  Its time may lie before
                ``t_ns`` by its age; it is not kept.

        Returns:
            The number n of rows of `reports` that were written: all tracked objects after a scan
            that was used, else 0.
        """
        now = t_ns // self._step_ns
        if scan is None or not self._accept(t_ns, scan):
            if now >= self._next_burial:
                self._bury(now)
            return 0
        self._grow_rows(scan.n)
        n = scan.n
        self._assign(*self._assign_arguments(scan, n, now))
        if self.bank.n_particles:
            straighten_(*self._straighten_arguments(n))
        self._hear_ego(scan)
        if self._road is not None:
            self._road.move(scan.t_ns, self._ego_speed, self._ego_yaw_rate)
            self._road.localise_(scan, self._z, self._r)
        self._processor.run(
            self._processor.address,
            n,
            layout.UNKNOWN_GROUND if math.isnan(self._ego_speed) else -self._ego_speed,
            0.0 if self._road is None else self._road.width,
            (t_ns - scan.t_ns) * 1e-9,
        )
        self._settle(*self._settle_arguments(n, now))
        moved = 0
        if self._road is not None:
            moved = self._road.watch_(
                self.bank, self._objects, scan, self._slot, self._status, self._age
            )
            if moved:
                shift_lanes_(self._memory, moved)
        self._bury(now)
        return self._report(t_ns, now, moved, scan)

    def _hear_ego(self, scan: Scan) -> None:
        """Take over the ego's motion, where the bus tells one that is possible."""
        self._ego_speed = possible(scan.ego_speed, FASTEST)
        self._ego_yaw_rate = possible(scan.ego_yaw_rate, SHARPEST)
        told = math.isnan(scan.ego_speed), math.isnan(scan.ego_yaw_rate)
        if told != (math.isnan(self._ego_speed), math.isnan(self._ego_yaw_rate)):
            self.counts.ego_invalid += 1

    def understudy(self) -> Detector:
        """A small detector like this one, for `runtime.nodes.DetectorNode.rehearse`."""
        return Detector(self.bank, capacity=2)

    def predict(self, t_ns: int) -> int:
        """Extrapolate every tracked object to the step at ``t_ns`` into `predicted`.

        Returns:
            The number of rows written, `n_tracked`.
        """
        n = self._extrapolate(t_ns, self._nobody)
        if self._road is not None:
            self._road.globalise_(self.predicted, n)
        return n

    def _extrapolate(self, t_ns: int, spared: BoolArray) -> int:
        """Like `predict`, in the axes of the road; rows of slots (capacity,) that are spared stay
        as they are."""
        return int(
            extrapolate_all_(
                self._objects,
                self._id,
                self._age,
                self._updated,
                spared,
                self.bank.record,
                self._work,
                t_ns,
                t_ns // self._step_ns,
                self.predicted,
            )
        )

    def _accept(self, t_ns: int, scan: Scan) -> bool:
        """Late and repeated scans are counted and not used: a filter cannot go back in time."""
        if self._last_t_ns >= 0:
            # A counter that stands still means old data; after a long silence it means nothing.
            recent = scan.t_ns - self._last_t_ns <= self._coast_steps * self._step_ns
            same = scan.counter == self._last_counter
            if same and (scan.t_ns == self._last_t_ns or (scan.counter >= 0 and recent)):
                self.counts.repeated_scans += 1
                return False
            if scan.t_ns <= self._last_t_ns:
                self.counts.late_scans += 1
                return False
        if t_ns - scan.t_ns >= self._coast_steps * self._step_ns:
            self.counts.late_scans += 1
            return False
        self._last_t_ns, self._last_counter = scan.t_ns, scan.counter
        self.counts.scans += 1
        return True

    def _pack(self) -> Processor:
        """The kernel and the addresses of what it works on."""
        return Processor(
            self._gate,
            bank=self.bank.record,
            objects=self._objects,
            work=self._work,
            slot=self._slot,
            steps=self._steps,
            z=self._z,
            r=self._r,
            valid=self._valid,
            angle=self._angle,
            particles=self._particles,
            spare=self._spare,
            weights=self._weights,
            noise=self._noise,
            status=self._status,
        )

    def _assign_arguments(self, scan: Scan, n: int, now: int) -> tuple[Any, ...]:
        """Of `tracks.assign_`."""
        return (
            n, now, self._coast_steps, scan.ids, scan.new, scan.z, scan.std, scan.valid, scan.angle,
            self._variance, self._slot, self._steps, self._z, self._r, self._valid, self._angle,
            self._id, self._updated, self._age, self._outliers, self._measured, self._free,
            self._n_free, self._tally,
        )  # fmt: skip

    def _straighten_arguments(self, n: int) -> tuple[Any, ...]:
        """Of `tracks.straighten_`."""
        return n, self._slot, self._z, self._r, self._valid, self._angle, not len(self._variance)

    def _settle_arguments(self, n: int, now: int) -> tuple[Any, ...]:
        """Of `tracks.settle_`."""
        return (
            n, now, self._max_outliers, self._slot, self._status, self._id, self._updated,
            self._age, self._outliers, self._measured, self._free, self._n_free, self._tally,
        )  # fmt: skip

    def _bury(self, now: int) -> None:
        """End the tracks that coasted for too long."""
        self._next_burial = bury_(
            now, self._coast_steps, self._id, self._updated, self._free, self._n_free, self._tally
        )
        self._count()

    def _count(self) -> None:
        """Add what the kernels counted."""
        for name, number in zip(TALLY, self._tally.tolist(), strict=True):
            if number:
                setattr(self.counts, name, getattr(self.counts, name) + number)
        self._tally[:] = 0
        if self.history is not None:
            for slot in self._free[self.capacity :][: self._n_free[1]].tolist():
                self.history.end(slot)
        self._n_free[1] = 0

    def _report_arguments(self, t_ns: int) -> tuple[Any, ...]:
        """Of `fill_reports_`."""
        return (
            self._objects,
            self._id,
            self._age,
            self._measured,
            self.bank.record,
            t_ns,
            self.reports,
        )

    def _report(self, t_ns: int, now: int, moved: int, scan: Scan) -> int:
        """Reports of all tracks; coasting ones are extrapolated."""
        n: int = self._fill(*self._report_arguments(t_ns))
        coasting = self.reports["coasting"]
        if coasting[:n].any():
            self._extrapolate(now * self._step_ns, self._measured)
            for k in np.flatnonzero(coasting[:n]):
                self.reports[k] = self.predicted[k]
                self.reports["t_ns"][k] = t_ns
        if self.history is not None:
            self.history.scan(
                now, self._objects, self._id, self._measured, self.reports[:n],
                self._road, moved, scan, self._slot,
            )  # fmt: skip
        if self._road is not None:
            self._road.judge_(self._id, self.reports, scan.t_ns)
            hesitate_(self._id, self._memory, self._road.false_change, self.reports, n)
            relate_(self._id, self._memory, self.reports, n)
            self._road.globalise_(self.reports, n)
        return n
