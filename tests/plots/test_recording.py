"""The picture of a recording."""

from __future__ import annotations

import numpy as np
import pytest
from matplotlib.collections import LineCollection
from matplotlib.colors import to_hex
from matplotlib.figure import Figure

from can_imm.estimation import road
from can_imm.events import Event
from can_imm.plots.history import HISTORY_DTYPE, History, Recorded
from can_imm.plots.recording import draw_recording, lane_lines
from can_imm.plots.style import COLOURS
from can_imm.types import REPORT_DTYPE, Manoeuvre

S = 1_000_000_000
KL, LC = Manoeuvre.KEEP_LANE, Manoeuvre.LANE_CHANGE


@pytest.fixture
def drawn(monkeypatch) -> list[Figure]:
    figures: list[Figure] = []
    save = Figure.savefig

    def keep(figure, path, **options):
        figures.append(figure)
        save(figure, path, **options)

    monkeypatch.setattr(Figure, "savefig", keep)
    return figures


def track(object_id: int, manoeuvres: list[Manoeuvre], y: float, **fields) -> np.ndarray:
    """A report every 100 ms from second 100 on."""
    rows = np.zeros(len(manoeuvres), HISTORY_DTYPE)
    n = np.arange(len(rows))
    rows["t_ns"], rows["age"] = 100 * S + n * S // 10, 1 + n
    rows["object_id"], rows["manoeuvre"], rows["y"], rows["x"] = object_id, manoeuvres, y, 50 + n
    rows["lane"], rows["ego_speed"] = round(y / 3.5), np.nan
    for name, value in fields.items():
        rows[name] = value
    return rows


def plain(rows: np.ndarray) -> Recorded:
    return Recorded(rows, np.empty(0, np.int64), np.empty(0), float("nan"))


def lines(figure: Figure, panel: int = 0) -> list[tuple[str, float, np.ndarray]]:
    """(colour, width, points) of every piece of line."""
    return [
        (to_hex(colour), float(width), np.asarray(path.vertices))
        for collection in figure.axes[panel].collections
        if isinstance(collection, LineCollection)
        for path, colour, width in zip(
            collection.get_paths(),
            collection.get_colors(),
            collection.get_linewidths(),
            strict=True,
        )
    ]


def change(object_id: int, at_s: float, direction: int, event: str = "") -> Event:
    at = round((100 + at_s) * S)
    return Event(object_id, LC, event, direction, at - S, at + S, 0.9, 0, 1, 5.0, 0.0, 5.0, 9.0)


def test_pieces_have_the_colours_of_their_manoeuvres_and_the_places_of_the_reports(tmp_path, drawn):
    rows = track(3, [KL] * 20 + [LC] * 10 + [KL] * 20, 3.5)
    path = draw_recording(tmp_path / "a.png", "a.log", plain(rows), [], 3.5)
    assert path.read_bytes().startswith(b"\x89PNG")
    across, gap = lines(drawn[0]), lines(drawn[0], 1)
    pieces = sorted((points[0, 0], points[-1, 0], colour) for colour, _, points in across)
    assert pieces == [
        (0.0, pytest.approx(2.0), COLOURS[KL]),
        (pytest.approx(2.0), pytest.approx(3.0), COLOURS[LC]),
        (pytest.approx(3.0), pytest.approx(4.9), COLOURS[KL]),
    ]
    assert all((points[:, 1] == 3.5).all() for _, _, points in across)
    points = np.concatenate([points for _, _, points in gap])
    assert points[:, 1] == pytest.approx(50 + 10 * points[:, 0])
    assert len(drawn[0].axes) == 2
    assert drawn[0].axes[0].get_title(loc="left") == "a.log"


def test_lane_changes_are_named_at_their_middle(tmp_path, drawn):
    rows = np.concatenate((track(3, [KL] * 50, 3.5), track(7, [KL] * 50, 0.0)))
    events = [change(3, 2.0, -1, "CUT_IN"), change(7, 3.0, 1)]
    draw_recording(tmp_path / "a.png", "a.log", plain(rows), events, 3.5)
    axes = drawn[0].axes[0]
    marks = [(m.get_xdata()[0], m.get_ydata()[0], m.get_marker()) for m in axes.lines
             if m.get_marker() in ("^", "v")]  # fmt: skip
    assert marks == [(pytest.approx(2.0), 3.5, "v"), (pytest.approx(3.0), 0.0, "^")]
    texts = [text.get_text() for text in axes.texts]
    assert "3↓ cut-in" in texts
    assert "7↑" in texts


def test_too_many_lane_changes_are_marked_without_names(tmp_path, drawn):
    rows = track(3, [KL] * 100, 0.0)
    draw_recording(
        tmp_path / "a.png", "a.log", plain(rows), [change(3, k / 10, 1) for k in range(50)], 3.5
    )
    axes = drawn[0].axes[0]
    assert sum(line.get_marker() == "^" for line in axes.lines) == 50
    assert not [text for text in axes.texts if "3" in text.get_text()]


