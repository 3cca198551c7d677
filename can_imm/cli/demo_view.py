"""The live view of the demonstration on a terminal."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from rich.console import Group
from rich.live import Live
from rich.text import Text

from can_imm.bus.encoder import OUTPUT_IDS, STATUS_ID
from can_imm.cli.demo_bands import COLOURS, RIGHT, WRONG, bands
from can_imm.cli.demo_road import Car, Road
from can_imm.cli.demo_run import START_NS
from can_imm.types import Manoeuvre

if TYPE_CHECKING:
    from types import TracebackType

    from rich.console import Console

    from can_imm.cli.demo_run import DemoRun, Track

WIDTH, HEIGHT = 80, 24
"""Smallest terminal for the view."""

FRAMES_PER_S = 12
GONE_NS = 300_000_000
"""An object of which nothing was heard for so long [ns] is no longer on the road."""

TWO_LANES = tuple(Manoeuvre(m) for m in range(Manoeuvre.KEEP_RIGHT, Manoeuvre.REAR_END + 1))
"""Those of the scenarios' road."""

STATES = (("x", "m"), ("vx", "m/s"), ("y", "m"), ("vy", "m/s"))
SIDE = {-1: " right", 0: "", 1: " left"}
_EIGHTHS = " ▏▎▍▌▋▊▉"
_TABLE_WIDTH, _BARS_WIDTH = 39, 65


def fits(console: Console) -> bool:
    """Whether the console is a terminal that can show the view."""
    return (
        console.is_terminal
        and not console.is_dumb_terminal
        and not console.options.ascii_only
        and console.width >= WIDTH
        and console.height >= HEIGHT
    )


