"""``can-imm replay``: what it writes, what it says, what it refuses."""

from __future__ import annotations

import csv
import io
import json
import re
import time
from pathlib import Path

import numpy as np
import pytest

from can_imm.bus.encoder import OUTPUT_IDS
from can_imm.bus.listener import EstimateMessage, ManoeuvreDecoder, ManoeuvreMessage
from can_imm.bus.profile import load_profile
from can_imm.bus.radar_encoder import ProfileEncoder
from can_imm.bus.sinks import LogSink
from can_imm.bus.sources import LogSource
from can_imm.types import Manoeuvre, Scan

COLUMNS = (
    "time_s,object_id,manoeuvre,probability,lane,direction,x,vx,y,vy,p_keep_right,p_lane_change,"
    "p_keep_left,p_overtaking,p_receding,p_approaching,p_rear_end"
)


REAL_LOG = Path(__file__).parents[3] / "shared/data/comma2k19/comma2k19_rav4_radar_tracks.log"


def rows_of(text: str) -> list[dict[str, str]]:
    return list(csv.DictReader(io.StringIO(text)))


def test_csv_has_a_row_per_object_and_scan(can_imm, log, tmp_path):
    path = tmp_path / "reports.csv"
    status, _, _ = can_imm("replay", log, "--csv", path)
    assert status == 0
    text = path.read_text()
    assert text.splitlines()[0] == COLUMNS
    rows = rows_of(text)
    assert [row["time_s"] for row in rows] == [f"{k // 10}.{k % 10}00000" for k in range(61)]
    assert {row["object_id"] for row in rows} == {"3"}
    said = [row["manoeuvre"] for row in rows]
    assert said[15] == "KEEP_RIGHT"
    assert said[30] == "LANE_CHANGE"
    assert rows[30]["direction"] == "left"
    assert said[58] == "KEEP_LEFT"
    assert rows[15]["lane"] == "0"
    assert rows[58]["lane"] == "1"
    for row in rows[5:]:
        chances = {key: float(value) for key, value in row.items() if key.startswith("p_")}
        assert sum(chances.values()) == pytest.approx(1, abs=1e-3)
        assert chances[f"p_{row['manoeuvre'].lower()}"] == pytest.approx(
            float(row["probability"]), abs=1e-3
        )
    assert float(rows[58]["x"]) == pytest.approx(40, abs=0.5)
    assert float(rows[58]["y"]) == pytest.approx(3, abs=0.3)


def test_csv_on_standard_output_leaves_the_summary_to_standard_error(can_imm, log):
    status, out, err = can_imm("replay", log, "--csv", "-")
    assert status == 0
    assert len(rows_of(out)) == 61
    assert "122 read" in err


def test_summary(can_imm, log):
    status, out, err = can_imm("replay", log)
    assert status == 0
    assert err == ""
    lines = {line.split()[0]: line for line in out.splitlines() if line.startswith("  ")}
    assert "122 read, 122 used" in lines["frames"]
    assert "122 right, 0 wrong" in lines["checksums"]
    assert lines["rejected"].split() == ["rejected", "0"]
    assert "61 complete, 0 incomplete" in lines["scans"]
    assert "1 seen" in lines["objects"]
    assert "0 bad" in lines["lines"]
    assert lines["manoeuvres"].startswith("  manoeuvres 1 object; of their time: ")
    shares = [float(x) for x in re.findall(r"([\d.]+) %", lines["manoeuvres"])]
    assert sum(shares) == pytest.approx(100, abs=0.3)
    changes = re.findall(
        r"^ +([\d.]+) +([\d.]+) +3  lane change left +0 to 1 +[\d.]+ +40\.\d +39\.\d",
        out,
        re.MULTILINE,
    )
    assert len(changes) == 1
    assert 2.0 <= float(changes[0][0]) <= 3.0
    assert 3.0 <= float(changes[0][1]) <= 4.6