def test_lines_are_broken_where_an_id_names_another_object(tmp_path, drawn):
    rows = np.concatenate((track(3, [KL] * 15, 0.0), track(3, [KL] * 15, 3.5)))
    rows["t_ns"] = 100 * S + np.arange(30) * S // 10
    draw_recording(tmp_path / "a.png", "a.log", plain(rows), [], 3.5)
    assert [set(points[:, 1]) for _, _, points in lines(drawn[0])] == [{0.0}, {3.5}]


def test_duplicates_are_thin_and_what_stands_is_pale(tmp_path, drawn):
    rows = np.concatenate(
        (
            track(1, [KL] * 30, 0.0),
            track(2, [KL] * 30, 0.3, duplicate=True),
            track(3, [Manoeuvre.STATIONARY] * 30, -8.0),
        )
    )
    draw_recording(tmp_path / "a.png", "a.log", plain(rows), [], 3.5)
    width = {points[0, 1]: width for _, width, points in lines(drawn[0])}
    assert width[np.float32(0.3)] < width[-8.0] < width[0.0]
    legend = [text.get_text() for text in drawn[0].legends[0].get_texts()]
    assert legend == ["keep lane 50 %", "stationary 50 %", "duplicate track", "lane change"]


def test_the_ego_s_speed_has_a_panel_if_it_is_known(tmp_path, drawn):
    rows = track(1, [KL] * 30, 0.0, ego_speed=25.0)
    draw_recording(tmp_path / "a.png", "a.log", plain(rows), [], 3.5)
    assert len(drawn[0].axes) == 3
    assert set(drawn[0].axes[2].lines[0].get_ydata()) == {25.0}


@pytest.mark.parametrize("manoeuvre", list(Manoeuvre))
def test_one_report_is_enough(tmp_path, manoeuvre):
    draw_recording(tmp_path / "a.svg", "a.log", plain(track(1, [manoeuvre], 0.0)), [], 3.5)


def test_lane_lines_lie_between_the_lanes():
    """Lanes of 3.4 m, the middle one's centre at 0.4 m."""
    random = np.random.default_rng(1)
    y = random.uniform(-4.7, 5.5, 5000)
    rows = np.zeros(len(y), HISTORY_DTYPE)
    rows["y"], rows["lane"] = y, np.round((y - 0.4) / 3.4)
    found = lane_lines(rows, 3.4)
    assert list(found) == [-1.5, -0.5, 0.5, 1.5]
    assert list(found.values()) == pytest.approx([-4.7, -1.3, 2.1, 5.5], abs=0.05)


def test_one_lane_has_its_lines_around_it():
    rows = np.zeros(100, HISTORY_DTYPE)
    rows["lane"], rows["y"] = 1, 3.0
    assert lane_lines(rows, 3.0) == {0.5: 1.5, 1.5: 4.5}


def test_history_keeps_what_it_was_told():
    history = History()
    reports = np.zeros(2, REPORT_DTYPE)
    reports["object_id"], reports["duplicate_of"] = [4, 5], [-1, 4]
    reports["x"][:] = [[50, 1, 3, 0], [51, 1, 2, 0]]
    history(0, reports)
    reports["object_id"] = 9  # the detector's buffer is used again
    history(1, reports[:0])
    rows = history.recorded().rows
    assert rows["object_id"].tolist() == [4, 5]
    assert rows["duplicate"].tolist() == [False, True]
    assert rows["x"].tolist() == [50, 51]
    assert rows["y"].tolist() == [3, 2]
    assert len(History().recorded().rows) == 0


class Road:
    """A road of one radius while the ego moves over to the left lane."""

    def __init__(self, curvature: float) -> None:
        self.x = np.zeros(road.N_ROAD)
        self.x[road.WIDTH] = 3.5
        self.x[road.KNOT :] = curvature


@pytest.mark.parametrize("curvature", [0.0, 1e-3])
def test_across_the_road_a_car_keeps_its_lane_while_the_ego_changes_its_own(
    tmp_path, drawn, curvature
):
    ahead = Road(curvature)
    history = History(ahead)
    reports = np.zeros(1, REPORT_DTYPE)
    reports["duplicate_of"], reports["manoeuvre"] = -1, KL
    for k in range(41):
        left = 3.5 * k / 40  # of where the ego was at first
        ahead.x = ahead.x.copy()
        ahead.x[road.OFFSET] = left if left <= 1.75 else left - 3.5
        ahead.x[road.WAY] = 3.0 * k % road.SPACING
        reports["t_ns"], reports["age"] = k * S // 10, k + 1
        reports["x"] = [50, 0, 3.5 - left + curvature * 50**2 / 2, 0]
        history.watch(k * S // 10, reports)
        history(k * S // 10, reports)
    recorded = history.recorded()
    assert recorded.rows["y"] == pytest.approx(np.full(41, 3.5), abs=1e-5)
    assert recorded.ego_y == pytest.approx(3.5 * np.arange(41) / 40)
    assert recorded.width == 3.5
    draw_recording(tmp_path / "a.png", "a.log", recorded, [], 9.0)
    assert "lane 1" in [text.get_text() for text in drawn[0].axes[0].texts]
    assert drawn[0].axes[0].get_ylabel() == "across the road [m]"
