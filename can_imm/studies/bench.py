"""The same work side by side: this package's and its peers', in interleaved rounds of one run."""

from __future__ import annotations

import os
import platform
import statistics
import sys
import time
import tomllib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from can_imm.bus.decoder import ScanDecoder
from can_imm.bus.encoder import OUTPUT_IDS, ManoeuvreEncoder, RadarEncoder
from can_imm.bus.profile import Profile, load_profile
from can_imm.bus.reference import Reference
from can_imm.bus.sinks import LogSink
from can_imm.bus.sources import LogSource
from can_imm.detector import Detector
from can_imm.estimation import layout
from can_imm.estimation.entry import Processor
from can_imm.estimation.noise import noise_state
from can_imm.estimation.particles import N_COLUMNS, N_SCRATCH
from can_imm.manoeuvres import PRESETS, ModeBank, bank_from_dict, load_bank
from can_imm.runtime.clock import FastClock
from can_imm.runtime.feeds import LogFeed
from can_imm.runtime.health import Health
from can_imm.runtime.loop import Loop
from can_imm.runtime.nodes import DetectorNode
from can_imm.studies.crowd import OBJECTS, PROFILE, crowd
from can_imm.studies.peer import imm_peer
from can_imm.studies.runs import play
from can_imm.types import FloatArray, IntArray, Scan

STEPS = 10
"""Steps of the loop between two measurements: 0.1 s."""

SCANS = 100
"""Measurements of a run of the estimator."""


@dataclass(frozen=True)
class Side:
    """One of the two sides of a comparison.

    Attributes:
        name: what does the work.
        run: does it.
        units: how often one run does it.
    """

    name: str
    run: Callable[[], object]
    units: float

    def seconds(self) -> float:
        """Time for one unit of work [s]."""
        began = time.perf_counter()
        self.run()
        return (time.perf_counter() - began) / self.units


@dataclass(frozen=True)
class RealTime:
    """What is as fast as the bus: takes all of one core for as long as a log lasts [s]."""

    duration: float
    name: str = "a core in real time"

    def seconds(self) -> float:
        """As `Side.seconds`."""
        return self.duration


@dataclass(frozen=True)
class Case:
    """A comparison.

    Attributes:
        name: as in the results.
        what: the work, for a reader.
        faster: the ratio says how many times faster than the peer; otherwise it is the cost in
            units of the peer's.
        target: the ratio to reach (at least, or at most), None without one.
    """

    name: str
    what: str
    ours: Side
    peer: Side | RealTime
    faster: bool
    target: float | None


@dataclass(frozen=True)
class Result:
    """Median times per unit of work and their ratio."""

    case: Case
    median_us: float
    peer_median_us: float

    @property
    def ratio(self) -> float:
        """See `Case.faster`."""
        a, b = self.median_us, self.peer_median_us
        return b / a if self.case.faster else a / b

    @property
    def reached(self) -> bool | None:
        """Whether the target is reached, None without one."""
        if self.case.target is None:
            return None
        return (
            self.ratio >= self.case.target if self.case.faster else self.ratio <= self.case.target
        )

    def as_dict(self) -> dict[str, Any]:
        """As in the JSON file."""
        return {
            "name": self.case.name,
            "what": self.case.what,
            "median_us": self.median_us,
            "peer": self.case.peer.name,
            "peer_median_us": self.peer_median_us,
            "ratio": self.ratio,
            "ratio_is": "times faster" if self.case.faster else "times the cost",
            "target": self.case.target,
            "reached": self.reached,
        }


def measure(cases: Sequence[Case], rounds: int) -> Iterator[Result]:
    """Run both sides of every case in turn, ``rounds`` times after a first one to warm up."""
    for case in cases:
        times: list[tuple[float, float]] = []
        for k in range(rounds + 1):
            pair = case.ours.seconds(), case.peer.seconds()
            if k > 0:
                times.append(pair)
        ours, peer = (statistics.median(column) * 1e6 for column in zip(*times, strict=True))
        yield Result(case, ours, peer)


def machine() -> dict[str, Any]:
    """Where and with what the figures were measured."""
    names = ["numpy", "numba", "filterpy", "python-can", "cantools"]
    if find_spec("stonesoup") is not None:
        names.append("stonesoup")
    return {
        "system": platform.platform(),
        "processor": _processor(),
        "cpus": os.cpu_count(),
        "python": sys.version.split()[0],
        **{name: version(name) for name in names},
    }


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor()
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor()


def _published() -> dict[str, Any]:
    return tomllib.loads((PRESETS / "paper.toml").read_text(encoding="utf-8"))


def six_filters() -> ModeBank:
    """The published bank without its particle mode: six constrained Kalman filters."""
    data = _published()
    left_out = [mode.get("particles", False) for mode in data["mode"]].index(True)
    data["mode"].pop(left_out)
    del data["particles"]
    matrix = np.array(data["transition"]["matrix"])
    matrix = np.delete(np.delete(matrix, left_out, 0), left_out, 1)
    data["transition"]["matrix"] = (matrix / matrix.sum(1, keepdims=True)).tolist()
    return bank_from_dict(data, "bench")


