"""``can-imm simulate``: logs, truth, scenarios, a bus in real time."""

from __future__ import annotations

import csv
import threading
import time
from dataclasses import replace

import can
import numpy as np
import pytest

from can_imm.bus.decoder import ScanDecoder
from can_imm.bus.profile import load_profile
from can_imm.bus.sources import LogSource
from can_imm.sim.motorway import TUNING, VARIANTS
from can_imm.types import Manoeuvre


@pytest.fixture
def no_config(monkeypatch, tmp_path):
    """python-can finds no configuration of the user's."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HOME", str(tmp_path))
    for name in ("INTERFACE", "CHANNEL", "BITRATE", "CONFIG"):
        monkeypatch.delenv(f"CAN_{name}", raising=False)


def test_log_holds_a_scan_every_100_ms(can_imm, scenario, tmp_path):
    path = tmp_path / "sent.log"
    status, out, err = can_imm("simulate", "--scenario", scenario, "--log", path)
    assert status == 0
    assert out == ""
    assert "122 frames" in err
    with LogSource(path) as source:
        frames = list(source)
    assert [f.t_ns for f in frames if f.id == 0x300] == [k * 100_000_000 for k in range(61)]
    assert [f.id for f in frames] == [0x300, 0x301] * 61


def test_truth_file(can_imm, scenario, tmp_path):
    path = tmp_path / "truth.csv"
    status, _, _ = can_imm("simulate", "--scenario", scenario, "--truth", path)
    assert status == 0
    with path.open() as file:
        rows = list(csv.DictReader(file))
    header = path.read_text().splitlines()[0]
    assert header == "time_s,object_id,manoeuvre,lane,direction,x,vx,y,vy"
    assert [r["time_s"] for r in rows[:3]] == ["0.000000", "0.010000", "0.020000"]
    by_time = {r["time_s"]: r for r in rows}
    assert by_time["1.990000"]["manoeuvre"] == "KEEP_RIGHT"
    assert by_time["2.000000"]["manoeuvre"] == "LANE_CHANGE"
    assert by_time["2.000000"]["direction"] == "left"
    assert by_time["5.000000"]["manoeuvre"] == "KEEP_LEFT"
    assert float(by_time["5.000000"]["y"]) == pytest.approx(3.0, abs=0.2)
    assert {r["manoeuvre"] for r in rows} <= {m.name for m in Manoeuvre}


def test_seed_decides(can_imm, scenario, tmp_path):
    contents = []
    for seed in (1, 1, 2):
        path = tmp_path / "sent.log"
        can_imm("simulate", "--scenario", scenario, "--seed", seed, "--log", path)
        contents.append(path.read_bytes())
    assert contents[0] == contents[1] != contents[2]


def test_random_scenario(can_imm, tmp_path):
    truths = []
    for seed in (1, 2):
        path = tmp_path / f"{seed}.csv"
        status, _, _ = can_imm("simulate", "--scenario", "random", "--seed", seed, "--truth", path)
        assert status == 0
        truths.append(path.read_text())
    assert truths[0] != truths[1]


def test_losses(can_imm, scenario, tmp_path):
    path = tmp_path / "sent.log"
    can_imm("simulate", "--scenario", scenario, "--log", path, "--dropout", 0.5, "--missed", 0.5)
    with LogSource(path) as source:
        ids = [f.id for f in source]
    assert 10 < ids.count(0x300) < 50
    assert 0 < ids.count(0x301) < ids.count(0x300)


@pytest.mark.parametrize("profile", ["can_imm", "ars408", "toyota", "toyota-tss2", "esr"])
def test_motorway(can_imm, tmp_path, monkeypatch, profile):
    monkeypatch.setitem(VARIANTS, "tuning", replace(TUNING, duration=30.0))
    log, truth = tmp_path / "drive.log", tmp_path / "truth.csv"
    status, out, err = can_imm(
        "simulate", "--scenario", "motorway", "--seed", 4, "--profile", profile, "--log", log,
        "--truth", truth,
    )  # fmt: skip
    assert status == 0
    assert out == ""
    assert "scans" in err
    with truth.open() as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0]) == [
        "time_s", "object_id", "manoeuvre", "lane", "direction", "event", "x", "vx", "y", "vy",
        "speed",
    ]  # fmt: skip
    assert {"KEEP_LANE", "STATIONARY", "ONCOMING"} <= {row["manoeuvre"] for row in rows}
    places: dict[str, list[list[float]]] = {}
    for row in rows:
        places.setdefault(row["time_s"], []).append([float(row["x"]), float(row["y"])])

    decoder = ScanDecoder(load_profile(profile), 100)
    errors, speeds, times = [], [], []
    with LogSource(log) as source:
        for frame in source:
            scan = decoder.feed(frame)
            if scan is None:
                continue
            times.append(scan.t_ns)
            speeds.append(scan.ego_speed)
            there = np.array(places[f"{scan.t_ns / 1e9:.6f}"])
            n = scan.n
            cos, sin = np.cos(scan.angle[:n]), np.sin(scan.angle[:n])
            x = cos * scan.z[:n, 0] - sin * scan.z[:n, 2]
            y = sin * scan.z[:n, 0] + cos * scan.z[:n, 2]
            away = np.hypot(x[:, None] - there[:, 0], y[:, None] - there[:, 1])
            errors += (away.min(axis=1) / np.maximum(np.hypot(x, y), 50.0)).tolist()
    period = {"can_imm": 100, "ars408": 1000 / 14}.get(profile, 50)
    assert len(times) > 0.97 * 30_000 / period
    assert len(errors) > 4 * len(times)
    assert np.mean(errors) < 0.01
    assert np.quantile(errors, 0.999) < 0.05
    known = np.isfinite(speeds)
    assert known[5:].all()
    assert 15.0 < np.nanmin(speeds) < np.nanmax(speeds) < 40.0


def test_motorway_settings_and_losses(can_imm, tmp_path):
    contents = []
    for options in ((), ("--settings", "tuning"), ("--settings", "reporting"), ("--dropout", 0.5)):
        path = tmp_path / "drive.log"
        status, _, _ = can_imm("simulate", "--scenario", "motorway", "--log", path, *options)
        assert status == 0
        contents.append(path.read_text())
    assert contents[0] == contents[1] != contents[2]
    heads = [content.count(" 300#") for content in contents]
    assert heads[0] > 580
    assert 240 < heads[3] < 360


def test_on_a_bus_in_real_time_with_truth_in_bus_time(can_imm, tmp_path, no_config):
    scenario = tmp_path / "one.toml"
    scenario.write_text(
        'duration = 1.0\n[[object]]\nid = 1\ngap = 30.0\nlane = "right"\n'
        'segments = [{ start = 0.0, label = "KEEP_RIGHT" }]\n'
    )
    truth = tmp_path / "truth.csv"
    got: list[can.Message] = []
    with can.Bus(interface="virtual", channel="simulate-test", ignore_config=True) as bus:

        def listen() -> None:
            while (message := bus.recv(3.0)) is not None:
                got.append(message)
                if len(got) == 22:
                    return

        listener = threading.Thread(target=listen)
        listener.start()
        before = time.time()
        status, _, err = can_imm(
            "simulate", "-i", "virtual", "-c", "simulate-test", "--scenario", scenario,
            "--truth", truth,
        )  # fmt: skip
        listener.join()
    assert status == 0
    assert "22 frames" in err
    heads = [m.timestamp for m in got if m.arbitration_id == 0x300]
    assert len(heads) == 11
    with truth.open() as file:
        first = float(next(csv.DictReader(file))["time_s"])
    assert first > before
    # frames leave at their time or, on a busy machine, a little later
    for k, at in enumerate(heads):
        assert -0.001 <= at - (first + 0.1 * k) < 0.2


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["--scenario", "nope"], "nope"),
        (["--scenario", "/no/such.toml", "--log", "x.log"], "/no/such.toml"),
        (["--log", "/no/such/dir/x.log"], "/no/such/dir/x.log"),
        (["--log", "x.nope"], "x.nope"),
        (["--truth", "/no/such/dir/x.csv"], "/no/such/dir/x.csv"),
        (["--log", "x.log", "--missed", "1.5"], "missed"),
        (["--log", "x.log", "--seed", "-1"], "seed"),
        (["--log", "x.log", "--scenario", "motorway", "--profile", "nope"], "nope"),
        (["--log", "x.log", "--scenario", "motorway", "--settings", "nope"], "nope"),
        (["--log", "x.log", "--scenario", "motorway", "--missed", "1.5"], "missed"),
        (["--log", "x.log", "--profile", "esr"], "profile"),
        (["-i", "socketcan", "-c", "no_such_bus"], "no_such_bus"),
        ([], "cannot open bus"),
    ],
)
def test_refusals_are_one_line(can_imm, no_config, arguments, named):
    status, out, err = can_imm("simulate", *arguments)
    assert status == 1
    assert out == ""
    assert err.count("\n") == 1
    assert err.startswith("can-imm: error: ")
    assert named in err