def test_broken_input_is_counted_and_survived(can_imm, log, tmp_path):
    lines = log.read_text().splitlines(keepends=True)
    assert " 301#" in lines[41]
    lines[41] = lines[41].replace("#", "#F", 1)[: len(lines[41]) - 1] + "\n"
    lines[50:50] = [
        "DROPCOUNT: dropped 12 CAN frames on 'can0' socket\n",
        "garbage\n",
        "(1.5) can0 3\n",
    ]
    lines.append("(6.050000) can0 7FF#00\n")
    path = tmp_path / "broken.log"
    path.write_text("".join(lines))
    status, out, _ = can_imm("replay", path)
    assert status == 0
    assert "1 wrong" in out
    assert "1 (1 wrong checksum)" in out
    assert "60 complete, 1 incomplete" in out
    assert "2 bad, 12 frames lost" in out
    assert "1 unknown" in out


@pytest.mark.parametrize("suffix", [".asc", ".blf", ".csv.gz"])
def test_out_merges_input_and_answers_in_any_format(can_imm, log, tmp_path, suffix):
    out = tmp_path / f"merged{suffix}"
    status, _, _ = can_imm("replay", log, "--out", out)
    assert status == 0
    with LogSource(log) as source:
        received = [(f.t_ns, f.id, f.data) for f in source]
    with LogSource(out) as source:
        merged = [(f.t_ns, f.id, f.data) for f in source]
    first = merged[0][0]
    assert [(t - first, i, d) for t, i, d in merged if i not in OUTPUT_IDS] == received
    assert sum(i == 0x310 for _, i, _ in merged) == 61
    assert [t for t, _, _ in merged] == sorted(t for t, _, _ in merged)


def test_answers_of_an_earlier_detector_are_replaced(can_imm, log, tmp_path):
    first, second = tmp_path / "first.log", tmp_path / "second.log"
    can_imm("replay", log, "--out", first)
    status, out, _ = can_imm("replay", first, "--out", second)
    assert status == 0
    assert second.read_bytes() == first.read_bytes()
    assert f"{2 * 61 + 61:,} manoeuvre frames of an earlier detector" in out


def test_realtime_takes_as_long_as_the_log(can_imm, log, tmp_path):
    short = tmp_path / "short.log"
    short.write_text("".join(log.read_text().splitlines(keepends=True)[:20]))  # 0.9 s
    can_imm("replay", short)
    began = time.monotonic()
    status, _, _ = can_imm("replay", short, "--realtime")
    assert status == 0
    assert time.monotonic() - began >= 0.9


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["missing.log"], "missing.log"),
        (["{log}.xyz"], ".xyz"),
        (["{log}", "--profile", "nope"], "nope"),
        (["{log}", "--profile", "nope.toml"], "nope.toml"),
        (["{log}", "--preset", "nope"], "nope"),
        (["{log}", "--csv", "/no/such/dir/x.csv"], "/no/such/dir/x.csv"),
        (["{log}", "--out", "/no/such/dir/x.log"], "/no/such/dir/x.log"),
        (["{log}", "--out", "x.nope"], "x.nope"),
        (["{log}", "--out", "{log}"], "this is the log that is read"),
        (["{log}", "--events", "x.xml"], "x.xml"),
        (["{log}", "--events", "/no/such/dir/x.csv"], "/no/such/dir/x.csv"),
        (["{log}", "--plot", "/no/such/dir/x.png"], "/no/such/dir/x.png"),
        (["{log}", "--plot", "x.gif"], "x.gif"),
        (["{log}", "--sensor", "3"], "not 3"),
        (["{log}", "--lag", "-1"], "-1"),
        (["{log}", "--lag", "nan"], "nan"),
        (["{log}", "--lag", "0"], "a step of the loop or longer, not 0 s"),
    ],
)
def test_refusals_are_one_line(can_imm, log, arguments, named):
    status, out, err = can_imm("replay", *(a.format(log=log) for a in arguments))
    assert status == 1
    assert out == ""
    assert err.count("\n") == 1
    assert err.startswith("can-imm: error: ")
    assert named in err