def with_particles(count: int) -> ModeBank:
    """The published bank with this many particles."""
    data = _published()
    data["particles"]["count"] = count
    return bank_from_dict(data, "bench")


def _measurements() -> FloatArray:
    """(SCANS, 4) of the published scenario, which goes through every manoeuvre."""
    return play("A", 1000)[1][0].z[:SCANS].copy()


class Estimator:
    """The estimator alone, as Python calls it: one call per scan of ``n`` objects."""

    def __init__(self, bank: ModeBank, n: int) -> None:
        assert bank.measurement_variance is not None
        self.scans = [np.repeat(row[None], n, 0) for row in _measurements()]
        self.objects = np.zeros(n, layout.OBJECT_DTYPE)
        self._steps: IntArray = np.zeros(n, np.int32)
        self._z: FloatArray = np.zeros((n, 4))
        self._n = n
        self._processor = Processor(
            np.inf,
            bank=bank.record,
            objects=self.objects,
            work=np.zeros(1, layout.WORK_DTYPE),
            slot=np.arange(n, dtype=np.int32),
            steps=self._steps,
            z=self._z,
            r=np.tile(bank.measurement_variance, (n, 1)),
            valid=np.ones((n, 4), np.bool_),
            angle=np.zeros(n),
            particles=np.zeros((n, N_COLUMNS, bank.n_particles)),
            spare=np.zeros((N_SCRATCH, bank.n_particles)),
            weights=np.zeros(bank.n_particles),
            noise=noise_state(np.random.default_rng(0)),
            status=np.zeros(n, np.int8),
        )

    def run(self) -> None:
        """A birth and the cycles after it."""
        for _ in self.steps():
            pass

    def steps(self) -> Iterator[FloatArray]:
        """The birth and the cycles one by one; gives the measurements (n, 4) of each."""
        process, address, n, z = self._processor.run, self._processor.address, self._n, self._z
        self._steps[:] = -1
        for k, row in enumerate(self.scans):
            z[...] = row
            process(address, n, layout.UNKNOWN_GROUND, 0.0, 0.0)
            if k == 0:
                self._steps[:] = STEPS
            yield row


def _filterpy(bank: ModeBank) -> None:
    """The same measurements through filterpy."""
    assert bank.measurement_variance is not None
    z = _measurements()
    x = np.zeros(bank.n_states)
    x[:4] = z[0]
    peer = imm_peer(bank, STEPS, [0, 1, 2, 3], bank.measurement_variance, x)
    for row in z[1:]:
        peer.predict()
        peer.update(row)


def _stonesoup(bank: ModeBank) -> None:
    """The same measurements through Stone Soup."""
    from can_imm.studies.peer_stonesoup import SoupImm

    assert bank.measurement_variance is not None
    z = _measurements()
    peer = SoupImm(bank, STEPS, [0, 1, 2, 3], bank.measurement_variance, z[0])
    for row in z[1:]:
        peer.predict()
        peer.update(row)


def _estimator_side(bank: ModeBank, n: int, name: str = "can-imm", per_object: bool = True) -> Side:
    return Side(name, Estimator(bank, n).run, SCANS * (n if per_object else 1))


def estimator_cases() -> list[Case]:
    """Steps of the estimator: against filterpy, and Stone Soup where it is installed, over objects,
    over particles."""
    six, seven = six_filters(), with_particles(500)
    alone = _estimator_side(six, 1, "one object alone")
    few = _estimator_side(seven, 1, "500 particles")
    cases = [
        Case("imm6", "IMM step, six constrained Kalman filters", _estimator_side(six, 1),
             Side("filterpy", partial(_filterpy, six), SCANS), True, 600.0),
        Case("imm7_pf500", "IMM step, the same and 500 particles", few,
             Side("filterpy and numpy", partial(_filterpy, seven), SCANS), True, 100.0),
    ]  # fmt: skip
    if find_spec("stonesoup") is not None:
        cases.append(
            Case("imm6_stonesoup", "IMM step, six constrained Kalman filters",
                 _estimator_side(six, 1), Side("Stone Soup and numpy",
                 partial(_stonesoup, six), SCANS), True, None)
        )  # fmt: skip
    for n, target in ((16, None), (64, 0.8), (256, None)):
        side = _estimator_side(six, n)
        what = f"six filters, per object at {n} in one call"
        cases.append(Case(f"objects_{n}", what, side, alone, False, target))
    for count, target in ((100, None), (1000, None), (5000, 10.0), (10_000, None)):
        side = _estimator_side(with_particles(count), 1)
        what = f"IMM step with {count} particles"
        cases.append(Case(f"particles_{count}", what, side, few, False, target))
    return cases