class LiveView:
    """Draws the run in a thread of its own while it is entered."""

    def __init__(self, show: DemoRun, console: Console, title: str, rate: float) -> None:
        self._show = show
        self._console = console
        self._title = title
        self._rate = rate
        farthest = max(float(track.state[:, 0].max()) for track in show.tracks)
        self._reach = 10.0 * math.ceil((farthest + 8.0) / 10.0)
        self._live = Live(
            get_renderable=self.render,
            console=console,
            screen=True,
            refresh_per_second=FRAMES_PER_S,
        )

    def __enter__(self) -> None:
        self._live.__enter__()

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._live.__exit__(kind, error, trace)

    def render(self) -> Group:
        """The whole view at this moment, for the console's size."""
        show, (width, height) = self._show, self._console.size
        at_ns, track = show.at_ns, show.tracks[0]
        k = track.rows(at_ns) - 1
        lane_rows = 2 if height < 28 else 3 if height < 38 else 4
        sections = [
            [self._header(at_ns, width)],
            self._road(width, lane_rows),
            [self._verdict(track, k)],
            _side_by_side(
                _bars(track, k, min(width - _TABLE_WIDTH - 3, _BARS_WIDTH)), self._states(track, k)
            ),
            [Text()],
            bands(track, at_ns, show.duration_ns, width),
            self._bus(),
        ]
        spare = height - sum(len(section) for section in sections)
        lines: list[Text] = []
        for number, section in enumerate(sections):
            # blank lines where there is room, the most needed ones first
            lines += section
            if spare > 0 and number in (2, 1, 0, 5):
                lines.append(Text())
                spare -= 1
        return Group(*lines)

    def _header(self, at_ns: int, width: int) -> Text:
        left = Text.assemble((" can-imm demo ", "bold reverse"), "  ", self._title)
        now_s, end_s = max(at_ns, 0) * 1e-9, self._show.duration_ns * 1e-9
        right = f"{now_s:5.1f} of {end_s:.1f} s  {self._rate:.1f}x "
        left.truncate(width - len(right) - 1, overflow="ellipsis")
        left.pad_right(width - len(right) - len(left))
        return left.append(right, "bold")

    def _road(self, width: int, lane_rows: int) -> list[Text]:
        show = self._show
        road = Road(show.lane_width, self._reach, width, lane_rows)
        true = {
            track.object_id: track.label[k]
            for track in show.tracks
            if (k := track.rows(show.at_ns) - 1) >= 0
        }
        # what any node on the bus knows, from the detector's frames
        for object_id, (t_ns, state) in show.tap.states.copy().items():
            place = show.tap.estimates.get(object_id)
            if place is None or show.at_ns + START_NS - t_ns > GONE_NS:
                continue
            said = Manoeuvre(state.manoeuvre)
            name = f"{said.name}{SIDE[state.direction]} {100 * state.probability:.0f} %"
            if len(show.tracks) > 1:
                name = f"{object_id}: {name}"
            right = true.get(object_id) == said
            road.add(Car(place.x, place.y, name, RIGHT if right else WRONG))
        return road.lines()

    def _verdict(self, track: Track, k: int) -> Text:
        if k < 0:
            return Text()
        true, said = Manoeuvre(track.label[k]), Manoeuvre(track.manoeuvre[k])
        right = true == said
        share = float((track.label[: k + 1] == track.manoeuvre[: k + 1]).mean())
        return Text.assemble(
            f"object {track.object_id}: " if len(self._show.tracks) > 1 else "",
            "true  ",
            (f" {true.name:<11} ", f"black on {COLOURS[true]}"),
            "   said  ",
            (f" {said.name:<11} ", f"black on {COLOURS[said]}"),
            "  ",
            ("right" if right else "WRONG", RIGHT if right else WRONG),
            f"   so far {100 * share:.1f} % right",
        )

    def _states(self, track: Track, k: int) -> list[Text]:
        """The object's state: true, measured and filtered; and the loop's counters."""
        lines = [Text(f"{'':9}{'true':>7}{'measured':>10}{'filtered':>10}", "dim")]
        for i, (name, unit) in enumerate(STATES):
            line = Text(f"{name:<3}{unit:<5} ")
            if k >= 0:
                line.append(f"{track.state[k, i]:z7.2f}", "bold")
                line.append(f"{track.z[k, i]:z10.2f}", "dim")
                line.append(f"{track.x[k, i]:z10.2f}")
            lines.append(line)
        health, work = self._show.health, self._show.work
        lines.append(Text(f"loop  {health.steps:,} steps, {health.late_frames} late frames", "dim"))
        lines.append(
            Text(f"      answers: half within {work.quantile_ns(0.5) / 1e6:.2f} ms", "dim")
        )
        return lines

    def _bus(self) -> list[Text]:
        tap, decoded = self._show.tap, self._show.node.decoder.counts
        radar = self._show.radar_ids
        answers = sum(tap.counts[i] for i in OUTPUT_IDS)
        return [
            self._frames("radar", radar, f"{decoded.frames:,} frames, {decoded.rejected} rejected"),
            self._frames(
                "detector",
                sorted(OUTPUT_IDS - {STATUS_ID}),
                f"{answers:,} frames, {self._show.tap.rejected} rejected",
            ),
        ]

    def _frames(self, name: str, ids: list[int], counters: str) -> Text:
        line = Text(f"{name:<9}")
        for i in ids:
            frame = self._show.tap.latest.get(i)
            data = "" if frame is None else frame.data.hex().upper()
            line.append(f"{i:03X}#{data:<16}  ", "cyan")
        return line.append(counters)


def _bars(track: Track, k: int, width: int) -> list[Text]:
    """Seven lines: probability of each manoeuvre; a mark at the true one."""
    lines = []
    size = width - 21
    for manoeuvre in TWO_LANES:
        p = float(track.p[k, manoeuvre]) if k >= 0 else 0.0
        is_true = k >= 0 and track.label[k] == manoeuvre
        is_said = k >= 0 and track.manoeuvre[k] == manoeuvre
        verdict = "" if not is_said else RIGHT if is_true else WRONG
        whole, rest = divmod(round(p * size * 8), 8)
        bar = "█" * whole + (_EIGHTHS[rest] if rest else "")
        lines.append(
            Text.assemble(
                ("▸" if is_true else " ", "bold"),
                (f"{manoeuvre.name:<12}", verdict or ("" if is_true else "dim")),
                (f"{bar:<{size}}", COLOURS[manoeuvre]),
                (f"{100 * p:6.1f} %", verdict or "dim"),
            )
        )
    return lines


def _side_by_side(left: list[Text], right: list[Text]) -> list[Text]:
    right = right + [Text()] * (len(left) - len(right))
    return [Text.assemble(a, "   ", b) for a, b in zip(left, right, strict=True)]
