"""Frames that the kernel dropped at a full receive queue, seen on any kind of socket."""

from __future__ import annotations

import os
import socket
import sys

import can
import pytest

from can_imm.bus.overflow import QueueWatch

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="the count is Linux's")


class FileBus:
    """A bus as far as it is looked at here: something with a file descriptor."""

    def __init__(self, fd: int) -> None:
        self._fd = fd

    def fileno(self) -> int:
        return self._fd


def test_drops_are_counted_from_the_start_of_the_watch():
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender,
    ):
        receiver.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        receiver.bind(("127.0.0.1", 0))

        def flood(n: int) -> int:
            """Send n packets into an empty queue and read what arrived."""
            for _ in range(n):
                sender.sendto(b"x", receiver.getsockname())
            receiver.setblocking(False)
            arrived = 0
            try:
                while receiver.recv(10):
                    arrived += 1
            except BlockingIOError:
                return arrived

        assert flood(500) < 500  # before the watch: nobody's business
        watch = QueueWatch(FileBus(receiver.fileno()))
        assert watch.drops() == 0
        arrived = flood(300)
        assert watch.drops() == 300 - arrived > 0
        watch.close()
        assert receiver.fileno() >= 0
        receiver.getsockname()  # closing the watch does not close the bus


def test_buses_without_a_socket_read_as_nothing_lost(tmp_path):
    with can.Bus(interface="virtual", channel="overflow", ignore_config=True) as bus:
        watch = QueueWatch(bus)
        assert watch.drops() == 0
        watch.close()
    fd = os.open(tmp_path / "tty", os.O_CREAT)
    try:
        assert QueueWatch(FileBus(fd)).drops() == 0
    finally:
        os.close(fd)
