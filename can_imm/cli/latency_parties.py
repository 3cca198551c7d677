"""Who takes part in `can-imm latency`: the node, the echo node, and the peer that measures both.

On a virtual bus, which lives in one process, they are threads of this one; on any other bus the
echo node and the peer have processes of their own, as the nodes of a bus have, and do not take the
interpreter from the node that is measured.
"""

from __future__ import annotations

import argparse
import multiprocessing
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from multiprocessing.connection import Connection
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

import numpy as np

from can_imm.bus.decoder import ScanDecoder
from can_imm.bus.echo import answer_echoes
from can_imm.bus.encoder import ManoeuvreEncoder, RadarEncoder
from can_imm.bus.profile import load_profile
from can_imm.bus.sinks import BusSink
from can_imm.bus.sources import BusSource
from can_imm.cli.bus_options import open_bus_from
from can_imm.runtime import realtime
from can_imm.runtime.clock import WallClock
from can_imm.runtime.echo import EchoFilter
from can_imm.runtime.feeds import GUARD_NS, BusFeed
from can_imm.runtime.health import Health
from can_imm.runtime.histogram import Histogram
from can_imm.runtime.latency import Probe, Rounds, Stamps
from can_imm.runtime.loop import Loop
from can_imm.runtime.nodes import DetectorNode
from can_imm.types import CanImmError, Scan

if TYPE_CHECKING:
    import can

    from can_imm.detector import Detector

WARM_UP_ROUNDS = 10
"""Rounds before those that count."""

MEMORY_SAMPLES = 20


class Measured(NamedTuple):
    """What a peer found: durations by stage, round trips of the echo node, rounds unanswered."""

    stages: dict[str, Histogram]
    echo: Histogram
    lost: int


class Witness(Protocol):
    """What a peer asks about the node."""

    def stamps_of(self, sent: int) -> Stamps | None:
        """Stamps of the scan that was sent at ``sent`` [ns], None if there is none."""

    def reset(self) -> None:
        """Count from zero."""


class Subject:
    """The node that is measured, in a thread of its own.

    Args:
        bus: its end of the bus.
        detector: its own.
        wants_realtime: ask for what a loop wants that has to be on time.
        duration_s: of the measurement [s], for the samples of memory.

    Attributes:
        granted: what the system allowed.
        memory_kib: of this process, from time to time.
    """

    def __init__(
        self, bus: can.BusABC, detector: Detector, *, wants_realtime: bool, duration_s: float
    ) -> None:
        self.granted: dict[str, Any] = {}
        self.memory_kib: list[int] = []
        self._wants_realtime = wants_realtime
        self._sample_s = duration_s / MEMORY_SAMPLES
        self._sample_at = 0.0
        self._health = Health()
        clock, decoder = WallClock(), ScanDecoder(load_profile("can_imm"))
        ends = EchoFilter(BusSource(bus), BusSink(bus), self._health)
        self.probe = probe = Probe(clock, GUARD_NS, decoder.ids)
        feed = BusFeed(probe.source(ends), clock, self._health)
        node = DetectorNode(decoder, probe.detector(detector), ManoeuvreEncoder(), self._health)
        self._loop = Loop(feed, probe.node(node), self._health, [probe.sink(ends)])
        self._before = 0, 0
        self._failure: BaseException | None = None

    @contextmanager
    def running(self) -> Iterator[None]:
        """Step until the end of the context."""
        done = threading.Event()

        def step_forever() -> None:
            if self._wants_realtime:
                realtime.ask_thread()
            self.granted = realtime.granted()
            try:
                while not done.is_set():
                    self._loop.step()
            except BaseException as error:  # for the main thread to raise
                self._failure = error

        with _thread(step_forever, done):
            yield
        if self._failure is not None:
            raise self._failure

    def stamps_of(self, sent: int) -> Stamps | None:
        if self._failure is not None:
            raise self._failure
        if time.monotonic() >= self._sample_at:
            self._sample_at = time.monotonic() + self._sample_s
            self.memory_kib.append(realtime.resident_kib())
        return self.probe.stamps_of(sent)

    def reset(self) -> None:
        self.memory_kib.clear()
        self._sample_at = 0.0
        self.probe.lateness.reset()
        self._before = self._health.steps, self._health.deadline_misses

    def deadline(self) -> dict[str, int]:
        """Steps since `reset`, and how many of them ended too late."""
        steps, missed = self._before
        return {
            "steps": self._health.steps - steps,
            "missed": self._health.deadline_misses - missed,
        }


