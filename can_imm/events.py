"""What happened in a recording: events out of the stream of the detector's reports."""

from __future__ import annotations

import math
from collections import Counter, deque
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy.typing as npt

from can_imm.types import CUT_IN, CUT_OUT, OVERTAKING_ANOTHER, VX, Manoeuvre, X

GAP_NS = 500_000_000
"""An event that is interrupted for no longer than this is one event [ns]."""

SHORTEST_NS = 300_000_000
"""An event that was said for less than this in all is left out [ns]."""

FLAG_SHARE = 0.25
"""A lane change is a cut-in or a cut-out if at least so much of its reports say so."""

EVENTS = (
    Manoeuvre.LANE_CHANGE,
    Manoeuvre.OVERTAKING,
    Manoeuvre.REAR_END,
    Manoeuvre.APPROACHING,
    Manoeuvre.RECEDING,
)
"""Manoeuvres that are events; to keep one's lane is none."""

COUNTED = (Manoeuvre.STATIONARY, Manoeuvre.ONCOMING)
"""Manoeuvres of which a roadside has hundreds: their objects are only counted."""

_FOLLOWED = frozenset(int(m) for m in EVENTS + COUNTED)
_ACROSS = frozenset({int(Manoeuvre.LANE_CHANGE), int(Manoeuvre.OVERTAKING)})
_PASSING = (int(Manoeuvre.OVERTAKING), 0)
"""Key of the stretches in which an object overtakes, by its manoeuvre or by its flag."""


@dataclass(frozen=True)
class Event:
    """A stretch in which an object does something.

    Attributes:
        from_ns, to_ns: times of its first and last report [ns]; of a lane change when it began and
            ended by what was known of it at last, if that was told.
        manoeuvre: value of `Manoeuvre`.  OVERTAKING may last across other events: where it is a
            flag on top of the manoeuvres it lasts as long as the flag.
        event: CUT_IN or CUT_OUT of a lane change, unless it was seen to come to nothing; OVERTAKING
            of an overtaking; otherwise empty.
        direction: of a lane change: 1 left, -1 right; 0 otherwise.
        probability: mean of the reports' probability.
        lane_from, lane_to: as the reports count lanes; across a lane change those before and after.
        gap, speed: x [m] and relative vx [m/s] at the start.
        min_gap: the smallest x [m].
        abs_speed: at the start [m/s], NaN where the ego's speed is unknown.
    """

    object_id: int
    manoeuvre: Manoeuvre
    event: str
    direction: int
    from_ns: int
    to_ns: int
    probability: float
    lane_from: int
    lane_to: int
    gap: float
    speed: float
    min_gap: float
    abs_speed: float

    @property
    def middle_ns(self) -> int:
        """Half way between start and end [ns]."""
        return (self.from_ns + self.to_ns) // 2


class _Row(NamedTuple):
    """What of a report counts here; the fields of its dtype by name, then gap, speed, and when a
    lane change began and ends [s]."""

    object_id: int
    t_ns: int
    age: int
    coasting: bool
    manoeuvre: int
    direction: int
    lane: int
    flags: int
    duplicate_of: int
    probability: float
    ego_speed: float
    x: float
    vx: float
    begin: float
    end: float


@dataclass(slots=True)
class _Stretch:
    """An event while it lasts, and for `GAP_NS` after that."""

    object_id: int
    first_ns: int
    last_ns: int
    lane_from: int
    lane_to: int
    gap: float
    speed: float
    abs_speed: float
    min_gap: float = math.inf
    held_ns: int = 0
    n: int = 0
    probability: float = 0.0
    cut_in: int = 0
    cut_out: int = 0
    begin: float = math.nan
    end: float = math.nan


@dataclass(slots=True)
class _Track:
    object_id: int
    first_ns: int
    t_ns: int
    age: int
    open: dict[tuple[int, int], _Stretch] = field(default_factory=dict)
    lanes: deque[tuple[int, int]] = field(default_factory=deque)
    counted: set[int] = field(default_factory=set)
    duplicate_of: int = -1
    known: bool = False


