"""Live buses: those that open, those that do not, and those that fail while in use."""

from __future__ import annotations

import argparse
import errno
import socket
import time

import can
import can.cli
import pytest

from can_imm.bus import buses, sources
from can_imm.bus.buses import open_bus, open_bus_from_namespace
from can_imm.bus.frame import TX, Frame
from can_imm.bus.sinks import BusSink
from can_imm.bus.sources import BusGone, BusSource
from can_imm.types import CanImmError


@pytest.fixture(autouse=True)
def no_configuration(monkeypatch, tmp_path):
    """python-can looks into files and variables of whoever runs the tests."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HOME", str(tmp_path))
    for name in ("CAN_INTERFACE", "CAN_CHANNEL", "CAN_BITRATE", "CAN_CONFIG"):
        monkeypatch.delenv(name, raising=False)


@pytest.fixture
def pair():
    with open_bus("virtual", "t") as one, open_bus("virtual", "t") as two:
        yield one, two


def test_frames_over_a_virtual_bus(pair):
    sink, source = BusSink(pair[0]), BusSource(pair[1])
    sink.rehearse(Frame(0, 0x302, b"\x03"))
    before = time.time_ns()
    sink.send(Frame(0, 0x301, b"\x01\x02"))
    frame = source.recv(1.0)
    assert frame[1:] == (0x301, b"\x01\x02", "t", 0)
    assert before - 1000 <= frame.t_ns <= time.time_ns() + 1000
    assert source.recv(0.0) is None
    assert (sink.lost, source.errors) == (0, 0)
    sink.close()


def parsed(*arguments):
    parser = argparse.ArgumentParser()
    can.cli.add_bus_arguments(parser)
    return parser.parse_args(arguments)


def test_options_of_the_command_line():
    with open_bus_from_namespace(parsed("-i", "virtual", "-c", "u")) as bus:
        assert bus.channel_id == "u"


class Recorder:
    """Stands in for can.Bus and keeps what it was asked for."""

    def __call__(self, **settings):
        self.settings = settings
        return self


@pytest.fixture
def recorder(monkeypatch):
    recorder = Recorder()
    monkeypatch.setattr(can, "Bus", recorder)
    return recorder


def test_multicast_stays_on_the_machine_unless_told_otherwise(recorder):
    open_bus("udp_multicast")
    assert recorder.settings["channel"] == buses.MULTICAST_GROUP
    assert recorder.settings["hop_limit"] == 0
    open_bus("udp_multicast", "239.1.2.3", hop_limit=1)
    assert recorder.settings["channel"] == "239.1.2.3"
    assert recorder.settings["hop_limit"] == 1
    open_bus_from_namespace(parsed("-i", "udp_multicast"))
    assert recorder.settings["channel"] == buses.MULTICAST_GROUP
    assert recorder.settings["hop_limit"] == 0
    open_bus_from_namespace(parsed("-i", "udp_multicast", "-c", "239.9.9.9"))
    assert recorder.settings["channel"] == "239.9.9.9"
    open_bus("virtual")
    assert "hop_limit" not in recorder.settings


def test_multicast_by_configuration(recorder, monkeypatch):
    monkeypatch.setenv("CAN_INTERFACE", "udp_multicast")
    open_bus()
    assert recorder.settings["channel"] == buses.MULTICAST_GROUP
    monkeypatch.setenv("CAN_CHANNEL", "239.5.5.5")
    open_bus()
    assert "channel" not in recorder.settings


@pytest.mark.parametrize(
    ("interface", "channel"),
    [("socketcan", "nosuch0"), ("nonsense", "0"), (None, None), ("udp_multicast", "1.2.3.4")],
)
def test_a_bus_that_does_not_exist_is_one_clear_line(interface, channel):
    with pytest.raises(CanImmError) as caught:
        open_bus(interface, channel)
    assert str(caught.value).startswith("cannot open bus ")
    assert "\n" not in str(caught.value)


def test_the_reason_is_not_hidden_by_the_options():
    with pytest.raises(CanImmError) as caught:
        open_bus_from_namespace(parsed("-i", "socketcan", "-c", "nosuch0"))
    assert str(caught.value).startswith("cannot open bus socketcan nosuch0: ")
    assert "Namespace" not in str(caught.value)
    assert "arguments" not in str(caught.value)


class Failing(can.BusABC):
    """A bus whose every operation fails."""

    def __init__(self, code):
        self.code = code
        self.channel_info = "failing bus"
        self._is_shutdown = True

    def _recv_internal(self, timeout):
        raise can.CanOperationError("read failed", self.code)

    def send(self, msg, timeout=None):
        raise can.CanOperationError("write failed", self.code)


def test_a_link_that_is_down_is_survived_for_as_long_as_it_takes():
    source = BusSource(Failing(errno.ENETDOWN))
    assert all(source.recv(0.0) is None for _ in range(1000))
    assert source.errors == 1000


def test_a_failed_read_does_not_spin():
    source = BusSource(Failing(errno.ENETDOWN))
    before = time.monotonic()
    source.recv(1.0)
    assert 0.009 <= time.monotonic() - before < 0.5


def test_a_device_that_is_gone_ends_it():
    with pytest.raises(BusGone, match="failing bus: read failed"):
        BusSource(Failing(errno.ENODEV)).recv(0.0)
    with pytest.raises(BusGone, match="failing bus: write failed"):
        BusSink(Failing(errno.ENODEV)).send(Frame(0, 1, b""))


def test_nothing_but_failures_for_long_ends_it_too(monkeypatch):
    monkeypatch.setattr(sources, "GONE_AFTER_S", 0.05)
    source = BusSource(Failing(None))
    before = time.monotonic()
    while time.monotonic() - before < 0.04:
        assert source.recv(0.001) is None
    time.sleep(0.06)
    with pytest.raises(BusGone):
        source.recv(0.0)


@pytest.mark.parametrize("code", [errno.ENOBUFS, errno.ENETDOWN, None])
def test_a_frame_that_cannot_be_sent_is_counted(code):
    sink = BusSink(Failing(code))
    for _ in range(300):
        sink.send(Frame(0, 1, b"", flags=TX))
    assert sink.lost == 300


def test_a_full_queue_does_not_block():
    with open_bus("virtual", "full") as one, open_bus("virtual", "full", rx_queue_size=2):
        sink = BusSink(one)
        for _ in range(5):
            sink.send(Frame(0, 1, b""))
        assert sink.lost == 3


def test_a_closed_bus_is_gone_in_the_end(pair, monkeypatch):
    monkeypatch.setattr(sources, "GONE_AFTER_S", 0.0)
    pair[1].shutdown()
    with pytest.raises(BusGone, match="closed"):
        BusSource(pair[1]).recv(0.0)


def test_strange_datagrams_are_survived():
    with open_bus("udp_multicast") as one, open_bus("udp_multicast") as two:
        source = BusSource(one)
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
            stranger.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, 0)
            for payload in (b"", b"garbage", b"\xc1", b"\x81\xa1a\x01"):
                stranger.sendto(payload, (buses.MULTICAST_GROUP, 43113))
                assert source.recv(1.0) is None
        assert source.errors == 4
        BusSink(two).send(Frame(0, 0x301, b"x"))
        frame = source.recv(1.0)
        assert (frame.id, frame.data) == (0x301, b"x")
