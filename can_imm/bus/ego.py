"""The observing vehicle's own motion, as its bus tells it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

from can_imm.bus.codec import compile_reader, field, find_signal
from can_imm.bus.layout import CompiledMessage, compile_condition, guard_of
from can_imm.bus.profile_parts import EgoSignal, Profile

EGO = -2
"""`CompiledMessage.slot` of a message that tells the vehicle's motion."""

NAN = float("nan")


class _Rule(NamedTuple):
    """How the raw values from ``first`` to before ``last`` become quantity ``which``; those of the
    conditions follow."""

    which: int
    first: int
    last: int
    scale: float
    offset: float
    low: int
    high: int
    sign: float
    shift: float
    factor: float
    tests: tuple[Callable[[int], bool], ...]
    reverse: Callable[[int], bool] | None


class EgoReader:
    """Speed [m/s] and yaw rate [rad/s] from the last frames.

    Attributes:
        messages: `CompiledMessage` by frame id.
    """

    def __init__(self, profile: Profile) -> None:
        self.messages: dict[int, CompiledMessage] = {}
        self._rules: dict[int, list[_Rule]] = {}
        self._value = [NAN, NAN]
        self._time = [0, 0]
        self._timeout_ns = profile.ego.timeout_ns if profile.ego else 0
        self._step = profile.sensors.id_step if profile.ego and profile.ego.shifted else 0
        by_id: dict[int, list[tuple[int, EgoSignal]]] = {}
        for index, part in enumerate(profile.ego.parts if profile.ego else ()):
            if part is not None:
                by_id.setdefault(part.message.frame_id, []).append((index, part))
        for frame_id, parts in by_id.items():
            message, protection = parts[0][1].message, parts[0][1].protection
            names: list[str] = []
            self._rules[frame_id] = rules = []
            for index, part in parts:
                rules.append(_rule(message, index, len(names), part))
                names += part.signals
            signals = [find_signal(message, n, profile.path, profile.dbc) for n in names]
            self.messages[frame_id] = CompiledMessage(
                message,
                guard_of(profile, message, protection, frame_id),
                EGO,
                read=compile_reader(message, signals),
            )

    def of_sensor(self, sensor: int) -> dict[int, CompiledMessage]:
        """`messages`, and those with the ids for this sensor."""
        step = sensor * self._step
        shifted = {frame_id + step: message for frame_id, message in self.messages.items()}
        self._rules.update({i + step: rules for i, rules in list(self._rules.items())})
        return {**shifted, **self.messages}

    def take(self, frame_id: int, t_ns: int, raws: tuple[int, ...]) -> None:
        """Take over what a frame says; what it does not know is not known any more."""
        for rule in self._rules[frame_id]:
            at = rule.last
            measured = raws[rule.first : at]
            value = NAN
            if rule.low <= min(measured) and max(measured) <= rule.high:
                raw = sum(measured) / len(measured)
                value = ((raw * rule.scale + rule.offset) * rule.sign + rule.shift) * rule.factor
            for test in rule.tests:
                if not test(raws[at]):
                    value = NAN
                at += 1
            if rule.reverse is not None and rule.reverse(raws[at]):
                value = -value
            self._value[rule.which], self._time[rule.which] = value, t_ns

    def at(self, t_ns: int) -> tuple[float, float]:
        """Speed and yaw rate for a scan at ``t_ns``, NaN for what is unknown or too old."""
        (speed, turn), (first, second), limit = self._value, self._time, self._timeout_ns
        return (
            speed if abs(t_ns - first) <= limit else NAN,
            turn if abs(t_ns - second) <= limit else NAN,
        )


def _rule(message: Any, index: int, first: int, part: EgoSignal) -> _Rule:
    def test(condition: Any) -> Callable[[int], bool]:
        scaling = field(message.get_signal_by_name(condition.signal))
        words = compile_condition(condition, scaling.scale, scaling.offset)
        compiled: Callable[[int], bool] = eval(f"lambda r: {words}")
        return compiled

    scaling = field(message.get_signal_by_name(part.mean_of[0]))
    return _Rule(
        index, first, first + len(part.mean_of), scaling.scale, scaling.offset, scaling.low,
        scaling.high, part.sign, part.offset, part.factor,
        tuple(test(condition) for condition in part.valid_if),
        test(part.reverse_if) if part.reverse_if else None,
    )  # fmt: skip