class EventCollector:
    """Finds the events; called after each scan with all reports, as a listener of the detector.

    An object of which there is no report has gone, as has one that was seen and has not aged by
    that; another one may carry its id later.  Reports of a duplicate track are passed over; when
    the older track ends first, the younger one carries on its events.

    Attributes:
        objects: number of objects that were called anything (duplicates don't count).
        counted: number of objects that were STATIONARY, and ONCOMING, at some time.
        time_ns: object time by manoeuvre [ns], without duplicates.
    """

    def __init__(self) -> None:
        self.objects = 0
        self.counted: Counter[Manoeuvre] = Counter()
        self.time_ns: Counter[int] = Counter()
        self._found: list[Event] = []
        self._tracks: dict[int, _Track] = {}

    @property
    def found(self) -> list[Event]:
        """Events that are over, in the order in which they began."""
        return sorted(self._found, key=lambda e: (e.from_ns, e.object_id, e.to_ns))

    def share(self) -> dict[Manoeuvre, float]:
        """Share of each manoeuvre in the time of all objects, the largest first; UNKNOWN is out."""
        known = {Manoeuvre(m): ns for m, ns in self.time_ns.most_common() if m and ns}
        return {m: ns / sum(known.values()) for m, ns in known.items()}

    def __call__(self, t_ns: int, reports: npt.NDArray[Any]) -> None:
        ids = reports["object_id"].tolist()
        for gone in self._tracks.keys() - set(ids):
            # no reports at all may mean that the scan was not used
            if ids or t_ns - self._tracks[gone].t_ns > GAP_NS:
                self._end(gone)
        columns = [reports[name].tolist() for name in _Row._fields[:-4]]
        columns += reports["x"][:, [X, VX]].T.tolist() + reports["change"].T.tolist()
        for row in map(_Row._make, zip(*columns, strict=True)):
            self._take(row)

    def _take(self, row: _Row) -> None:
        """One object's report."""
        track = self._tracks.get(row.object_id)
        if track is not None and row.age < track.age + (not row.coasting):
            self._end(row.object_id)
            track = None
        if track is None:
            track = self._tracks[row.object_id] = _Track(row.object_id, row.t_ns, row.t_ns, row.age)
        before_ns, track.t_ns = track.t_ns, row.t_ns
        track.age, track.duplicate_of = row.age, row.duplicate_of
        self._remember(track, row)
        self._close_old(track)
        if row.duplicate_of >= 0:
            self._yield_to(row.duplicate_of, track)
            return
        self.time_ns[row.manoeuvre] += row.t_ns - before_ns
        if row.manoeuvre and not track.known:
            track.known = True
            self.objects += 1
        key = row.manoeuvre, row.direction if row.manoeuvre == Manoeuvre.LANE_CHANGE else 0
        if row.manoeuvre in _FOLLOWED:
            self._extend(track, key, before_ns, row)
        if row.flags & OVERTAKING_ANOTHER and key != _PASSING:
            self._extend(track, _PASSING, before_ns, row)

    def finish(self) -> None:
        """End what is still going on: the recording is over."""
        for object_id in list(self._tracks):
            self._end(object_id)

    @staticmethod
    def _remember(track: _Track, row: _Row) -> None:
        """Keep the lanes of the last `GAP_NS`, and the one before those."""
        track.lanes.append((track.t_ns, row.lane))
        while len(track.lanes) > 1 and track.lanes[1][0] <= track.t_ns - GAP_NS:
            track.lanes.popleft()
        for (manoeuvre, _), stretch in track.open.items():
            # A border may be crossed a little after a lane change is said to be over.
            if manoeuvre in _ACROSS and track.t_ns - stretch.last_ns <= GAP_NS:
                stretch.lane_to = row.lane
                if row.begin == row.begin:
                    stretch.begin, stretch.end = row.begin, row.end

    @staticmethod
    def _extend(track: _Track, key: tuple[int, int], before_ns: int, row: _Row) -> None:
        stretch = track.open.get(key)
        if stretch is None:
            first = track.lanes[0][1] if key[0] in _ACROSS else row.lane
            stretch = track.open[key] = _Stretch(
                row.object_id,
                row.t_ns,
                row.t_ns,
                lane_from=first,
                lane_to=row.lane,
                gap=row.x,
                speed=row.vx,
                abs_speed=row.ego_speed + row.vx,
                begin=row.begin,
                end=row.end,
            )
        elif stretch.last_ns == before_ns:
            stretch.held_ns += row.t_ns - before_ns
        stretch.last_ns = row.t_ns
        stretch.lane_to = row.lane
        stretch.min_gap = min(stretch.min_gap, row.x)
        stretch.n += 1
        stretch.probability += row.probability
        stretch.cut_in += bool(row.flags & CUT_IN)
        stretch.cut_out += bool(row.flags & CUT_OUT)

    def _close_old(self, track: _Track) -> None:
        for key, stretch in list(track.open.items()):
            if track.t_ns - stretch.last_ns > GAP_NS:
                self._close(track, key, seen=True)

    def _close(self, track: _Track, key: tuple[int, int], *, seen: bool) -> None:
        """The event is over; ``seen``: there were reports of the object for a while after it."""
        s = track.open.pop(key)
        if s.held_ns < SHORTEST_NS:
            return
        manoeuvre = Manoeuvre(key[0])
        if manoeuvre in COUNTED:
            if manoeuvre not in track.counted:
                track.counted.add(manoeuvre)
                self.counted[manoeuvre] += 1
            return
        event = ""
        if key == _PASSING:
            event = "OVERTAKING"
        elif max(s.cut_in, s.cut_out) >= FLAG_SHARE * s.n and not (
            seen and s.lane_from == s.lane_to
        ):
            event = "CUT_IN" if s.cut_in >= s.cut_out else "CUT_OUT"
        first_ns, last_ns = s.first_ns, s.last_ns
        if manoeuvre == Manoeuvre.LANE_CHANGE and s.begin == s.begin:
            first_ns = max(round(s.begin * 1e9), track.first_ns)
            last_ns = max(min(round(s.end * 1e9), track.t_ns), first_ns)
        self._found.append(
            Event(
                s.object_id,
                manoeuvre,
                event,
                key[1],
                first_ns,
                last_ns,
                s.probability / s.n,
                s.lane_from,
                s.lane_to,
                s.gap,
                s.speed,
                s.min_gap,
                s.abs_speed,
            )
        )

    def _yield_to(self, older: int, track: _Track) -> None:
        """``track`` proves to be a duplicate: what the older one also does is the older one's."""
        other = self._tracks.get(older)
        if other is not None:
            for key in track.open.keys() & other.open.keys():
                del track.open[key]

    def _end(self, object_id: int) -> None:
        track = self._tracks.pop(object_id)
        heir = next((t for t in self._tracks.values() if t.duplicate_of == object_id), None)
        if heir is not None:
            for key, stretch in track.open.items():
                heir.open.setdefault(key, stretch)
            heir.counted |= track.counted
            heir.known |= track.known
            return
        for key in list(track.open):
            self._close(track, key, seen=False)
