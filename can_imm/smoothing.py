"""Smoothed reports: what the detector would have said had it known what came afterwards.

A smoother is a detector's ``history``: it writes down every track's modes after every scan, and
goes back over them later.  What it says comes out of `due`, in the order of time.

    smoother = FixedLagSmoother(bank, lag_s=0.5)
    detector.history = smoother
    for ...:
        detector.step(t_ns, scan)
        for scan_t_ns, reports in smoother.due(t_ns):
            ...
    for scan_t_ns, reports in smoother.finish():
        ...

A row of a track is a scan in which it was reported.  A row in which it was not measured has no
modes of its own; what is said of it lies between its neighbours, or is what the detector said if no
later measurement came.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from can_imm.estimation.entry import entry_point
from can_imm.estimation.road import N_ROAD, P_FALSE_CHANGE, P_SETTLE
from can_imm.estimation.smoother import smooth_
from can_imm.estimation.smoother_pairs import SMOOTHER_DTYPE
from can_imm.hindsight import LOOK_AHEAD_S, Hindsight
from can_imm.manoeuvres import ModeBank
from can_imm.relations import MEMORY_DTYPE, hesitate_, relate_, shift_lanes_
from can_imm.reporting import globalise_, judge_changes_, judge_ramps_
from can_imm.road import RoadFrame
from can_imm.smoothing_rows import COASTING, FIRST, Reports, Rows, conclude_rows_, measurements
from can_imm.types import REPORT_DTYPE, BoolArray, CanImmError, FloatArray, IntArray, Scan, Y

TRUST = 0.3
"""How far the modes are taken at their word about where one ends and the next one begins, see
`smoother.smooth_`.  True modes ask for 1.  Random scenarios with seeds below 1000 and the preset
two-lane have 1.9 % of frames wrong with 1, 1.7 % with 0 and 1.6 % with 0.15 to 0.45."""

BLOCK, OVERLAP = 1024, 256
"""A track is smoothed in blocks of so many scans; what is said of the last ones of a block waits
for the next block, so that they, too, know what came afterwards."""

CONTEXT = 128
"""So many scans of what was said are still looked at for the labels of the next block."""


class _Track:
    """One track.

    Attributes:
        rows: its rows without the first ``base`` ones, which are forgotten.
        told: the first of them of which nothing was said yet.
        last: number of the step of the last measurement, -1 before the first.
        said: number of rows that have been said.
        ended: nothing will be added.
        out: smoothed reports that wait to be said.
    """

    def __init__(self, rows: Rows) -> None:
        rows.n = 0
        self.rows = rows
        self.base = 0
        self.told = 0
        self.last = -1
        self.said = 0
        self.ended = False
        self.out: Reports = np.zeros(0, REPORT_DTYPE)


@dataclass
class _Scan:
    """A scan of which nothing has been said yet.

    Attributes:
        now, t: number of the step, and its time [s].
        tracks, slots, rows: the reports' tracks, their slots and their rows counted from the
            tracks' first.
        moved: lanes that the ego moved to the left.
        road: state of the road, None without one.
        ego_speed, acceleration: of the ego [m/s, m/s²], NaN where unknown.
        changes: (n, 2) for `reporting.judge_changes_`.
    """

    now: int
    t: float
    tracks: list[_Track]
    slots: list[int]
    rows: list[int]
    moved: int
    road: FloatArray | None = None
    ego_speed: float = math.nan
    acceleration: float = math.nan
    changes: FloatArray = field(default_factory=lambda: np.zeros((0, 2)))


class _Smoother:
    """What the two smoothers have in common: writing down, going back over one track, and making
    reports of several tracks those of a scan."""

    def __init__(self, bank: ModeBank) -> None:
        self._bank = bank.record
        self._step_ns = bank.step_ns
        self._shape = len(bank.modes), bank.n_states
        self._tracks: dict[int, _Track] = {}
        self._free: list[Rows] = []
        self._pending: deque[_Scan] = deque()
        self._shift = 0.0
        self._hindsight: Hindsight | None = None
        # parameters of the road, where lane changes are said as the detector does
        self._road: FloatArray | None = None
        self._work = np.zeros(1, SMOOTHER_DTYPE)
        self._out: Reports = np.zeros(64, REPORT_DTYPE)
        # for the relations between the reports of a scan
        self._ids: IntArray = np.zeros(0, np.int32)
        self._row_of = np.zeros(0, np.int64)
        self._memory = np.zeros(0, MEMORY_DTYPE)
        self._h: FloatArray = np.zeros(N_ROAD + 1)
        rows = self._take_rows()
        self._smooth = entry_point(smooth_, *self._smooth_arguments(rows, 0))
        arguments = self._conclude_arguments(rows, 0, 0, rows.said)
        self._conclude = entry_point(conclude_rows_, *arguments)
        relate_(self._ids, self._memory, self._out, 0)
        shift_lanes_(self._memory, 0)
        globalise_(self._h, self._h, self._out, 0, 0.0)
        self._free.append(rows)

    def scan(
        self,
        now: int,
        objects: Any,
        ids: IntArray,
        measured: BoolArray,
        reports: Reports,
        road: RoadFrame | None,
        moved: int,
        scan: Scan,
        slot: IntArray,
    ) -> None:
        """Write a scan down; see `detector.History`."""
        number = 0
        noted = _Scan(now, scan.t_ns * 1e-9, [], np.flatnonzero(ids >= 0).tolist(), [], moved)
        if road is not None:
            # the filter's lane 0 is now another one
            self._shift += moved * road.width
            noted.road = road.x.copy()
            noted.ego_speed, noted.acceleration = road.speed, road.acceleration
            if self._hindsight is not None:
                number = self._hindsight.add(now, road, self._shift)
        self._grow_slots(len(ids))
        rows_of_slots = np.flatnonzero(slot[: scan.n] >= 0)
        self._row_of[slot[rows_of_slots]] = rows_of_slots
        z, r = measurements(scan)
        n_modes, n = self._shape
        x, P = objects["x"][:, :n_modes, :n], objects["P"][:, :n_modes, :n, :n]
        mu, Pi = objects["mu"][:, :n_modes], objects["Pi"][:, :n_modes, :n_modes]
        width = objects["lane_width"]
        for row, place in enumerate(noted.slots):
            track = self._tracks.get(place)
            if track is None:
                self._tracks[place] = track = _Track(self._take_rows())
            rows = track.rows
            k = rows.n
            noted.tracks.append(track)
            noted.rows.append(track.base + k)
            if k == len(rows.steps):
                rows.grow()
            rows.n = k + 1
            rows.now[k] = now
            rows.said[k] = reports[row]
            rows.width[k], rows.shift[k] = width[place], self._shift
            rows.scan[k] = number
            if not measured[place]:
                rows.steps[k] = COASTING
                continue
            rows.steps[k] = now - track.last if track.last >= 0 else FIRST
            track.last = now
            rows.x[k], rows.P[k] = x[place], P[place]
            rows.mu[k], rows.Pi[k] = mu[place], Pi[place]
            rows.z[k], rows.r[k] = z[self._row_of[place]], r[self._row_of[place]]
            if self._shift != 0.0:
                rows.x[k, :, Y] += self._shift
        self._pending.append(noted)
        self._noted(noted, road)

    def _noted(self, scan: _Scan, road: RoadFrame | None) -> None:
        """A scan has been written down: it is the last of the pending ones."""

    def _take_rows(self) -> Rows:
        return self._free.pop() if self._free else Rows(64, *self._shape)

    def _grow_slots(self, capacity: int) -> None:
        """Room for a detector's slots; happens once, in the first scan."""
        if len(self._ids) < capacity:
            self._ids = np.full(capacity, -1, np.int32)
            self._row_of = np.zeros(capacity, np.int64)
            self._memory = np.zeros(capacity, MEMORY_DTYPE)
            self._out = np.zeros(capacity, REPORT_DTYPE)

    def _smooth_arguments(self, rows: Rows, first: int) -> tuple[Any, ...]:
        """Of `smooth_`."""
        return (
            self._bank, first, rows.n, rows.x, rows.P, rows.mu, rows.Pi, rows.steps, float(TRUST),
            rows.mean, rows.cov, rows.p, self._work,
        )  # fmt: skip

    def _conclude_arguments(
        self, rows: Rows, first: int, last: int, out: Reports
    ) -> tuple[Any, ...]:
        """Of `conclude_rows_`."""
        return (
            self._bank, first, last, rows.n, rows.now, rows.steps, rows.width, rows.shift,
            rows.said, rows.mean, rows.cov, rows.p, out,
        )  # fmt: skip

    def _go_back(self, rows: Rows, first: int, last: int, out: Reports) -> None:
        """Smoothed reports of the rows first .. last - 1 into ``out``, in the road's axes."""
        self._smooth(*self._smooth_arguments(rows, rows.measured_before(first)))
        self._conclude(*self._conclude_arguments(rows, first, last, out))

    def _relate(self, scan: _Scan, reports: Reports) -> tuple[int, Reports]:
        """Do what the detector does when it has the reports of all objects."""
        n = len(reports)
        if scan.road is not None:
            if scan.moved:
                shift_lanes_(self._memory, scan.moved)
            self._ids[:] = -1
            self._ids[scan.slots] = reports["object_id"]
            if self._road is not None:
                judge_changes_(scan.changes, reports, n)
                if not math.isnan(scan.acceleration):
                    judge_ramps_(scan.acceleration, reports, n)
                hesitate_(self._ids, self._memory, self._road[P_FALSE_CHANGE], reports, n)
            relate_(self._ids, self._memory, reports, n)
            globalise_(scan.road, self._h, reports, n, scan.ego_speed)
        return scan.now * self._step_ns, reports


