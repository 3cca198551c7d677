"""What ``detect`` and ``replay`` have in common: options, the detector's parts, the summary."""

from __future__ import annotations

import argparse
from contextlib import ExitStack
from dataclasses import dataclass
from typing import TYPE_CHECKING

from can_imm.cli.compiling import announced

if TYPE_CHECKING:
    from rich.console import Console

    from can_imm.bus.decoder import DecodeCounts
    from can_imm.bus.encoder import ManoeuvreEncoder
    from can_imm.events import Event, EventCollector
    from can_imm.plots.history import History
    from can_imm.runtime.health import Health
    from can_imm.runtime.nodes import DetectorNode, Listener
    from can_imm.runtime.smoothed import Smoothed

MOST_EVENTS = 30
"""Rows of the table of events; a file takes them all."""


def add_detector_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options that choose sensor, mode bank and the form of the answer."""
    parser.add_argument(
        "--profile",
        default="can_imm",
        metavar="NAME|FILE",
        help="the sensor: can_imm (default), another one of 'can-imm profiles', or a TOML file",
    )
    parser.add_argument(
        "--sensor",
        type=whole_int,
        metavar="N",
        help="of several such sensors on the bus, the one with this number",
    )
    parser.add_argument(
        "--preset",
        default="two-lane",
        metavar="NAME|FILE",
        help="the mode bank: two-lane (default), motorway, paper, or a TOML file",
    )
    parser.add_argument(
        "--objects",
        type=positive_int,
        default=128,
        metavar="N",
        help="follow at most N objects at a time (default: 128)",
    )
    parser.add_argument(
        "--estimates",
        choices=["scan", "step"],
        default="scan",
        help="send ObjectEstimate with each scan (default), or predicted at every 10 ms step",
    )
    parser.add_argument(
        "--lane-width", type=float, metavar="M", help="width of the lanes; otherwise it is learned"
    )
    parser.add_argument(
        "--lane-offset",
        type=float,
        metavar="M",
        help="where in its lane the ego usually is, to the left; preset motorway",
    )
    parser.add_argument(
        "--straight-road",
        action="store_true",
        help="the road has no bends, as on a proving ground; otherwise it is learned; preset "
        "motorway",
    )
    parser.add_argument(
        "--csv", metavar="OUT", help="write one row per object and scan; - is standard output"
    )
    parser.add_argument(
        "--events", metavar="FILE", help="write all events to this .csv or .json file"
    )
    parser.add_argument(
        "--lag",
        type=float,
        metavar="S",
        help="answer S seconds later (0.01 or more), with what is known by then, which is better: "
        "frames, CSV and events",
    )
    parser.set_defaults(refuse=parser.error)


def check_detector_arguments(args: argparse.Namespace) -> None:
    """Refuse options that contradict each other, before anything is opened."""
    if args.lag is not None and args.estimates == "step":
        args.refuse("--estimates step looks ahead, --lag back: not both")


def positive_int(text: str) -> int:
    """Parse a whole number from 1 up, for argparse."""
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"must be a whole number from 1 up, not {text!r}")
    return int(text)


def whole_int(text: str) -> int:
    """Parse a whole number from 0 up, for argparse."""
    if not text.isdecimal():
        raise argparse.ArgumentTypeError(f"must be a whole number from 0 up, not {text!r}")
    return int(text)


@dataclass
class Detection:
    """A detector node with everything that listens to it, for one bus or recording."""

    node: DetectorNode
    encoder: ManoeuvreEncoder
    health: Health
    events: EventCollector
    smoothed: Smoothed | None

    def finish(self) -> None:
        """No more scans will come: conclude what waits for its end."""
        self.node.remaining(0)  # where a bus is gone the listeners still want to know
        if self.smoothed is not None:
            self.smoothed.finish()
        self.events.finish()


class Equipment:
    """What the options ask for, loaded, checked and opened once, for any number of recordings.

    Args:
        args: of a parser with `add_detector_arguments`.
        several: more than one recording will be written.

    Raises:
        CanImmError: a profile, DBC or preset is missing or wrong.
        OSError: a file cannot be written.
    """

    def __init__(self, args: argparse.Namespace, *, several: bool = False) -> None:
        with announced():
            from can_imm.bus.profile import load_profile
            from can_imm.cli.reports import EventFile, ReportCsv
            from can_imm.manoeuvres import load_bank
            from can_imm.types import Manoeuvre

            self._args = args
            self.profile = load_profile(args.profile, sensor=args.sensor)
            self.bank = load_bank(
                args.preset,
                lane_width=args.lane_width,
                lane_offset=args.lane_offset,
                straight_road=args.straight_road,
            )
            self._files = ExitStack()
            self.csv = self.event_file = None
            if args.events:
                self.event_file = EventFile(args.events, several=several)
                self._files.callback(self.event_file.close)
            if args.csv:
                motorway = Manoeuvre.KEEP_LANE in self.bank.manoeuvres
                self.csv = ReportCsv(args.csv, motorway=motorway, with_log=several)
                self._files.callback(self.csv.close)

    def detection(self, name: str, history: History | None = None) -> Detection:
        """Return a fresh detector for the recording ``name``; it may have to be compiled.

        Its reports go, smoothed if the options say so, to the CSV file, to the events, and to the
        ``history`` for a picture.
        """
        with announced():
            from can_imm.bus.decoder import ScanDecoder
            from can_imm.bus.encoder import ManoeuvreEncoder
            from can_imm.detector import Detector
            from can_imm.events import EventCollector
            from can_imm.runtime.health import Health
            from can_imm.runtime.nodes import DetectorNode
            from can_imm.runtime.smoothed import Smoothed
            from can_imm.smoothing import FixedIntervalSmoother, FixedLagSmoother

            health, events, encoder = Health(), EventCollector(), ManoeuvreEncoder()
            objects = self._args.objects
            detector = Detector(self.bank, capacity=objects)
            watchers: list[Listener] = []
            listeners: list[Listener] = [events]  # hear what is said in the end
            if self.csv is not None:
                self.csv.log = name
                listeners.append(self.csv)
            if history is not None:
                history.road = detector.road
                watchers.append(history.watch)
                listeners.append(history)
            smoothed = lagging = None
            if getattr(self._args, "smooth", False):
                detector.history = interval = FixedIntervalSmoother(self.bank)
                smoothed = Smoothed(interval, listeners)
                listeners = [smoothed]
            elif self._args.lag is not None:
                detector.history = lagging = FixedLagSmoother(self.bank, self._args.lag)
            node = DetectorNode(
                ScanDecoder(self.profile, objects),
                detector,
                encoder,
                health,
                listeners,
                objects,
                every_step=self._args.estimates == "step",
                smoother=lagging,
                watchers=watchers,
            )
        return Detection(node, encoder, health, events, smoothed)

    def keep_events(self, name: str, detection: Detection) -> None:
        """Write the events of the recording ``name``, now that it has ended."""
        if self.event_file is not None:
            self.event_file.add(name, detection.events)

    def close(self) -> None:
        """Close the files."""
        self._files.close()


def summary_console(args: argparse.Namespace) -> Console:
    """Return the console for the summary: standard output, unless the CSV goes there."""
    from rich.console import Console

    return Console(stderr=args.csv == "-", highlight=False, soft_wrap=True)


def print_summary(
    console: Console, detection: Detection, title: str, more: list[tuple[str, str]]
) -> None:
    """Print what was read, rejected and found; ``more`` are further lines (name, text)."""
    from rich.markup import escape

    counts = detection.node.decoder.counts
    found = detection.node.detector.counts
    lines = [
        ("frames", _join(read=detection.health.frames, used=counts.used, empty=counts.empty,
                         unknown=counts.unknown)),
        *_ego_motion(detection),
        ("checksums", _join(right=counts.checksums_ok, wrong=counts.bad_crc)),
        ("rejected", _reasons(counts)),
        ("scans", _join(complete=counts.scans - counts.incomplete_scans,
                        incomplete=counts.incomplete_scans, lost=counts.lost_scans,
                        late=found.late_scans, dropped=detection.node.dropped_scans)),
        ("objects", _join(seen=found.births, still_there=detection.node.detector.n_tracked,
                          outliers=found.outliers, without_a_slot=found.overflow)),
        *more,
        ("manoeuvres", _shares(detection.events)),
    ]  # fmt: skip
    console.print(f"[bold]{escape(title)}[/]")
    for name, text in lines:
        console.print(f"  [dim]{name:<10}[/] {escape(text)}")
    _print_events(console, detection.events.found)


def _ego_motion(detection: Detection) -> list[tuple[str, str]]:
    """What was heard of the ego's motion, if the mode bank asks for it, and of other sensors."""
    counts = detection.node.decoder.counts
    lines = []
    if detection.node.detector.bank.road is not None:
        lines.append(("ego motion", f"{counts.ego:,} frames"))
        if not counts.ego:
            lines[0] = (
                "ego motion",
                "not on this bus: nothing is said to stand still or to be oncoming, and when the "
                "ego changes lane or turns the others seem to",
            )
        elif invalid := detection.node.detector.counts.ego_invalid:
            lines[0] = ("ego motion", f"{counts.ego:,} frames; impossible in {invalid:,} scans")
    if counts.other_sensor:
        lines.append(("others", f"{counts.other_sensor:,} frames of other sensors of the kind"))
    return lines


