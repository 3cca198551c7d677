"""What a sensor profile consists of. Messages are cantools messages; signals are named."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

STATES = ("x", "vx", "y", "vy")
POLAR = ("range", "rate", "bearing")
QUANTITIES = {
    "x": "length", "vx": "speed", "y": "length", "vy": "speed",
    "range": "length", "rate": "speed", "bearing": "angle",
    "speed": "speed", "yaw_rate": "turn rate", "length": "length", "width": "length",
}  # fmt: skip
"""What each component is, so which units fit."""


@dataclass(frozen=True)
class Code:
    """A signal whose raw values are looked up in ``table``; without a table, and there is no such
    index, it is "not available"."""

    signal: str
    table: tuple[float, ...] | None


@dataclass(frozen=True)
class Component:
    """How a state is measured: ``(sign * signal + offset) * factor`` in SI units.

    ``std``, ``std_floor`` and ``offset`` are in the signal's unit, ``unit``; ``factor`` takes it to
    SI units.  ``std_from`` is the signal with which the sensor sends its own standard deviation,
    not believed below ``std_floor``.  ``std_lasting`` is that of an error which each object has for
    ``lasting_s`` [s] instead of a scan; ``std_per_m``, in the unit per metre of distance ahead,
    that of one which all objects share for ``per_m_s`` [s]; ``new_per_m``, per metre too, that of a
    new track's own error, which fades within ``new_s`` [s].
    """

    signal: str
    std: float
    sign: float
    offset: float
    unit: str
    factor: float
    std_from: Code | None
    std_floor: float
    std_lasting: float = 0.0
    lasting_s: float = 0.0
    std_per_m: float = 0.0
    per_m_s: float = 0.0
    new_per_m: float = 0.0
    new_s: float = 0.0


@dataclass(frozen=True)
class Condition:
    """A test of a signal's physical value; one of the four is not None."""

    signal: str
    equals: float | None
    below: float | None
    above: float | None = None
    any_of: tuple[float, ...] | None = None

    def words(self) -> str:
        """The condition as a piece of a sentence."""
        if self.equals is not None:
            return f"{self.signal} = {self.equals:g}"
        if self.below is not None:
            return f"{self.signal} < {self.below:g}"
        if self.above is not None:
            return f"{self.signal} > {self.above:g}"
        return f"{self.signal} in {', '.join(f'{v:g}' for v in self.any_of or ())}"


@dataclass(frozen=True)
class Header:
    """The message that starts a scan, and its signal for the number of object frames."""

    message: Any
    count: str


@dataclass(frozen=True)
class Sensors:
    """``number`` sensors of the kind may share a bus; the ids of sensor n are higher by
    ``n * id_step``.  ``use`` is the one that counts, None the first one that is heard."""

    number: int = 1
    id_step: int = 0
    use: int | None = None

    @property
    def possible(self) -> range:
        """The sensors that may become the one that counts."""
        return range(self.number) if self.use is None else range(self.use, self.use + 1)


@dataclass(frozen=True)
class Mounting:
    """Where the sensor sits in the vehicle's axes [m] and how it is turned, to the left [rad]."""

    x: float = 0.0
    y: float = 0.0
    yaw: float = 0.0


@dataclass(frozen=True)
class EgoSignal:
    """Speed or yaw rate of the observing vehicle: ``(sign * value + offset) * factor`` if all of
    ``valid_if`` hold, with the other sign if ``reverse_if`` holds.  The value is the mean of the
    signals ``mean_of``, all of one scale; often there is only one.  An encoder makes
    ``forwards_if`` hold if the value is positive, and ``standstill_if`` if it is about 0."""

    message: Any
    mean_of: tuple[str, ...]
    sign: float
    offset: float
    unit: str
    factor: float
    protection: str
    valid_if: tuple[Condition, ...]
    reverse_if: Condition | None
    forwards_if: Condition | None = None
    standstill_if: Condition | None = None

    @property
    def signals(self) -> tuple[str, ...]:
        """All signals; a reader needs those up to that of ``reverse_if``."""
        directions = (self.reverse_if, self.forwards_if, self.standstill_if)
        conditions = (*self.valid_if, *(each for each in directions if each))
        return (*self.mean_of, *(condition.signal for condition in conditions))


@dataclass(frozen=True)
class Ego:
    """The observing vehicle's motion; a value is forgotten ``timeout_ns`` after its frame.  With
    ``shifted`` the ids are also higher by those of the sensor that counts."""

    timeout_ns: int
    shifted: bool
    speed: EgoSignal | None
    yaw_rate: EgoSignal | None

    @property
    def parts(self) -> tuple[EgoSignal | None, EgoSignal | None]:
        """Speed and yaw rate, in this order."""
        return self.speed, self.yaw_rate


@dataclass(frozen=True)
class Profile:
    """A sensor.

    With a ``header`` a scan is the header and as many object frames as it announces; without one
    it is one frame of each of ``messages``, and the signal ``counter`` tells the scans apart.
    ``also`` are further messages that the sensor may send about each object, tied to it by the
    signal ``id``.  ``state`` are the components of `STATES`, or with ``polar`` those of `POLAR` and
    None.  An object is new if the raw value of ``new`` is one of ``new_codes``, or is not 0 where
    there are none.  ``existence_least`` is the lowest probability of existence of an object.
    """

    name: str
    path: Path
    description: str
    dbc: Path
    period_ns: int
    timeout_ns: int
    latency_ns: int
    header: Header | None
    counter: str
    messages: tuple[Any, ...]
    also: tuple[Any, ...]
    padded: bool
    id: str | None
    new: str | None
    new_codes: tuple[int, ...]
    valid_if: tuple[Condition, ...]
    state: tuple[Component | None, ...]
    polar: bool
    existence: Code | None
    existence_least: float
    object_class: Code | None
    size: tuple[Code | None, Code | None]
    protection: str
    protection_counter: str | None
    sensors: Sensors
    mounting: Mounting
    ego: Ego | None

    @property
    def object_messages(self) -> tuple[Any, ...]:
        """All messages that tell about objects."""
        return (*self.messages, *self.also)

    def source(self, signal: str) -> Any:
        """The message (of a list of equal ones, the first) that has the signal, None if none."""
        for message in (self.messages[0], *self.also):
            if signal in message.signal_tree:
                return message
        return None

    def codes(self) -> Iterator[Code]:
        """All signals about an object that are looked up in a table."""
        stds = (part.std_from for part in self.state if part)
        for code in (*stds, self.existence, self.object_class, *self.size):
            if code is not None:
                yield code

    def object_signals(self) -> Iterator[str]:
        """All signals that are read of the messages about objects, but those of their own."""
        yield from (part.signal for part in self.state if part)
        yield from (code.signal for code in self.codes())
        yield from (condition.signal for condition in self.valid_if)
        if self.new is not None:
            yield self.new