def measure_in_threads(
    subject: Subject, bus: can.BusABC, echo_bus: can.BusABC, n_objects: int, duration_s: float
) -> Measured:
    """Be the peer on ``bus``, beside a thread that is the echo node."""
    done = threading.Event()

    def echo() -> None:
        while not done.is_set():
            answer_echoes(echo_bus, 0.1)

    with _thread(echo, done):
        return _as_peer(bus, subject, n_objects, duration_s)


def measure_in_processes(
    subject: Subject, args: argparse.Namespace, n_objects: int, duration_s: float
) -> Measured:
    """Have processes be the peer and the echo node, each on a bus of its own as ``args`` say.

    Raises:
        CanImmError: their bus cannot be opened.
    """
    # spawn: the same on every platform, and no fork of a process with threads
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    parts = (args, theirs, n_objects, duration_s)
    processes = [
        context.Process(target=_echo_process, args=(args,), daemon=True),
        context.Process(target=_peer_process, args=parts, daemon=True),
    ]
    try:
        for process in processes:
            process.start()
        theirs.close()
        while not isinstance(asked := ours.recv(), Measured):
            if isinstance(asked, CanImmError):
                raise asked
            if asked is None:
                subject.reset()
            ours.send(None if asked is None else subject.stamps_of(asked))
    except EOFError:
        raise CanImmError("the measuring process has ended before its time") from None
    finally:
        for process in processes:
            process.terminate()
            process.join()
    return asked


class _RemoteWitness:
    """Asks the process of the node; None is a request to count from zero."""

    def __init__(self, connection: Connection) -> None:
        self._connection = connection

    def stamps_of(self, sent: int) -> Stamps | None:
        self._connection.send(sent)
        stamps: Stamps | None = self._connection.recv()
        return stamps

    def reset(self) -> None:
        self._connection.send(None)
        self._connection.recv()


def _echo_process(args: argparse.Namespace) -> None:
    _begin_process(args)
    parent = multiprocessing.parent_process()
    with suppress(CanImmError), open_bus_from(args) as bus:  # the peer tells what is wrong with it
        while parent is not None and parent.is_alive():
            answer_echoes(bus, 1.0)


def _peer_process(
    args: argparse.Namespace, connection: Connection, n_objects: int, duration_s: float
) -> None:
    _begin_process(args)
    with suppress(EOFError, BrokenPipeError):  # the parent is gone
        try:
            with open_bus_from(args) as bus:
                witness = _RemoteWitness(connection)
                connection.send(_as_peer(bus, witness, n_objects, duration_s))
        except CanImmError as error:
            connection.send(error)


def _begin_process(args: argparse.Namespace) -> None:
    """Leave interrupts to the parent, and be as urgent as its threads."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if args.realtime:
        realtime.ask_process()


@contextmanager
def _thread(target: Callable[[], None], done: threading.Event) -> Iterator[None]:
    """Run ``target`` in a thread until the end of the context, which sets ``done``."""
    thread = threading.Thread(target=target, daemon=True)
    thread.start()
    try:
        yield
    finally:
        done.set()
        thread.join()


def _as_peer(bus: can.BusABC, witness: Witness, n_objects: int, duration_s: float) -> Measured:
    """Send scans and echo requests for so long, after a warm-up."""
    rng = np.random.default_rng(0)
    encoder, scan = RadarEncoder(), Scan(n_objects)
    scan.n = n_objects
    scan.ids[:] = range(n_objects)
    scan.valid[:] = True
    scan.z[:] = [40.0, 0.0, 0.0, 0.0]
    rounds = Rounds(BusSource(bus), BusSink(bus), witness.stamps_of)

    def one_round() -> None:
        frames = encoder.encode(scan, time.time_ns() // 1000 * 1000)
        rounds.scan(frames, 2 * n_objects)
        rounds.bounce()

    for _ in range(WARM_UP_ROUNDS):
        one_round()
    rounds.reset()
    witness.reset()
    end = time.monotonic() + duration_s
    while time.monotonic() < end:
        # at any phase of the step
        time.sleep(0.01 + 0.01 * rng.random())
        one_round()
    return Measured(rounds.stages, rounds.echo, rounds.lost)