def _print_events(console: Console, events: list[Event]) -> None:
    """The table of events, at most `MOST_EVENTS` rows."""
    from can_imm.cli.reports import DIRECTION, seconds

    if not events:
        console.print("[bold]no events[/]")
        return
    console.print("[bold]events[/] [dim](gap and relative speed at the start, in m and m/s)[/]")
    console.print(
        f"  [dim]{'from':>14}  {'to':>14}  object  {'manoeuvre':<17}  {'lane':<8}  {'event':<10}"
        "  mean p     gap  least   speed[/]"
    )
    for event in weightiest(events, MOST_EVENTS):
        what = event.manoeuvre.name.replace("_", " ").lower()
        what = f"{what} {DIRECTION[event.direction]}".rstrip()
        lanes = f"{event.lane_from}"
        if event.lane_to != event.lane_from:
            lanes += f" to {event.lane_to}"
        first, last = (seconds(t_ns)[:-3] for t_ns in (event.from_ns, event.to_ns))
        console.print(
            f"  {first:>14}  {last:>14}  {event.object_id:>6}  {what:<17}  {lanes:<8}  "
            f"{event.event.replace('_', ' ').lower():<10}  {event.probability:6.2f}  "
            f"{event.gap:6.1f} {event.min_gap:6.1f}  {event.speed:+6.1f}"
        )
    if len(events) > MOST_EVENTS:
        console.print(f"  [dim]... {len(events) - MOST_EVENTS:,} more, --events FILE has all[/]")


