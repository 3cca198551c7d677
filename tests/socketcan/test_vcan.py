"""Our commands as processes on vcan0, beside can-utils."""

from __future__ import annotations

import re
import shutil
import signal
import socket
import struct
import subprocess
import time

import pytest

pytestmark = pytest.mark.socketcan

READY = "listening on"


def ip(*arguments: str) -> None:
    subprocess.run(["ip", "link", *arguments], check=True)


def candump_frames(text: str) -> list[tuple[str, str]]:
    """(id, data) of each line of ``candump -L``."""
    return re.findall(r"^\(\d+\.\d{6}\) \S+ ([0-9A-F]{3})#([0-9A-F]*)", text, re.MULTILINE)


def number_of(summary: str, what: str) -> int:
    """The number before ``what`` in a summary."""
    return int(re.search(rf"([\d,]+) {what}", summary)[1].replace(",", ""))


def send_raw(frames: list[tuple[int, bytes]], interface: str) -> None:
    with socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW) as bus:
        bus.bind((interface,))
        for frame_id, data in frames:
            bus.send(struct.pack("=IB3x8s", frame_id, len(data), data))


@pytest.fixture
def detect(can_imm, vcan0):
    """Return a function that starts ``can-imm detect`` on vcan0 and waits until it listens."""

    def start_detect(*arguments: str):
        process = can_imm("detect", "-i", "socketcan", "-c", vcan0, *map(str, arguments))
        process.wait_for(READY)
        return process

    return start_detect


def play(can_imm, scenario, *arguments: str) -> None:
    sender = can_imm(
        "simulate", "-i", "socketcan", "-c", "vcan0", "--scenario", scenario, *arguments
    )
    status, _ = sender.end(None)
    assert status == 0, sender.said


def test_simulate_and_detect_with_candump_listening(start, can_imm, detect, scenario, tmp_path):
    log, replayed = tmp_path / "run.log", tmp_path / "replayed.log"
    dump = start(shutil.which("candump") or "candump", "-L", "vcan0")
    detector = detect("--log", log)
    play(can_imm, scenario)
    time.sleep(0.3)
    status, summary = detector.end(signal.SIGTERM)
    assert status == 0, detector.said
    assert number_of(summary, "complete") == 51
    assert number_of(summary, "used") == 102
    _, dumped = dump.end(signal.SIGINT)
    on_bus = candump_frames(dumped)
    count = {frame_id: sum(f == frame_id for f, _ in on_bus) for frame_id, _ in on_bus}
    assert count["300"] == count["301"] == count["310"] == count["311"] == 51
    assert count["31F"] >= 50

    # what the detector recorded is what was on the bus, and the replay says the same once more
    def manoeuvres(frames):
        return [frame for frame in frames if frame[0] in ("310", "311")]

    recorded = log.read_text()
    assert manoeuvres(candump_frames(recorded)) == manoeuvres(on_bus)
    status, _ = can_imm("replay", log, "--out", replayed).end(None)
    assert status == 0
    stamped = re.compile(r"^\(.*\) \S+ 31[01]#.*$", re.MULTILINE)
    assert stamped.findall(replayed.read_text()) == stamped.findall(recorded)


def test_canplayer_plays_a_log_into_detect(start, can_imm, detect, scenario, tmp_path):
    log, table = tmp_path / "sensor.log", tmp_path / "reports.csv"
    assert can_imm("simulate", "--scenario", scenario, "--log", log).end(None)[0] == 0
    detector = detect("--csv", table)
    player = start(shutil.which("canplayer") or "canplayer", "-I", log, "vcan0=can0")
    assert player.end(None)[0] == 0
    time.sleep(0.3)
    status, summary = detector.end(signal.SIGINT)
    assert status == 0
    assert number_of(summary, "complete") == 51
    rows = table.read_text().splitlines()
    assert rows[0].startswith("time_s,object_id,manoeuvre")
    assert len(rows) == 1 + 51
    assert {row.split(",")[1] for row in rows[1:]} == {"3"}


def test_link_down_and_up_again_is_survived(can_imm, detect, scenario, root_rights):
    detector = detect()
    try:
        ip("set", "vcan0", "down")
        detector.wait_for("link down?")
        time.sleep(2.5)
    finally:
        ip("set", "vcan0", "up")
    detector.wait_for("works again")
    play(can_imm, scenario)
    time.sleep(0.3)
    status, summary = detector.end(signal.SIGTERM)
    assert status == 0
    assert number_of(summary, "complete") == 51
    assert number_of(summary, "not sent") >= 20
    assert sum("link down?" in line for line in detector.said) == 1


def test_a_bus_that_goes_away_ends_it_with_one_line(can_imm, vcan0, root_rights):
    ip("add", "dev", "vcan7", "type", "vcan")
    try:
        ip("set", "vcan7", "up")
        detector = can_imm("detect", "-i", "socketcan", "-c", "vcan7")
        detector.wait_for(READY)
    finally:
        ip("del", "vcan7")
    status, summary = detector.end(None)
    assert status == 1
    assert "frames" in summary
    assert len([line for line in detector.said if "error:" in line]) == 1
    assert not any("Traceback" in line for line in detector.said)


def test_a_bus_that_does_not_exist_is_refused(can_imm, vcan0):
    detector = can_imm("detect", "-i", "socketcan", "-c", "vcan99")
    status, _ = detector.end(None)
    assert status == 1
    assert len(detector.said) == 1
    assert "vcan99" in detector.said[0]


def test_a_burst_beyond_the_receive_queue_is_noticed(detect):
    detector = detect()
    detector.process.send_signal(signal.SIGSTOP)
    try:
        time.sleep(0.2)
        send_raw([(0x123, bytes(8))] * 2000, "vcan0")
    finally:
        detector.process.send_signal(signal.SIGCONT)
    line = detector.wait_for("receive queue")
    lost = int(re.search(r"(\d+) frames lost", line)[1])
    status, summary = detector.end(signal.SIGTERM)
    assert status == 0
    assert number_of(summary, "frames at a full receive queue") == lost
    assert number_of(summary, "unknown") + lost == 2000
    assert number_of(summary, "unknown") < 600


def test_another_log_format_on_the_way(can_imm, detect, scenario, tmp_path):
    sent, seen = tmp_path / "sent.asc", tmp_path / "seen.blf"
    detector = detect("--log", seen)
    play(can_imm, scenario, "--log", sent)
    time.sleep(0.3)
    assert detector.end(signal.SIGTERM)[0] == 0
    status, summary = can_imm("replay", seen).end(None)
    assert status == 0
    assert number_of(summary, "complete") == 51
    status, summary = can_imm("replay", sent).end(None)
    assert status == 0
    assert number_of(summary, "read") == 102
