"""Sender and detector in two processes without any CAN in the kernel."""

from __future__ import annotations

import json
import re
import signal
import time

import can
import pytest

GROUP, PORT = "239.74.163.77", "43177"
BUS = ("-i", "udp_multicast", "-c", GROUP, "--bus-kwargs", f"port={PORT}", "hop_limit=0")


@pytest.fixture
def multicast():
    try:
        with can.Bus(
            interface="udp_multicast",
            channel=GROUP,
            port=int(PORT),
            hop_limit=0,
            ignore_config=True,
        ) as bus:
            bus.send(can.Message(arbitration_id=1))
            if bus.recv(0.5) is None:
                pytest.skip("multicast does not come back on this machine")
    except (can.CanError, OSError) as error:
        pytest.skip(f"no multicast on this machine: {error}")


def test_two_processes(can_imm, scenario, tmp_path, multicast):
    log = tmp_path / "run.log"
    detector = can_imm("detect", "--log", log, *BUS)
    detector.wait_for("listening on")
    status, _ = can_imm("simulate", "--scenario", scenario, *BUS).end(None)
    assert status == 0
    time.sleep(0.3)
    status, summary = detector.end(signal.SIGINT)
    assert status == 0, detector.said
    assert "51 complete" in summary
    # the bus hands the detector's own frames back; they must not be recorded twice
    assert len(re.findall(r" 310#", log.read_text())) == 51


def test_the_latency_between_processes(can_imm, tmp_path, multicast):
    path = tmp_path / "latency.json"
    status, text = can_imm("latency", "--duration", "2", "--json", path, *BUS).end(None)
    assert status == 0
    figures = json.loads(path.read_text())
    assert figures["rounds"]["answered"] > 10
    assert figures["rounds"]["lost"] == 0
    # the stamps of three processes are of one clock
    assert 0 < figures["echo"]["p50_us"] < 20_000
    assert 0 < figures["stages"]["receive"]["p50_us"] < 20_000
    assert figures["stages"]["wait"]["max_us"] <= 12_000
    assert "of the echo" in text


def test_an_interrupted_measurement_ends_with_all_of_its_processes(can_imm, multicast):
    measurement = can_imm("latency", "--duration", "60", *BUS)
    options = {"interface": "udp_multicast", "channel": GROUP, "port": int(PORT), "hop_limit": 0}
    with can.Bus(**options, ignore_config=True) as bus:
        answers = (0x310, 0x7F1)
        end = time.monotonic() + 120
        while (message := bus.recv(1.0)) is None or message.arbitration_id not in answers:
            assert time.monotonic() < end
        status, _ = measurement.end(signal.SIGINT)
        assert status == 130
        while bus.recv(0) is not None:
            pass
        assert bus.recv(0.5) is None