def test_an_empty_log_is_refused(can_imm, tmp_path):
    path = tmp_path / "empty.log"
    path.write_text("")
    status, _, err = can_imm("replay", path)
    assert status == 1
    assert err.count("\n") == 1
    assert "empty.log" in err


def test_a_truncated_log_gives_what_it_holds(can_imm, log, tmp_path):
    whole, cut = tmp_path / "whole.blf", tmp_path / "cut.blf"
    with LogSource(log) as source, LogSink(whole) as sink:
        for frame in source:
            sink.send(frame)
    data = whole.read_bytes()
    cut.write_bytes(data[: len(data) - 40])
    status, out, err = can_imm("replay", cut)
    assert status in (0, 1)
    assert "Traceback" not in err
    assert ("cut.blf" in out) or ("cut.blf" in err)


@pytest.mark.skipif(not REAL_LOG.is_file(), reason="no recorded data beside the repository")
def test_the_lane_change_on_a_real_road(can_imm, tmp_path):
    """Track 0x212 moves over to the right between 5 and 10 s; the middle is at 7.5 s."""
    path = tmp_path / "reports.csv"
    status, out, _ = can_imm("replay", REAL_LOG, "--profile", "toyota", "--csv", path)
    assert status == 0
    assert "38,400 read" in out
    assert "19,200 right, 0 wrong" in out
    began = 46408.587652
    changes = [
        [float(x) - began for x in line.split()[:2]]
        for line in out.splitlines()
        if line.split()[2:6] == ["2", "lane", "change", "right"]
    ]
    middle = [sum(change) / 2 for change in changes if 4.0 < change[0] < 9.0]
    assert len(middle) == 1
    assert middle[0] == pytest.approx(7.5, abs=1.0)
    rows = [row for row in rows_of(path.read_text()) if row["object_id"] == "2"]
    said = [row for row in rows if 5.5 < float(row["time_s"]) - began < 11.0]
    assert {row["direction"] for row in said if row["manoeuvre"] == "LANE_CHANGE"} == {"right"}


def test_events_go_to_a_file(can_imm, log, tmp_path):
    path = tmp_path / "events.csv"
    assert can_imm("replay", log, "--events", path)[0] == 0
    rows = rows_of(path.read_text())
    changes = [row for row in rows if row["manoeuvre"] == "LANE_CHANGE"]
    assert {row["log"] for row in rows} == {str(log)}
    assert [(row["object_id"], row["direction"]) for row in changes] == [("3", "left")]
    assert (changes[0]["lane_from"], changes[0]["lane_to"]) == ("0", "1")
    assert float(changes[0]["gap_m"]) == pytest.approx(40, abs=0.5)
    assert float(changes[0]["mean_probability"]) > 0.5


def test_a_picture(can_imm, log, tmp_path):
    path = tmp_path / "drive.png"
    assert can_imm("replay", log, "--plot", path)[0] == 0
    assert path.read_bytes().startswith(b"\x89PNG")


def test_several_logs_are_as_many_recordings(can_imm, log, tmp_path):
    """Each is answered as if it were alone: the second does not see the first one's tracks."""
    alone, both, events = (tmp_path / name for name in ("alone.csv", "both.csv", "events.json"))
    other = tmp_path / "other.log"
    other.write_text("".join(log.read_text().splitlines(keepends=True)[60:]))
    expected = []
    for path in (log, other):
        assert can_imm("replay", path, "--csv", alone)[0] == 0
        expected += [f"{line},{path}" for line in alone.read_text().splitlines()[1:]]
    status, out, err = can_imm("replay", log, other, "--csv", both, "--events", events)
    assert (status, err) == (0, "")
    lines = both.read_text().splitlines()
    assert lines[0] == f"{COLUMNS},log"
    assert lines[1:] == expected
    assert [part["log"] for part in json.loads(events.read_text())] == [str(log), str(other)]
    assert out.index(str(log)) < out.index(str(other))


