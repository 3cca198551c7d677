"""``can-imm detect`` on a virtual bus in this process."""

from __future__ import annotations

import re
import signal
import subprocess
import sys
import threading
import time

import can
import pytest

from can_imm.bus.encoder import RadarEncoder
from can_imm.bus.frame import to_message
from can_imm.bus.sources import LogSource
from can_imm.types import Scan


class Neighbour:
    """Another node on the bus: sends scans and keeps what it hears, in a thread of its own."""

    def __init__(self, channel: str, n_scans: int) -> None:
        self.heard: list[can.Message] = []
        self._bus = can.Bus(interface="virtual", channel=channel, ignore_config=True)
        self._n = n_scans
        self._thread = threading.Thread(target=self._run)

    def __enter__(self) -> Neighbour:
        self._thread.start()
        return self

    def __exit__(self, *exc: object) -> None:
        self._thread.join()
        self._bus.shutdown()

    def _run(self) -> None:
        # the first heartbeat says that the detector listens; before it may have to compile
        first = self._bus.recv(300.0)
        assert first is not None
        self.heard.append(first)
        encoder = RadarEncoder()
        scan = Scan(1)
        scan.n, scan.ids[0], scan.z[0], scan.valid[0] = 1, 5, (40.0, 0.0, 0.0, 0.0), True
        for _ in range(self._n):
            for frame in encoder.encode(scan, 0):
                self._bus.send(to_message(frame))
            self._listen(0.1)
        self._listen(0.2)
        signal.raise_signal(signal.SIGTERM)

    def _listen(self, seconds: float) -> None:
        until = time.monotonic() + seconds
        while (left := until - time.monotonic()) > 0:
            message = self._bus.recv(left)
            if message is not None:
                self.heard.append(message)


def test_answers_on_the_bus_until_sigterm(can_imm, tmp_path):
    log, table = tmp_path / "all.log", tmp_path / "reports.csv"
    before = signal.getsignal(signal.SIGTERM)
    with Neighbour("detect-test", 8) as neighbour:
        status, out, err = can_imm(
            "detect", "-i", "virtual", "-c", "detect-test", "--log", log, "--csv", table
        )
    assert status == 0
    assert signal.getsignal(signal.SIGTERM) is before
    assert re.search(r"^can-imm: listening on .*detect-test", err, re.MULTILINE)
    assert "8 complete" in out
    assert "0 not sent" in out
    ids = [m.arbitration_id for m in neighbour.heard]
    assert ids[0] == 0x31F
    assert ids.count(0x310) == ids.count(0x311) == 8
    assert len(table.read_text().splitlines()) == 9
    with LogSource(log) as source:
        recorded = list(source)
    assert [f.id for f in recorded].count(0x301) == 8
    assert [f.id for f in recorded].count(0x310) == 8
    # the last word is that it stops
    assert recorded[-1].id == 0x31F
    assert recorded[-1].data[1] >> 4 & 7 == 3


def test_lagged_answers_on_the_bus_are_those_of_a_replay(can_imm, tmp_path):
    log, again = tmp_path / "all.log", tmp_path / "again.log"
    with Neighbour("lag-test", 8) as neighbour:
        status, _, _ = can_imm(
            "detect", "-i", "virtual", "-c", "lag-test", "--log", log, "--lag", 0.45
        )
    assert status == 0
    assert can_imm("replay", log, "--lag", 0.45, "--out", again)[0] == 0
    live, replayed = ([f for f in LogSource(path) if f.id != 0x31F] for path in (log, again))
    assert live == replayed
    times = {i: [f.t_ns for f in live if f.id == i] for i in (0x301, 0x310)}
    assert len(times[0x310]) == 8
    waits = [(b - a) / 1e9 for a, b in zip(times[0x301], times[0x310], strict=True)]
    assert waits[:3] == pytest.approx([0.46] * 3, abs=0.02)
    assert max(waits) < 0.5
    # the last ones, which wait no longer, before the word that it stops
    assert waits[-1] < 0.44
    assert [m.arbitration_id for m in neighbour.heard].count(0x310) < 8
    with LogSource(log) as source:
        assert [f.id for f in source][-3:] == [0x310, 0x311, 0x31F]


def test_realtime_says_what_was_granted():
    """In a process of its own, which keeps what it is granted."""
    command = "-m can_imm detect -i virtual -c realtime-test --duration 0.5 --realtime"
    done = subprocess.run(
        [sys.executable, *command.split()], capture_output=True, text=True, timeout=300, check=True
    )
    granted = re.search(r"^can-imm: granted: scheduler (\w+), .*", done.stderr, re.MULTILINE)
    assert granted
    assert granted[1] in ("fifo", "other")
    assert "collector on, frozen" in granted[0], "it works on, but what was there before is left"
    assert "switch interval s 0.005" in granted[0]
    assert "deadlines missed" in done.stdout


def test_duration_ends_it(can_imm):
    status, out, _ = can_imm("detect", "-i", "virtual", "-c", "duration-test", "--duration", 0.3)
    assert status == 0
    assert re.search(r"steps +30,", out)
    assert "no events" in out


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["-i", "socketcan", "-c", "no_such_bus"], "no_such_bus"),
        (["-i", "virtual", "--profile", "nope"], "nope"),
        (["-i", "virtual", "--preset", "nope"], "nope"),
        (["-i", "virtual", "--log", "/no/such/dir/x.log"], "/no/such/dir/x.log"),
    ],
)
def test_refusals_are_one_line(can_imm, arguments, named):
    status, out, err = can_imm("detect", *arguments)
    assert status == 1
    assert out == ""
    assert err.count("\n") == 1
    assert err.startswith("can-imm: error: ")
    assert named in err
