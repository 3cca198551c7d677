"""The demonstration: its run on the virtual bus, its lines, its view, its summary."""

from __future__ import annotations

import io
import os
import re
import signal
import subprocess
import sys
import time
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest
from rich.cells import cell_len
from rich.console import Console

from can_imm.cli import demo_run
from can_imm.cli.compiling import announced
from can_imm.cli.demo_bands import COLOURS, bands
from can_imm.cli.demo_lines import PlainLines
from can_imm.cli.demo_road import Car, Road
from can_imm.cli.demo_run import DemoRun
from can_imm.cli.demo_view import TWO_LANES, LiveView, fits
from can_imm.cli.main import main
from can_imm.studies.systems import answer
from can_imm.types import Manoeuvre

TWO = """
duration = 3.0
[[object]]
id = 5
gap = 40.0
lane = "right"
segments = [{ start = 0.0, label = "KEEP_RIGHT" }]
[[object]]
id = 9
gap = 20.0
lane = "left"
segments = [{ start = 0.0, label = "KEEP_LEFT" }]
"""

LINE = re.compile(r" +([\d.]+)s +([\d.]+)m +(\d+)  (\w+) +(\w+) +([\d.]+)(  wrong)?")


@pytest.fixture(scope="module")
def two(tmp_path_factory):
    path = tmp_path_factory.mktemp("two") / "two.toml"
    path.write_text(TWO)
    return path


@pytest.fixture
def show(scenario):
    return DemoRun(str(scenario), "two-lane", 1)


def played(show, rate=None):
    show.play(rate)
    return show


def terminal(width=80, height=24, **more):
    options = {"file": io.StringIO(), "legacy_windows": False, "_environ": {}} | more
    return Console(force_terminal=True, width=width, height=height, **options)


def cells_of(output, system):
    """The cells of a system's row in the summary."""
    (line,) = [line for line in output.splitlines() if line.startswith(f"{system} ")]
    return line.split()[1:]


# --- the run -------------------------------------------------------------------------------------


def test_every_scan_goes_over_the_bus_and_comes_back_as_a_manoeuvre(show):
    played(show)
    scans = 61
    assert show.tap.counts[0x300] == show.tap.counts[0x301] == scans
    assert show.tap.counts[0x310] == show.tap.counts[0x311] == scans
    assert show.tap.counts[0x31F] > 50
    assert show.tap.rejected == show.node.decoder.counts.rejected == 0
    assert show.node.decoder.counts.used == 2 * scans
    assert show.health.late_frames == 0
    assert show.at_ns == show.duration_ns == 6_000_000_000


def test_the_tap_understands_what_the_detector_said(show):
    said = []

    def compare():
        k = show.tracks[0].rows(show.at_ns) - 1
        if k > 0:  # the tap has heard the answer to the scan before
            _, state = show.tap.states[3]
            place = show.tap.estimates[3]
            track = show.tracks[0]
            said.append(state.manoeuvre)
            assert state.manoeuvre == track.manoeuvre[k - 1]
            assert state.probability == pytest.approx(track.p[k - 1].max(), abs=6e-4)
            # half a step of DistLong, VrelLong, DistLat, VrelLat
            assert (
                np.abs(place[1:] - track.x[k - 1]) < np.array([0.01, 0.0375, 0.01, 0.025]) + 1e-5
            ).all()

    show.on_scan = compare
    played(show)
    assert len(said) == 60
    assert {Manoeuvre.KEEP_RIGHT, Manoeuvre.LANE_CHANGE, Manoeuvre.KEEP_LEFT} <= set(said)


def test_frames_cost_no_more_than_their_resolution(show):
    played(show)
    (without_bus,) = answer("two-lane", show.scans, show.observations, 1)
    track = show.tracks[0]
    # filters settle after their first second; the steps of DistLong, VrelLong, DistLat, VrelLat
    rms = np.sqrt(np.mean((track.x - without_bus.x)[10:] ** 2, axis=0))
    assert (rms < [0.02, 0.07, 0.05, 0.07]).all()
    assert (track.manoeuvre != without_bus.manoeuvre).mean() < 0.05