def weightiest(events: list[Event], most: int) -> list[Event]:
    """At most so many of the events, in their order: those with a name of their own stay longest,
    then goes the order of `EVENTS`, then the duration."""
    from can_imm.events import EVENTS

    def weight(event: Event) -> tuple[bool, int, int]:
        return not event.event, EVENTS.index(event.manoeuvre), event.from_ns - event.to_ns

    kept = sorted(range(len(events)), key=lambda i: weight(events[i]))[:most]
    return [events[i] for i in sorted(kept)]


def _shares(events: EventCollector) -> str:
    """Number of objects, and the manoeuvres' shares in their time."""
    from can_imm.events import COUNTED

    parts = [
        f"{m.name.replace('_', ' ').lower()} {100 * share:.1f} %"
        for m, share in events.share().items()
    ]
    counted = ", ".join(f"{n} {m.name.lower()}" for m in COUNTED if (n := events.counted[m]))
    return (
        f"{events.objects:,} object{'s' * (events.objects != 1)}"
        + (f" ({counted} at some time)" if counted else "")
        + (f"; of their time: {', '.join(parts)}" if parts else "")
    )


REASONS = {
    "bad_kind": "wrong kind of frame",
    "bad_length": "wrong length",
    "bad_crc": "wrong checksum",
    "bad_counter": "wrong counter",
    "out_of_range": "out of range",
    "stray": "outside of a scan",
    "duplicates": "twice in a scan",
    "overflow": "no room",
}


def _reasons(counts: DecodeCounts) -> str:
    parts = [f"{n:,} {text}" for key, text in REASONS.items() if (n := getattr(counts, key))]
    return f"{counts.rejected:,}" + (f" ({', '.join(parts)})" if parts else "")


def _join(**numbers: int) -> str:
    return ", ".join(f"{number:,} {name.replace('_', ' ')}" for name, number in numbers.items())
