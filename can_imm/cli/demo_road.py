"""A bird's-eye view of the road in characters: the ego at the left, the objects ahead of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby

from rich.text import Text

CAR_LENGTH, CAR_WIDTH = 4.5, 1.8
BEHIND = 6.0
"""How much of the road behind the sensor is shown [m]."""


@dataclass(frozen=True)
class Car:
    """A car on the road: its near end's distance and lateral position [m], and its label."""

    x: float
    y: float
    text: str
    style: str


class Road:
    """Two lanes, drawn with two cells' halves per line.

    Args:
        lane_width: [m].
        reach: distance ahead that is shown [m].
        width: cells along the road.
        lane_rows: lines per lane.
    """

    def __init__(self, lane_width: float, reach: float, width: int, lane_rows: int) -> None:
        self._metres = (reach + BEHIND) / width
        self._reach = reach
        self._width = width
        self._lane_rows = lane_rows
        # from the middle of one lane to the middle of the other, in halves of a line
        self._half = lane_width / (2 * lane_rows + 2)
        self._border_y = lane_width / 2
        self._cells = [[(" ", "")] * width for _ in range(2 * lane_rows + 1)]
        self._cells[lane_rows] = [("╌" if c % 6 < 3 else " ", "white") for c in range(width)]
        for line, name in ((lane_rows - 1, "left lane"), (2 * lane_rows, "right lane")):
            self._write(line, width - len(name), name, "dim")
        self._draw(Car(-CAR_LENGTH, 0.0, "", "bright_white"))
        self._write(self._line(0.0), self._column(0.0) + 1, "ego", "dim")

    def add(self, car: Car) -> None:
        """Draw a car with its label beside it."""
        self._draw(car)
        after = self._column(car.x + CAR_LENGTH) + 1
        before = self._column(car.x) - 1 - len(car.text)
        column = after if after + len(car.text) <= self._width else before
        self._write(self._line(car.y), column, car.text, car.style)

    def lines(self) -> list[Text]:
        """The road from edge to edge, and a scale in metres."""
        edge = Text("━" * self._width, "white")
        return [edge, *(_text(row) for row in self._cells), edge, self._scale()]

    def _draw(self, car: Car) -> None:
        middle = self._height(car.y)
        top, bottom = (middle + s * CAR_WIDTH / 2 / self._half for s in (-1, 1))
        first = self._column(car.x)
        last = max(self._column(car.x + CAR_LENGTH), first + 1)
        for line, row in enumerate(self._cells):
            upper, lower = (top <= 2 * line + s < bottom for s in (0.5, 1.5))
            if upper or lower:
                block = "█" if upper and lower else "▀" if upper else "▄"
                for c in range(max(first, 0), min(last, self._width)):
                    row[c] = block, car.style

    def _write(self, line: int, column: int, text: str, style: str) -> None:
        for k, letter in enumerate(text):
            if 0 <= column + k < self._width:
                self._cells[line][column + k] = letter, style

    def _height(self, y: float) -> float:
        """Halves of a line from the top."""
        return 2 * self._lane_rows + 1 - (y - self._border_y) / self._half

    def _line(self, y: float) -> int:
        return min(max(int((self._height(y) - 0.5) // 2), 0), 2 * self._lane_rows)

    def _column(self, x: float) -> int:
        return round((x + BEHIND) / self._metres)

    def _scale(self) -> Text:
        line = [" "] * self._width
        for metre in range(0, int(self._reach) + 1, 10 if self._reach <= 120 else 50):
            text = f"{metre}m" if metre == 0 else str(metre)
            at = self._column(metre)
            if at + len(text) <= self._width:
                line[at : at + len(text)] = text
        return Text("".join(line), "dim")


def _text(row: Sequence[tuple[str, str]]) -> Text:
    text = Text()
    for style, run in groupby(row, key=lambda cell: cell[1]):
        text.append("".join(letter for letter, _ in run), style)
    return text