def test_what_is_said_does_not_depend_on_the_speed(two):
    fast, slow = (played(DemoRun(str(two), "two-lane", 4), rate) for rate in (None, 60.0))
    for one, other in zip(fast.tracks, slow.tracks, strict=True):
        np.testing.assert_array_equal(one.x, other.x)
        np.testing.assert_array_equal(one.p, other.p)


def test_pacing_keeps_time_and_forgets_a_stall(monkeypatch):
    now, slept = [100.0], []

    def sleep(seconds):
        slept.append(seconds)
        now[0] += seconds

    monkeypatch.setattr(demo_run, "time", SimpleNamespace(monotonic=lambda: now[0], sleep=sleep))
    pace = demo_run.pacer(5.0)
    for _ in range(100):
        now[0] += 0.0005  # the work of a step
        assert not pace()
    assert now[0] == pytest.approx(100.0 + 100 * 0.01 / 5)
    now[0] += 60.0
    resumed = now[0]
    for _ in range(1000):
        pace()
    # 100 ms are made up for, a minute is not
    assert now[0] - resumed == pytest.approx(1000 * 0.01 / 5 - 0.1, abs=0.005)


# --- plain lines and summary ---------------------------------------------------------------------


@pytest.fixture(scope="module")
def plain(scenario):
    """Output of a whole run through a pipe."""
    out, before = io.StringIO(), sys.stdout
    sys.stdout = out
    try:
        assert main(["demo", "--scenario", str(scenario), "--seed", "1"]) == 0
    finally:
        sys.stdout = before
    return out.getvalue()


def test_a_pipe_gets_plain_narrow_lines(plain):
    assert "\x1b" not in plain
    assert max(map(len, plain.splitlines()[2:])) <= 80


def test_a_line_for_each_change(plain):
    rows = [m.groups() for m in map(LINE.fullmatch, plain.splitlines()) if m]
    assert len(rows) >= 5
    assert [r[0] for r in rows] == sorted({r[0] for r in rows}, key=float)
    assert all(a[3:5] != b[3:5] for a, b in pairwise(rows))
    assert all((true != said) == bool(wrong) for *_, true, said, _, wrong in rows)
    starts = {true: float(t) for t, _, _, true, *_ in reversed(rows)}
    assert starts == {"KEEP_RIGHT": 0.0, "LANE_CHANGE": 2.0, "KEEP_LEFT": 4.0}
    assert {row[2] for row in rows} == {"3"}
    assert all(39 < float(row[1]) < 41 and 0 < float(row[5]) <= 1 for row in rows)


def test_the_summary_agrees_with_the_lines(plain):
    rows = [m.groups() for m in map(LINE.fullmatch, plain.splitlines()) if m]
    right, switches, k = 0, 0, -1
    for scan in range(61):
        if k + 1 < len(rows) and round(float(rows[k + 1][0]) * 10) == scan:
            switches += k >= 0 and rows[k + 1][4] != rows[k][4]
            k += 1
        right += rows[k][3] == rows[k][4]
    cells = cells_of(plain, "two-lane")
    assert float(cells[0]) == pytest.approx(right / 61, abs=6e-4)
    assert int(cells[4]) == switches
    assert "2 true" in plain
    assert "61 scans" in plain


def test_the_summary_has_the_baselines_and_the_paper(plain, show):
    assert cells_of(plain.replace("Table 6 ", "Table_6 "), "Table_6") == [
        "-", "-", "-", "-", "-", ".1531", ".2159", ".1150", ".1786",
    ]  # fmt: skip
    for system in ("rules", "kalman", "measurement"):
        assert len(cells_of(plain, system)) == 9
    error = np.sqrt(np.mean((show.tracks[0].z - show.tracks[0].state) ** 2, axis=0))
    assert [float(v) for v in cells_of(plain, "measurement")[5:]] == pytest.approx(error, abs=6e-5)
    assert "122 frames, 0 rejected" in plain
    assert "can-imm study paper" in plain