def test_a_broken_log_does_not_stop_the_others(can_imm, log, tmp_path):
    empty, path = tmp_path / "empty.log", tmp_path / "both.csv"
    empty.write_text("")
    status, out, err = can_imm("replay", tmp_path / "missing.log", empty, log, "--csv", path)
    assert status == 1
    errors = err.splitlines()
    assert len(errors) == 2
    assert all(line.startswith("can-imm: error: ") for line in errors)
    assert "missing.log" in errors[0]
    assert "empty.log" in errors[1]
    assert "61 complete" in out
    assert len(rows_of(path.read_text())) == 61


def test_pictures_of_several_logs_go_to_a_directory(can_imm, log, tmp_path):
    other = tmp_path / "other.log"
    other.write_text(log.read_text())
    assert can_imm("replay", log, other, "--plot", tmp_path)[0] == 0
    assert {path.name for path in tmp_path.glob("*.png")} == {"sensor.log.png", "other.log.png"}


@pytest.mark.parametrize(
    ("option", "why"),
    [("--out", "--out takes one log, not 2"), ("--plot", "this must be a directory")],
)
def test_what_takes_one_log_is_refused_with_several(can_imm, log, tmp_path, option, why):
    path = tmp_path / "x.png"
    status, out, err = can_imm("replay", log, log, option, path)
    assert status == 2
    assert out == ""
    assert why in err.splitlines()[-1]
    assert not path.exists()


@pytest.mark.parametrize("option", [("--smooth",), ("--lag", "1.0")])
def test_hindsight_knows_of_the_lane_change_from_its_beginning(can_imm, log, tmp_path, option):
    """Same rows; fewer wrong labels than at the time; the picture and the events too."""
    plain, better = tmp_path / "plain.csv", tmp_path / "better.csv"
    frames, again = tmp_path / "frames.log", tmp_path / "again.log"
    events, picture = tmp_path / "events.csv", tmp_path / "drive.png"
    assert can_imm("replay", log, "--csv", plain, "--out", frames)[0] == 0
    files = ("--csv", better, "--out", again, "--events", events, "--plot", picture)
    assert can_imm("replay", log, *option, *files)[0] == 0
    assert (again.read_bytes() == frames.read_bytes()) == (option == ("--smooth",))
    before, after = rows_of(plain.read_text()), rows_of(better.read_text())
    for column in ("time_s", "object_id"):
        assert [row[column] for row in after] == [row[column] for row in before]

    def wrong(rows: list[dict[str, str]]) -> int:
        truth = ["KEEP_RIGHT"] * 20 + ["LANE_CHANGE"] * 20 + ["KEEP_LEFT"] * 21
        return sum(row["manoeuvre"] != label for row, label in zip(rows, truth, strict=True))

    assert wrong(after) < wrong(before)
    (change,) = (r for r in rows_of(events.read_text()) if r["manoeuvre"] == "LANE_CHANGE")
    said = [row["time_s"] for row in after if row["manoeuvre"] == "LANE_CHANGE"]
    assert (change["from_s"], change["to_s"]) == (said[0], said[-1])
    assert picture.is_file()


def test_both_kinds_of_hindsight_are_one_too_many(can_imm, log):
    status, _, err = can_imm("replay", log, "--smooth", "--lag", "1")
    assert status == 2
    assert "not both" in err


@pytest.mark.parametrize(
    ("speed", "said"),
    [
        (30.0, "20 frames"),
        (160.0, "20 frames; impossible in 10 scans"),
        (None, "not on this bus: nothing is said to stand still"),
    ],
)
def test_the_summary_says_what_was_heard_of_the_ego_motion(can_imm, tmp_path, speed, said):
    path, encoder = tmp_path / "drive.log", ProfileEncoder(load_profile("ars408"))
    scan = Scan(1)
    scan.n, scan.ids[0], scan.z[0], scan.valid[0] = 1, 5, (40.0, 0.0, 0.0, 0.0), True
    with LogSink(path) as sink:
        for t_ns in range(0, 1_000_000_000, 100_000_000):
            ego = [] if speed is None else encoder.encode_ego(speed, 0.0, t_ns)
            for frame in ego + encoder.encode(scan, t_ns):
                sink.send(frame)
    status, out, _ = can_imm("replay", path, "--profile", "ars408", "--preset", "motorway")
    assert status == 0
    [line] = [line for line in out.splitlines() if line.startswith("  ego motion ")]
    line = line.removeprefix("  ego motion ").strip()
    assert line == said if speed else line.startswith(said)
    assert "rejected   0\n" in out


