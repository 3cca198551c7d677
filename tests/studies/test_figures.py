"""The figures: which files appear, and that what they show is what they were given."""

from __future__ import annotations

import matplotlib.figure
import numpy as np
import pytest

from can_imm.plots import paper as plots
from can_imm.plots.style import COLOURS
from can_imm.studies import figures
from can_imm.studies.paper import Result, score
from can_imm.studies.runs import play
from can_imm.studies.systems import Answer, answer
from can_imm.types import Manoeuvre

PNG = b"\x89PNG\r\n\x1a\n"
PAPER_FIGURES = [
    "fig3_controls",
    "fig4_overtaking_profile",
    "fig5_mode_probabilities",
    "fig6_manoeuvres",
    "fig7_states",
    "fig8_errors",
]


@pytest.fixture
def drawn(monkeypatch):
    """The figures that were saved, by file name; nothing is rendered."""
    saved: dict[str, matplotlib.figure.Figure] = {}

    def savefig(figure, path, **_):
        saved[path.stem] = figure

    monkeypatch.setattr(matplotlib.figure.Figure, "savefig", savefig)
    return saved


def rules_with_probabilities(system, scans, seen, seed):
    said = answer("rules", scans, seen, seed)[0]
    return [Answer(said.manoeuvre, np.eye(8)[said.manoeuvre], said.x, said.cov)]


def test_one_run_gives_figures_3_to_8_as_png(tmp_path, monkeypatch):
    monkeypatch.setattr(figures, "answer", rules_with_probabilities)
    paths = figures.one_run(tmp_path / "new" / "folder", "two-lane", "A", 1)
    assert [path.stem for path in paths] == PAPER_FIGURES
    for path in paths:
        assert path.read_bytes().startswith(PNG)


def test_a_baseline_has_no_probabilities_to_draw(tmp_path):
    with pytest.raises(ValueError, match="rules gives no probabilities"):
        figures.one_run(tmp_path, "rules", "A", 1)


def test_states_and_errors_show_the_arrays(tmp_path, drawn):
    t_s = np.arange(5) * 0.1
    state, z, x = (np.arange(20.0).reshape(5, 4) + k for k in (0, 1, 2))
    cov = np.tile(np.diag([1.0, 4.0, 9.0, 16.0]), (5, 1, 1))
    plots.states(tmp_path, t_s, state, z, x)
    plots.errors(tmp_path, t_s, state, x, cov)
    for i, axes in enumerate(drawn["fig7_states"].axes):
        lines = {line.get_label(): line.get_ydata() for line in axes.lines}
        assert lines["true"].tolist() == state[:, i].tolist()
        assert lines["measured"].tolist() == z[:, i].tolist()
        assert lines["filtered"].tolist() == x[:, i].tolist()
    units = [axes.get_ylabel() for axes in drawn["fig7_states"].axes]
    assert units == ["$x$ [m]", "$v_x$ [m/s]", "$y$ [m]", "$v_y$ [m/s]"]
    for i, axes in enumerate(drawn["fig8_errors"].axes):
        assert axes.lines[0].get_ydata().tolist() == [2.0] * 5
        band = axes.collections[0].get_datalim(axes.transData)
        assert (band.y0, band.y1) == pytest.approx((-2 * (i + 1), 2 * (i + 1)))


def test_bands_have_the_colours_and_times_of_the_manoeuvres(tmp_path, drawn):
    t_s = np.array([0.0, 1, 2, 3, 4])
    labels = np.array([1, 1, 2, 2, 2], np.int8)
    said = np.array([0, 1, 1, 2, 2], np.int8)
    plots.manoeuvre_bands(tmp_path, t_s, labels, said)
    axes = drawn["fig6_manoeuvres"].axes[0]
    bars = []
    for collection in axes.collections:
        for path in collection.get_paths():
            box = path.get_extents()
            colour = matplotlib.colors.to_hex(collection.get_facecolor()[0])
            bars.append((box.x0, box.x1, round(box.y0 + box.height / 2), colour))
    palette = COLOURS
    assert bars[:5] == [
        (0, 2, 2, palette[Manoeuvre.KEEP_RIGHT]),
        (2, 4, 2, palette[Manoeuvre.LANE_CHANGE]),
        (0, 1, 1, palette[Manoeuvre.UNKNOWN]),
        (1, 3, 1, palette[Manoeuvre.KEEP_RIGHT]),
        (3, 4, 1, palette[Manoeuvre.LANE_CHANGE]),
    ]
    assert [(b[0], b[1]) for b in bars[5:]] == [(0, 1), (2, 3)]  # where they differ


def test_every_manoeuvre_has_a_colour_of_its_own():
    assert set(COLOURS) == set(Manoeuvre)
    assert len(set(COLOURS.values())) == len(Manoeuvre)


def test_comparisons_put_table_6_beside_the_published_truths_only(tmp_path, drawn):
    results = []
    for truth in ("A", "random"):
        for system in ("rules", "measurement"):
            metrics = []
            for seed in (1, 2):
                scans, seen = play(truth, seed)
                metrics.append(score(seen[0], answer(system, scans, seen, seed)[0]))
            results.append(Result(system, truth, metrics))
    paths = figures.comparisons(tmp_path, 2, results)
    assert [path.stem for path in paths] == [
        "comparison_A",
        "confusion_A_rules",
        "comparison_random",
        "confusion_random_rules",
    ]
    names = {
        truth: [t.get_text() for t in drawn[f"comparison_{truth}"].axes[0].get_yticklabels()]
        for truth in ("A", "random")
    }
    assert names["A"] == ["rules", "measurement", "paper, Table 6"]
    assert names["random"] == ["rules", "measurement"]
    widths = [bar.get_width() for bar in drawn["comparison_A"].axes[1].patches]
    assert widths[-1] == 0.1531
    assert widths[1] == pytest.approx(0.1, abs=0.01)
    percent = [float(t.get_text()) for t in drawn["confusion_A_rules"].axes[0].texts]
    assert sum(percent) == pytest.approx(700, abs=1)  # seven rows of 100 %