def test_several_objects(two, capsys):
    assert main(["demo", "--scenario", str(two)]) == 0
    out = capsys.readouterr().out
    assert {m.group(3) for m in map(LINE.fullmatch, out.splitlines()) if m} == {"5", "9"}
    assert "mean over 2 objects" in out


def test_random_scenario_and_other_preset(capsys, monkeypatch):
    monkeypatch.setattr(DemoRun, "play", lambda show, rate: None)
    assert main(["demo", "--scenario", "random", "--seed", "3", "--preset", "paper"]) == 0
    out = capsys.readouterr().out
    assert "random, seed 3, preset paper" in out
    assert "ended before the first scan" in out


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--scenario", "nowhere"], "nowhere: "),
        (["--preset", "nothing"], "nothing: "),
        (["--plot", "/dev/null/figures"], "/dev/null"),
    ],
)
def test_refusals_are_one_line(arguments, message, capsys):
    assert main(["demo", *arguments]) == 1
    captured = capsys.readouterr()
    # what is compiled now is said before
    (error,) = (line for line in captured.err.splitlines() if "compiling" not in line)
    assert message in error
    assert captured.out == ""


def test_seed_must_be_a_whole_number(capsys):
    for seed in ("-1", "x", "1.5"):
        with pytest.raises(SystemExit) as refused:
            main(["demo", f"--seed={seed}"])
        assert refused.value.code == 2
        assert "--seed" in capsys.readouterr().err


def test_default_seed_was_not_used_for_tuning():
    from can_imm.cli.main import build_parser
    from can_imm.studies.runs import FIRST_SEED

    assert build_parser(["demo"]).parse_args(["demo"]).seed >= FIRST_SEED


def test_plot_draws_this_run(scenario, tmp_path, capsys, monkeypatch):
    import matplotlib.figure

    drawn = {}
    monkeypatch.setattr(
        matplotlib.figure.Figure, "savefig", lambda figure, path: drawn.update({path.stem: figure})
    )
    directory = tmp_path / "new" / "figures"
    assert main(["demo", "--scenario", str(scenario), "--seed", "1", "--plot", str(directory)]) == 0
    assert [name[:4] for name in drawn] == [f"fig{k}" for k in range(3, 9)]
    filtered = drawn["fig7_states"].axes[0].lines[1].get_ydata()
    np.testing.assert_array_equal(
        filtered, played(DemoRun(str(scenario), "two-lane", 1)).tracks[0].x[:, 0]
    )
    assert str(directory) in capsys.readouterr().out.replace("\n", "")


def test_interrupted_it_sums_up_what_there_was(scenario, tmp_path, monkeypatch, capsys):
    line = PlainLines.__call__

    def interrupt(self):
        line(self)
        if self._show.at_ns == 2_400_000_000:
            raise KeyboardInterrupt

    monkeypatch.setattr(PlainLines, "__call__", interrupt)
    assert main(["demo", "--scenario", str(scenario), "--plot", str(tmp_path)]) == 130
    out = capsys.readouterr().out
    assert "2.4 s, 25 scans" in out
    assert "1 true" in out
    assert "figures in" not in out


def test_interrupted_after_one_scan(scenario, monkeypatch, capsys):
    def interrupt(self):
        raise KeyboardInterrupt

    monkeypatch.setattr(PlainLines, "__call__", interrupt)
    assert main(["demo", "--scenario", str(scenario)]) == 130
    assert "0.0 s, 1 scans" in capsys.readouterr().out