class FixedIntervalSmoother(_Smoother):
    """Smooths every track over its whole life; for recordings.

    With a bank that has a road, the labels are those of `hindsight`, which knows where the ego went
    on that road afterwards.

    While a track lives its modes are kept, 8 (M + n^2 + n + 1) M bytes per scan (6 kB with M = 16
    modes of n = 5 states), of `BLOCK` scans at most; then, and at its end, it is smoothed, and its
    reports are kept, 400 bytes each, until those of all other objects in the same scans are there.

    Args:
        bank: the detector's.
    """

    def __init__(self, bank: ModeBank) -> None:
        super().__init__(bank)
        if bank.road is not None:
            self._hindsight = Hindsight(bank.record, bank.road)
        self._now = 0
        self._look_ahead = int(LOOK_AHEAD_S * 1e9) // bank.step_ns
        self._ended: deque[tuple[int, _Track]] = deque()

    def _noted(self, scan: _Scan, road: RoadFrame | None) -> None:
        self._now = scan.now
        for track in scan.tracks:
            if track.rows.n >= track.told + BLOCK:
                last = track.told + BLOCK - OVERLAP
                self._release(track, track.rows.measured_before(last))
        while self._ended and self._ended[0][0] <= self._now:
            self._release_ended()
        if self._hindsight is not None:
            tracks = [*self._tracks.values(), *(track for _, track in self._ended)]
            if tracks:
                self._hindsight.forget(min(int(track.rows.scan[0]) for track in tracks))

    def end(self, slot: int) -> None:
        """Smooth the track that ended in this slot, as soon as the road there is known."""
        track = self._tracks.pop(slot, None)
        if track is not None:
            self._ended.append((self._now + self._look_ahead, track))
            if self._hindsight is None:
                self._release_ended()

    def due(self, t_ns: int = 0) -> Iterator[tuple[int, Reports]]:
        """Give out the scans of which all is known, in the order of time.

        Yields:
            Time of the step that took the scan [ns], and its reports (n,) in the detector's order;
            the array holds good until the next one.
        """
        while self._pending and all(len(track.out) for track in self._pending[0].tracks):
            scan = self._pending.popleft()
            for k, track in enumerate(scan.tracks):
                self._out[k] = track.out[0]
                track.out = track.out[1:]
            yield self._relate(scan, self._out[: len(scan.tracks)])

    def finish(self) -> Iterator[tuple[int, Reports]]:
        """End all tracks and give out all that is left, as `due` does."""
        for slot in list(self._tracks):
            self.end(slot)
        if self._hindsight is not None:
            self._hindsight.look_ahead(track.rows for _, track in self._ended)
        while self._ended:
            self._release_ended()
        return self.due()

    def _release_ended(self) -> None:
        track = self._ended.popleft()[1]
        self._release(track, track.rows.n)
        self._free.append(track.rows)

    def _release(self, track: _Track, last: int) -> None:
        """Smooth a track; what is before its row ``last`` can be said."""
        rows = track.rows
        out = np.zeros(last - track.told, REPORT_DTYPE)
        self._go_back(rows, track.told, last, out)
        if self._hindsight is not None:
            self._hindsight.label_(rows, track.told, last, out)
        track.out = np.concatenate((track.out, out))
        forgotten = max(last - CONTEXT, 0) if self._hindsight is not None else last
        rows.drop(forgotten)
        track.told = last - forgotten


