"""Sender and detector in two processes without any CAN in the kernel."""

from __future__ import annotations

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