def test_ctrl_c_in_real_time(scenario):
    with subprocess.Popen(
        [sys.executable, "-m", "can_imm", "demo", "--realtime", "--scenario", str(scenario)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | {"PYTHONUNBUFFERED": "1"},
    ) as process:
        lines = iter(process.stdout.readline, "")
        assert any(LINE.fullmatch(line.rstrip()) for line in lines)
        began = time.monotonic()
        time.sleep(0.5)
        process.send_signal(signal.SIGINT)
        rest, errors = process.communicate(timeout=20)
    assert process.returncode == 130
    assert "Traceback" not in errors
    seconds = float(re.search(r"^([\d.]+) s, \d+ scans", rest, re.MULTILINE)[1])
    assert 0.3 <= seconds <= time.monotonic() - began + 0.2
    assert cells_of(rest, "two-lane")


# --- the view ------------------------------------------------------------------------------------


@pytest.mark.parametrize("size", [(80, 24), (100, 32), (200, 60)])
def test_the_view_fits_at_every_moment(show, size):
    console = terminal(*size)
    view = LiveView(show, console, "scenario " * 30, 7.0)
    moments = []

    def look():
        lines = view.render().renderables
        assert len(lines) <= size[1]
        assert max(cell_len(line.plain.rstrip()) for line in lines) <= size[0]
        moments.append("\n".join(line.plain for line in lines))

    look()
    show.on_scan = look
    played(show)
    track = show.tracks[0]
    assert len(moments) == 62
    for k, text in enumerate(moments[1:]):
        assert ("WRONG" in text) == (track.label[k] != track.manoeuvre[k])
        said = Manoeuvre(track.manoeuvre[k]).name
        assert re.search(rf"said +{said}", text)
        assert re.search(rf"▸{Manoeuvre(track.label[k]).name}", text)
        for i in range(4):
            assert f"{track.z[k, i] + 0.0:.2f}".replace("-0.00", "0.00") in text
    # on the road: what the tap has decoded from the bus
    assert f"LANE_CHANGE left {100 * track.p[32].max():.0f} %" in moments[34]
    assert re.findall(r"(\w{3})#", moments[-1]) == ["300", "301", "310", "311"]


def test_the_live_view_leaves_the_terminal_as_it_was(two):
    console = terminal()
    show = DemoRun(str(two), "two-lane", 1)
    with LiveView(show, console, "title", 6.0):
        show.play(6.0)
    written = console.file.getvalue()
    assert written.count("\x1b[?1049h") == written.count("\x1b[?1049l") == 1
    assert written.index("\x1b[?1049h") < written.index("left lane") < written.index("\x1b[?1049l")
    assert written.rindex("\x1b[?25l") < written.rindex("\x1b[?25h")  # the cursor is back


def test_a_view_needs_a_terminal_of_some_size():
    assert fits(terminal())
    assert not fits(terminal(79, 24))
    assert not fits(terminal(80, 23))
    assert not fits(Console(file=io.StringIO(), width=80, height=24))
    assert not fits(terminal(_environ={"TERM": "dumb"}))
    ascii_only = io.TextIOWrapper(io.BytesIO(), "ascii")
    assert not fits(terminal(file=ascii_only))


def where(road, letter="█"):
    return [
        (row, column)
        for row, line in enumerate(road.lines())
        for column, cell in enumerate(line.plain)
        if cell == letter
    ]


def test_the_road_has_left_above_and_far_at_the_right():
    def place(x, y):
        road = Road(3.0, 74.0, 80, 3)
        ego = set(where(road))
        road.add(Car(x, y, "", "red"))
        rows, columns = zip(*(set(where(road)) - ego), strict=True)
        return min(rows), max(rows), min(columns), max(columns)

    # one cell is a metre; the line of the middle is number 4, edges are 0 and 8
    right, left, between = place(50.0, 0.0), place(50.0, 3.0), place(50.0, 1.5)
    assert 4 < right[0] <= right[1] < 8
    assert 0 < left[0] <= left[1] < 4
    assert right[0] + left[1] == right[1] + left[0] == 8
    assert between[0] + between[1] == 8
    assert right[2:] == (56, 59)
    assert place(20.0, 0.0)[2:] == (26, 29)


def test_the_road_keeps_labels_and_cars_inside():
    for x, y in ((70.0, 0.0), (-5.0, 0.0), (40.0, 9.0), (40.0, -9.0), (500.0, 0.0)):
        road = Road(3.0, 74.0, 80, 2)
        road.add(Car(x, y, "APPROACHING 100 %", "red"))
        assert {len(line.plain) for line in road.lines()} == {80}
    road = Road(3.0, 74.0, 80, 2)
    road.add(Car(70.0, 0.0, "APPROACHING 100 %", "red"))
    assert any("APPROACHING 100 % ███" in line.plain for line in road.lines())


def timeline(said, at=99, width=107):
    """Bands of 10 s: keep right for 5 s, then receding; a cell is a scan."""
    label = np.repeat([Manoeuvre.KEEP_RIGHT, Manoeuvre.RECEDING], 50)
    t_ns = np.arange(100) * 100_000_000
    track = SimpleNamespace(
        t_ns=t_ns, label=label, manoeuvre=np.array(said), rows=lambda at_ns: at + 1
    )
    return [line.plain.ljust(width)[6:106] for line in bands(track, at, 10_000_000_000, width)]


def test_bands_show_true_above_said_and_where_they_differ():
    said = [Manoeuvre.KEEP_RIGHT] * 54 + [Manoeuvre.RECEDING] * 46
    true, heard, differs, scale = timeline(said)
    assert true[:50].strip() == "KEEP_RIGHT"
    assert true[50:].strip() == "RECEDING"
    assert heard[:54].strip() == "KEEP_RIGHT"
    assert heard[54:].strip() == "RECEDING"
    assert [c for c in range(100) if differs[c] != " "] == [50, 51, 52, 53]
    assert scale[0:2] == "0s"
    assert scale[50] == "5"


def test_bands_of_what_is_still_to_come_are_silent():
    said = [Manoeuvre.KEEP_RIGHT] * 20 + [Manoeuvre.UNKNOWN] * 80
    true, heard, differs, _ = timeline(said, at=19)
    assert true[50:].strip() == "RECEDING"
    assert heard[:20].strip() == "KEEP_RIGHT"
    assert heard[20:].strip() == differs.strip() == ""


def test_every_manoeuvre_can_be_said():
    """A motorway's preset may be asked about the road of two lanes."""
    assert set(COLOURS) == set(Manoeuvre)
    said = [Manoeuvre.KEEP_LANE] * 50 + [Manoeuvre.ONCOMING] * 46 + [Manoeuvre.STATIONARY] * 4
    _, heard, differs, _ = timeline(said)
    assert heard[:50].strip() == "KEEP_LANE"
    assert heard[50:].split() == ["ONCOMING", "ST"]
    assert differs.strip() == "▀" * 100


def test_the_bars_are_the_manoeuvres_of_the_two_lane_road():
    assert [m.name for m in TWO_LANES] == [
        "KEEP_RIGHT", "LANE_CHANGE", "KEEP_LEFT", "OVERTAKING", "RECEDING", "APPROACHING",
        "REAR_END",
    ]  # fmt: skip


# --- compilation ---------------------------------------------------------------------------------


def test_compilation_is_announced_once_and_only_when_it_happens(capsys):
    from numba import njit

    @njit
    def one(x):
        return x + 1

    @njit
    def other(x):
        return one(x) + 1

    before = signal.getsignal(signal.SIGINT)
    with announced():
        assert signal.getsignal(signal.SIGINT) is signal.SIG_DFL
        other(1)
    assert signal.getsignal(signal.SIGINT) is before
    assert capsys.readouterr().err.count("compiling") == 1
    with announced():
        other(2)
    other(1.0)
    assert capsys.readouterr().err == ""