def decode_case() -> Case:
    """Frames in memory to scans, with all checks, against cantools alone."""
    profile = load_profile("can_imm")
    encoder, frames = RadarEncoder(), []
    for scan in _crowd(SCANS, 12):
        frames += encoder.encode(scan, scan.t_ns)

    def decode() -> None:
        decoder = ScanDecoder(profile)
        for frame in frames:
            decoder.feed(frame)

    return Case(
        "decode", "a frame decoded and checked", Side("can-imm", decode, len(frames)),
        Side("cantools", partial(Reference(profile).decode, frames), len(frames)), True, None,
    )  # fmt: skip


def write_log(path: Path, seconds: int = 20, objects: int = 8) -> None:
    """Write a candump log of a simulated sensor, for those who have no log of their own."""
    encoder = RadarEncoder()
    with LogSink(path) as sink:
        for scan in _crowd(seconds * 10, objects):
            for frame in encoder.encode(scan, scan.t_ns):
                sink.send(frame)


def _crowd(scans: int, objects: int) -> Iterator[Scan]:
    """Scans of the published scenario's vehicle, ``objects`` times, over and over."""
    z = _measurements()
    scan = Scan(objects)
    scan.n = objects
    scan.ids[:] = range(objects)
    scan.valid[:] = True
    for k in range(scans):
        scan.t_ns = (k + 1) * 100_000_000
        scan.z[:] = z[k % len(z)]
        scan.new[:] = k % len(z) == 0
        yield scan


def crowd_case(log: Path, seconds: float = 20.0) -> Case:
    """As many objects as an ARS408 sends, through the preset motorway.

    Args:
        log: where to write them, when they are needed.
    """
    replay = _replay(log, load_profile(PROFILE), load_bank("motorway"), OBJECTS)

    def run() -> None:
        if not log.exists():  # in the round that does not count
            with LogSink(log) as sink:
                for frame in crowd(seconds):
                    sink.send(frame)
        replay()

    what = f"replay of {OBJECTS} objects at 14 Hz, preset motorway"
    return Case("crowd", what, Side("can-imm", run, 1), RealTime(seconds), False, 0.1)


def _replay(log: Path, profile: Profile, bank: ModeBank, capacity: int = 64) -> Callable[[], None]:
    def replay() -> None:
        health = Health()
        decoder, encoder = ScanDecoder(profile, capacity), ManoeuvreEncoder()
        node = DetectorNode(decoder, Detector(bank, capacity=capacity), encoder, health)
        loop = Loop(LogFeed(LogSource(log), FastClock(), health, OUTPUT_IDS), node, health)
        while loop.step():
            pass

    return replay


def replay_cases(log: Path, profile: Profile, bank: ModeBank, share: float) -> list[Case]:
    """Replay of a log against python-can with cantools, and these with a filterpy IMM.

    Args:
        share: part of the log that the filterpy side works on; its time is scaled up.
    """
    n_frames = sum(1 for _ in LogSource(log))
    part = max(int(n_frames * share), 1)
    reference = Reference(profile)

    def read() -> None:
        for _ in reference.read(log):
            pass

    ours = Side("can-imm", _replay(log, profile, bank), 1)
    tracker = "python-can, cantools, filterpy"
    if part < n_frames:
        tracker += f" ({part:,} of {n_frames:,} frames, scaled)"
    return [
        Case("replay_reader", f"replay of {log.name}", ours,
             Side("python-can, cantools", read, 1), False, 2.0),
        Case("replay_filterpy", f"replay of {log.name}", ours,
             Side(tracker, partial(_replay_filterpy, log, profile, bank, part), part / n_frames),
             True, 100.0),
    ]  # fmt: skip


def _replay_filterpy(log: Path, profile: Profile, bank: ModeBank, frames: int) -> None:
    """Every object of the log through an `IMMEstimator` of its own."""
    parts = [(state, part) for state, part in enumerate(profile.state) if part is not None]
    seen = [state for state, _ in parts]
    variance = np.square([part.std for _, part in parts])
    if bank.measurement_variance is not None:
        variance = bank.measurement_variance[seen]
    steps = max(profile.period_ns // bank.step_ns, 1)
    header = profile.header.message.frame_id if profile.header is not None else -1
    tracks: dict[Any, Any] = {}
    for _, frame_id, signals in Reference(profile, labels=False).read(log, frames):
        if frame_id == header or not all(
            signals[c.signal] == c.equals if c.below is None else signals[c.signal] < c.below
            for c in profile.valid_if
        ):
            continue
        key = frame_id if profile.id is None else signals[profile.id]
        values = [signals[part.signal] for _, part in parts]
        z = np.array(
            [p.sign * float(v) + p.offset for (_, p), v in zip(parts, values, strict=True)]
        )
        if key not in tracks or (profile.new is not None and int(signals[profile.new])):
            x = np.zeros(bank.n_states)
            x[seen] = z
            tracks[key] = imm_peer(bank, steps, seen, variance, x)
            continue
        tracks[key].predict()
        tracks[key].update(z)
