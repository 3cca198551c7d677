"""The detector: object slots around the estimator, and the order of operations of one step."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from can_imm.estimation import imm, layout
from can_imm.estimation.entry import entry_point
from can_imm.estimation.noise import noise_state
from can_imm.estimation.particles import N_COLUMNS, N_SCRATCH
from can_imm.manoeuvres import ModeBank
from can_imm.relations import MEMORY_DTYPE, relate_, shift_lanes_
from can_imm.reporting import extrapolate_all_, fill_reports_
from can_imm.road import RoadFrame
from can_imm.types import REPORT_DTYPE, CanImmError, FloatArray, IntArray, Scan

LARGEST = 1e6
"""A measured value, or standard deviation, beyond this is invalid; squares cannot overflow."""


@dataclass(slots=True)
class DetectorCounts:
    """What happened since the start; every scan and every measurement ends up in one place.

    Attributes:
        scans: scans that were used.
        late_scans: older than the last used one, or older than the table of elapsed steps reaches.
        repeated_scans: the last used one once more, by its time or by its counter.
        measurements: object measurements that updated a track or began one.
        outliers: measurements too far from anything the object could do; the track coasts.
        invalid: measurements that are no numbers, whose standard deviation is none, or without any
            valid component.
        numeric_failures: cycles that gave no finite result; the track starts anew.
        overflow: measurements for which no slot was free.
        duplicates: second and later measurements of one id in one scan.
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
    births: int = 0
    deaths: int = 0
    reused_ids: int = 0