def test_a_straight_road_is_one_of_the_preset_motorway(can_imm, log):
    status, out, err = can_imm("replay", log, "--straight-road")
    assert (status, out) == (1, "")
    assert err.count("\n") == 1
    assert "two-lane" in err
    assert "no [road]" in err
    assert can_imm("replay", log, "--straight-road", "--preset", "motorway")[0] == 0


def test_lagged_frames_come_late_and_say_what_the_csv_says(can_imm, log, tmp_path):
    """Each scan's a second after the scan, those of the last second in the last step."""
    out, table = tmp_path / "out.log", tmp_path / "said.csv"
    assert can_imm("replay", log, "--lag", "1", "--out", out, "--csv", table)[0] == 0
    decoder, rows = ManoeuvreDecoder(), rows_of(table.read_text())
    seen = [(frame.t_ns, decoder.feed(frame)) for frame in LogSource(out)]
    states = [(t, m) for t, m in seen if isinstance(m, ManoeuvreMessage)]
    assert [t for t, _ in states] == [min(10 + k, 60) * 100_000_000 for k in range(61)]
    assert [Manoeuvre(m.manoeuvre).name for _, m in states] == [r["manoeuvre"] for r in rows]
    places = [(m.x, m.y) for _, m in seen if isinstance(m, EstimateMessage)]
    wanted = [(float(row["x"]), float(row["y"])) for row in rows]
    assert np.array(places) == pytest.approx(np.array(wanted), abs=0.04)


def test_a_replay_of_a_lagged_replay_changes_nothing(can_imm, log, tmp_path):
    once, twice = tmp_path / "once.log", tmp_path / "twice.log"
    assert can_imm("replay", log, "--lag", "0.5", "--out", once)[0] == 0
    assert can_imm("replay", once, "--lag", "0.5", "--out", twice)[0] == 0
    assert twice.read_bytes() == once.read_bytes()


def test_lagged_estimates_at_every_step_are_refused(can_imm, log, tmp_path):
    out = tmp_path / "out.log"
    for command in (["replay", log, "--out", out], ["detect", "-i", "virtual", "--log", out]):
        status, said, err = can_imm(*command, "--lag", "1", "--estimates", "step")
        assert (status, said) == (2, "")
        assert "not both" in err.splitlines()[-1]
        assert not out.exists()


def test_estimates_at_every_step(can_imm, log, tmp_path):
    """Predicted ones between the scans: a hundred a second, on a line at the object's speed."""
    few, many = tmp_path / "few.log", tmp_path / "many.log"
    assert can_imm("replay", log, "--out", few)[0] == 0
    assert can_imm("replay", log, "--out", many, "--estimates", "step")[0] == 0
    decoder = ManoeuvreDecoder()
    seen = [(frame.t_ns, decoder.feed(frame)) for frame in LogSource(many)]
    places = {t: message for t, message in seen if isinstance(message, EstimateMessage)}
    first = min(places)
    assert sorted(places) == list(range(first, max(places) + 1, 10_000_000))
    changing = [places[t] for t in range(3_010_000_000, 3_100_000_000, 10_000_000)]
    steps = np.diff([place.y for place in changing])
    assert steps == pytest.approx(0.01 * changing[0].vy, abs=0.021)  # the resolution is .02 m
    assert sum(steps) > 0.06
    # what is said at the scans is the same, but for the counters and checksums of ObjectEstimate
    assert [f for f in LogSource(few) if f.id == 0x310] == [
        f for f in LogSource(many) if f.id == 0x310
    ]