class FixedLagSmoother(_Smoother):
    """Says of each scan, ``lag_s`` later, what is known by then.

    Going back costs as many steps per object and scan as there are scans in the lag.

    Args:
        bank: the detector's.
        lag_s: [s], one step of the loop at least.

    Raises:
        CanImmError: the lag is none.
    """

    def __init__(self, bank: ModeBank, lag_s: float) -> None:
        self._lag = round(lag_s * 1e9) // bank.step_ns if 0.0 < lag_s < 1e6 else 0
        if self._lag < 1:
            raise CanImmError(f"the lag must be a step of the loop or longer, not {lag_s:g} s")
        super().__init__(bank)
        self._road = bank.road
        self._settle = math.inf if bank.road is None else float(bank.road[P_SETTLE])

    def _noted(self, scan: _Scan, road: RoadFrame | None) -> None:
        if road is None or self._road is None:
            return
        scan.changes = np.full((len(scan.slots), 2), np.nan)
        for earlier in reversed(self._pending):
            if round(scan.t - earlier.t, 9) > self._settle:  # times are whole nanoseconds
                break
            self._look_back(earlier, road)

    def end(self, slot: int) -> None:
        """The track in this slot ended; what is pending of it will still be said."""
        track = self._tracks.pop(slot, None)
        if track is None:
            return
        track.ended = True
        if track.said == track.base + track.rows.n:
            self._free.append(track.rows)

    def due(self, t_ns: int) -> Iterator[tuple[int, Reports]]:
        """Give out the scans that lie the lag back at the step of ``t_ns`` [ns].

        Yields:
            Time of the step that took the scan [ns], and its reports (n,) in the detector's order;
            the array holds good until the next one.
        """
        while self._pending and self._pending[0].now + self._lag <= t_ns // self._step_ns:
            yield self._say()

    def finish(self) -> Iterator[tuple[int, Reports]]:
        """Give out all that is left, as `due` does."""
        while self._pending:
            yield self._say()

    def _say(self) -> tuple[int, Reports]:
        scan = self._pending.popleft()
        for place, (track, row) in enumerate(zip(scan.tracks, scan.rows, strict=True)):
            rows, k = track.rows, row - track.base
            self._go_back(rows, k, k + 1, self._out[place : place + 1])
            track.said = row + 1
            if track.ended and k == rows.n - 1:
                self._free.append(rows)
                continue
            # the measured row before is needed where the next one coasts
            done = rows.measured_before(k)
            if 2 * done >= len(rows.steps):
                rows.drop(done)
                track.base += done
        n = len(scan.tracks)
        return self._relate(scan, self._out[:n])

    def _look_back(self, scan: _Scan, road: RoadFrame) -> None:
        """What is thought now of who was changing lanes in a scan, but for tracks that have ended;
        further back than it takes to settle that is forgotten."""
        known = road.changing(scan.t)[scan.slots]
        for k, track in enumerate(scan.tracks):
            if not track.ended and not math.isnan(known[k, 0]):
                scan.changes[k] = known[k]