class Detector:
    """Runs the constrained IMM for every object; one call per step of the loop.

    Everything is allocated and compiled here, before the clock starts.

    Attributes:
        reports: (capacity,) of `REPORT_DTYPE`; the first n rows, n as returned by `step`, are what
            is said after a scan, in the order of the slots.
        predicted: (capacity,) of `REPORT_DTYPE`: `predict` writes the first `n_tracked` rows.
        counts: `DetectorCounts`.
        n_tracked: number of objects tracked now.

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
        self._slot_of: dict[int, int] = {}
        self._free = list(range(capacity - 1, -1, -1))
        # per row of a scan; a scan may hold more rows than there are slots
        self._slot: IntArray = np.zeros(0, np.int32)
        self._steps: IntArray = np.zeros(0, np.int32)
        self._status = np.zeros(0, np.int8)
        self._z: FloatArray = np.zeros((0, 4))
        self._r: FloatArray = np.zeros((0, 4))
        self._angle: FloatArray = np.zeros(0)
        # what lies between objects and between scans
        self._memory = np.zeros(capacity, MEMORY_DTYPE)
        self._road = None if bank.road is None else RoadFrame(bank.road)
        self._ego_speed = np.nan
        self._last_t_ns = -1
        self._last_counter = -1
        self._warm_up()

    @property
    def n_tracked(self) -> int:
        """Number of objects tracked now."""
        return len(self._slot_of)

    def _grow_rows(self, n: int) -> None:
        """Room for scans of up to n rows; happens once, for the first scan of a decoder."""
        if len(self._slot) < n:
            self._slot = np.zeros(n, np.int32)
            self._steps = np.zeros(n, np.int32)
            self._status = np.zeros(n, np.int8)
            self._z = np.zeros((n, 4))
            self._r = np.zeros((n, 4))
            self._angle = np.zeros(n)

    def _warm_up(self) -> None:
        """Compile, or load from the cache, every kernel that `step` and `predict` call."""
        scan = Scan(1)
        self._grow_rows(self.capacity)
        self._slot[0] = -1
        relate_(self._id, self._memory, self.reports, 0)
        shift_lanes_(self._memory, 0)
        arguments = self._arguments(scan, 1, 0.0)
        self._process = entry_point(imm.process_scan_, *arguments)
        self._process(*arguments)
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
            if self._slot_of:
                self._bury(now)
            return 0
        self._grow_rows(scan.n)
        n = scan.n
        self._measured[:] = False
        self._assign(scan, now)
        self._take_measurements(scan)
        if self._road is not None:
            self._road.move(scan)
            self._road.localise_(scan, self._z, self._r)
        self._process(*self._arguments(scan, n, (t_ns - scan.t_ns) * 1e-9))
        self._settle(scan, now)
        if self._road is not None:
            moved = self._road.watch_(
                self.bank, self._objects, scan, self._slot, self._status, self._age
            )
            if moved:
                shift_lanes_(self._memory, moved)
        self._bury(now)
        return self._report(t_ns, now)

    def _take_measurements(self, scan: Scan) -> None:
        """Values, variances and axes of the scan, in buffers of our own."""
        n = scan.n
        self._z[:n] = scan.z[:n]
        self._angle[:n] = scan.angle[:n]
        np.clip(scan.std[:n], 0.0, LARGEST, out=self._r[:n])
        np.square(self._r[:n], out=self._r[:n])
        if self.bank.measurement_variance is not None:
            self._r[:n] = self.bank.measurement_variance
        self._ego_speed = scan.ego_speed

    def predict(self, t_ns: int) -> int:
        """Extrapolate every tracked object to the step at ``t_ns`` into `predicted`.

        Returns:
            The number of rows written, `n_tracked`.
        """
        n = self._extrapolate(t_ns)
        if self._road is not None:
            self._road.globalise_(self.predicted, n)
        return n

    def _extrapolate(self, t_ns: int) -> int:
        """Like `predict`, in the axes of the road."""
        return int(
            extrapolate_all_(
                self._objects,
                self._id,
                self._age,
                self._updated,
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

    def _assign(self, scan: Scan, now: int) -> None:
        """Give every row of the scan its slot (-1: none) and the steps since its last update."""
        seen: set[int] = set()
        std = scan.std[: scan.n]
        valid = scan.valid[: scan.n]
        usable = (np.abs(scan.z[: scan.n]) < LARGEST) & (std > 0.0) & (std < LARGEST) & valid
        # usable where it counts, and in one component at least
        sound = ((usable == valid).all(1) & usable.any(1)).tolist()
        new = scan.new[: scan.n].tolist()
        self._slot[: scan.n] = -1
        for k, name in enumerate(scan.ids[: scan.n].tolist()):
            if name in seen:
                self.counts.duplicates += 1
                continue
            seen.add(name)
            if not sound[k]:
                self.counts.invalid += 1
                continue
            slot = self._slot_of.get(name)
            if slot is not None and new[k]:
                self.counts.reused_ids += 1
                self._end(name)
                slot = None
            elif slot is not None and now - self._updated[slot] > self._coast_steps:
                self._end(name)
                slot = None
            if slot is None:
                if not self._free:
                    self.counts.overflow += 1
                    continue
                slot = self._free.pop()
                self._slot_of[name] = slot
                self._id[slot] = name
                self._age[slot] = 0
                self._outliers[slot] = 0
                self.counts.births += 1
            self._slot[k] = slot
            self._steps[k] = -1 if self._age[slot] == 0 else now - self._updated[slot]

    def _arguments(self, scan: Scan, n: int, age: float) -> tuple[Any, ...]:
        """Of `imm.process_scan_`."""
        return (
            self.bank.record,
            self._objects,
            self._work,
            n,
            self._slot,
            self._steps,
            self._z,
            self._r,
            scan.valid,
            self._angle,
            layout.UNKNOWN_GROUND if math.isnan(scan.ego_speed) else -scan.ego_speed,
            0.0 if self._road is None else self._road.width,
            age,
            self._gate,
            self._particles,
            self._spare,
            self._weights,
            self._noise,
            self._status,
        )

    def _settle(self, scan: Scan, now: int) -> None:
        """Act on what became of every measurement."""
        slots, states = self._slot[: scan.n].tolist(), self._status[: scan.n].tolist()
        for slot, status in zip(slots, states, strict=True):
            if slot < 0:
                continue
            if status == imm.OK:
                self.counts.measurements += 1
                self._updated[slot] = now
                self._age[slot] += 1
                self._outliers[slot] = 0
                self._measured[slot] = True
                continue
            if status == imm.OUTLIER:
                self.counts.outliers += 1
                self._outliers[slot] += 1
                if self._outliers[slot] < self._max_outliers:
                    continue
                self.counts.reused_ids += 1
            else:
                self.counts.numeric_failures += 1
            # The id's next measurement begins a new track.
            self._end(int(self._id[slot]))

    def _end(self, name: int) -> None:
        slot = self._slot_of.pop(name)
        self._id[slot] = -1
        self._free.append(slot)
        self.counts.deaths += 1

    def _bury(self, now: int) -> None:
        """End the tracks that coasted for too long."""
        updated = self._updated.tolist()
        for name, slot in list(self._slot_of.items()):
            if now - updated[slot] > self._coast_steps:
                self._end(name)

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

    def _report(self, t_ns: int, now: int) -> int:
        """Reports of all tracks; coasting ones are extrapolated."""
        n: int = self._fill(*self._report_arguments(t_ns))
        coasting = self.reports["coasting"]
        if coasting[:n].any():
            self._extrapolate(now * self._step_ns)
            for k in np.flatnonzero(coasting[:n]):
                self.reports[k] = self.predicted[k]
                self.reports["t_ns"][k] = t_ns
        if self._road is not None:
            relate_(self._id, self._memory, self.reports, n)
            self._road.globalise_(self.reports, n)
        return n
