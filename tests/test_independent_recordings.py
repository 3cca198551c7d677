"""Accuracy on recordings that were made without this project: `oracles.ars408_traffic`."""

from __future__ import annotations

import csv
from pathlib import Path

from oracles.ars408_traffic import Truth, write_recording

from can_imm.cli.main import main

SEEDS = range(10)
FEW = range(3)


def accuracy(
    folder: Path, seeds: range, *options: str, smooth_changes: bool = False
) -> tuple[float, dict[str, int]]:
    """Share of the frames that are labelled as they should be, and how often which is not."""
    right = total = 0
    wrong: dict[str, int] = {}
    for seed in seeds:
        log, table = folder / f"{seed}.log", folder / f"{seed}.csv"
        truth = write_recording(log, seed, smooth=smooth_changes)
        arguments = ["--profile", "ars408", "--preset", "motorway", "--csv", str(table)]
        assert main(["replay", str(log), *arguments, *options]) == 0
        said = said_of(table, truth)
        for frame, label in truth.items():
            total += 1
            if said.get(frame) == label:
                right += 1
            else:
                key = f"{label} as {said.get(frame)}"
                wrong[key] = wrong.get(key, 0) + 1
    return right / total, wrong


def said_of(table: Path, truth: Truth) -> dict[tuple[int, int], str]:
    """Manoeuvres by scan and object: every scan is answered, in its own step."""
    with table.open() as file:
        rows = list(csv.DictReader(file))
    times = list(dict.fromkeys(row["time_s"] for row in rows))
    assert len(times) == len({scan for scan, _ in truth})
    scans = {time: scan for scan, time in enumerate(times)}
    return {(scans[row["time_s"]], int(row["object_id"])): row["manoeuvre"] for row in rows}


def test_as_published(tmp_path):
    """Lane changes at a constant rate: rules reach .970 on such recordings."""
    share, wrong = accuracy(tmp_path, SEEDS)
    assert share >= 0.974, wrong


def test_as_published_by_hindsight(tmp_path):
    share, wrong = accuracy(tmp_path, FEW, "--smooth")
    assert share >= 0.99, wrong


def test_smooth_lane_changes_by_hindsight(tmp_path):
    share, wrong = accuracy(tmp_path, FEW, "--smooth", smooth_changes=True)
    assert share >= 0.975, wrong


def test_smooth_lane_changes(tmp_path):
    """Their first and last half second can hardly be seen."""
    share, wrong = accuracy(tmp_path, FEW, smooth_changes=True)
    assert share >= 0.95, wrong
