"""What ``detect`` and ``replay`` have in common: options, the detector's parts, the summary."""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from typing import TYPE_CHECKING

from can_imm.cli.compiling import announced

if TYPE_CHECKING:
    from rich.console import Console

    from can_imm.bus.decoder import DecodeCounts
    from can_imm.bus.encoder import ManoeuvreEncoder
    from can_imm.cli.reports import LaneChanges, ReportCsv
    from can_imm.runtime.health import Health
    from can_imm.runtime.nodes import DetectorNode


def add_detector_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options that choose sensor, mode bank and the form of the answer."""
    parser.add_argument(
        "--profile",
        default="can_imm",
        metavar="NAME|FILE",
        help="the sensor: can_imm (default), toyota, or a TOML file",
    )
    parser.add_argument(
        "--preset",
        default="two-lane",
        metavar="NAME|FILE",
        help="the mode bank: two-lane (default), paper, or a TOML file",
    )
    parser.add_argument(
        "--objects",
        type=positive_int,
        default=64,
        metavar="N",
        help="follow at most N objects at a time (default: 64)",
    )
    parser.add_argument(
        "--estimates",
        choices=["scan", "step"],
        default="scan",
        help="send ObjectEstimate with each scan (default), or predicted at every 10 ms step",
    )
    parser.add_argument(
        "--csv", metavar="OUT", help="write one row per object and scan; - is standard output"
    )


def positive_int(text: str) -> int:
    """Parse a whole number from 1 up, for argparse."""
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"must be a whole number from 1 up, not {text!r}")
    return int(text)


@dataclass
class Detection:
    """A detector node with everything that listens to it."""

    node: DetectorNode
    encoder: ManoeuvreEncoder
    health: Health
    changes: LaneChanges
    csv: ReportCsv | None

    def close(self) -> None:
        if self.csv is not None:
            self.csv.close()


def build(args: argparse.Namespace) -> Detection:
    """Allocate, validate and compile everything that the options ask for.

    Raises:
        CanImmError: a profile, DBC or preset is missing or wrong.
        OSError: the CSV file cannot be written.
    """
    with announced():
        from can_imm.bus.decoder import ScanDecoder
        from can_imm.bus.encoder import ManoeuvreEncoder
        from can_imm.bus.profile import load_profile
        from can_imm.cli.reports import LaneChanges, ReportCsv
        from can_imm.detector import Detector
        from can_imm.manoeuvres import load_bank
        from can_imm.runtime.health import Health
        from can_imm.runtime.nodes import DetectorNode, Listener

        decoder = ScanDecoder(load_profile(args.profile), args.objects)
        bank = load_bank(args.preset)
        health, changes = Health(), LaneChanges()
        listeners: list[Listener] = [changes]
        csv = ReportCsv(args.csv) if args.csv else None
        if csv is not None:
            listeners.append(csv)
        # last, because it may compile: what is wrong with the options has been said by now
        detector = Detector(bank, capacity=args.objects)
        encoder = ManoeuvreEncoder()
        node = DetectorNode(
            decoder,
            detector,
            encoder,
            health,
            listeners,
            args.objects,
            every_step=args.estimates == "step",
        )
    return Detection(node, encoder, health, changes, csv)


def summary_console(args: argparse.Namespace) -> Console:
    """Return the console for the summary: standard output, unless the CSV goes there."""
    from rich.console import Console

    return Console(stderr=args.csv == "-", highlight=False, soft_wrap=True)


def print_summary(
    console: Console, detection: Detection, title: str, more: list[tuple[str, str]]
) -> None:
    """Print what was read, rejected and found; ``more`` are further lines (name, text)."""
    from rich.markup import escape

    from can_imm.cli.reports import DIRECTION, seconds

    counts = detection.node.decoder.counts
    found = detection.node.detector.counts
    lines = [
        ("frames", _join(read=detection.health.frames, used=counts.used, empty=counts.empty,
                         unknown=counts.unknown)),
        ("checksums", _join(right=counts.checksums_ok, wrong=counts.bad_crc)),
        ("rejected", _reasons(counts)),
        ("scans", _join(complete=counts.scans - counts.incomplete_scans,
                        incomplete=counts.incomplete_scans, lost=counts.lost_scans,
                        late=found.late_scans, dropped=detection.node.dropped_scans)),
        ("objects", _join(seen=found.births, still_there=detection.node.detector.n_tracked,
                          outliers=found.outliers, without_a_slot=found.overflow)),
        *more,
    ]  # fmt: skip
    console.print(f"[bold]{escape(title)}[/]")
    for name, text in lines:
        console.print(f"  [dim]{name:<10}[/] {escape(text)}")
    changes = detection.changes.found
    if not changes:
        console.print("[bold]no lane changes[/]")
        return
    console.print("[bold]lane changes[/]")
    console.print(f"  [dim]{'from':>17}  {'to':>17}  object  direction[/]")
    for change in changes:
        first, last = seconds(change.first_ns)[:-3], seconds(change.last_ns)[:-3]
        direction = DIRECTION[change.direction]
        console.print(f"  {first:>17}  {last:>17}  {change.object_id:>6}  {direction}".rstrip())


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
