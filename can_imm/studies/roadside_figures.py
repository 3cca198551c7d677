"""The figures of the roadside study."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from can_imm.plots import roadside as plots
from can_imm.studies.roadside import (
    DETECTED,
    ERRORS,
    PUBLISHED,
    Study,
    per_run,
    reduction,
    squared_errors,
)
from can_imm.types import (
    BEARING,
    POSE_HEADING,
    POSE_X,
    POSE_Y,
    RANGE,
    VX,
    VY,
    FloatArray,
)


def figures(directory: Path, done: Study) -> list[Path]:
    """Draw everything: the first run from above, errors, turn probability, reductions."""
    runs = len(done.results[0].x)
    bend, t_s = done.bend, done.t_s
    lidars = [
        plots.LidarView(
            lidar.x, lidar.y, lidar.heading, done.scene.model.field_of_view, done.scene.model.range
        )
        for lidar in done.scene.lidars
    ]
    first = {result.system: result.x[0] for result in done.results}
    rms = {
        result.system: tuple(
            np.sqrt(square.mean(axis=0))
            for square in squared_errors(result.x, done.run.state).values()
        )
        for result in done.results
    }
    paths = [
        plots.trajectory(directory, lidars, done.run.state, _points(done), first),
        plots.errors(
            directory,
            f"RMS errors of {runs} runs; the first second is not judged",
            t_s,
            bend,
            done.run.visible.sum(axis=1).astype(np.float64),
            rms,
        ),
    ]
    speed = float(np.hypot(done.run.state[0, VX], done.run.state[0, VY]))
    for result in done.results:
        if "p_turn_straight" in per_run(done, result):
            title = f"{result.system}: probability of a turn in {runs} runs at {speed:g} m/s"
            paths.append(
                plots.turn_probability(directory, title, t_s, bend, result.p_turn, DETECTED)
            )
    paths.append(plots.reductions(directory, _REDUCTIONS, _rows(done)))
    return paths


_REDUCTIONS = "By how much the IMM's RMSE is smaller; whiskers ±2 standard errors"


def _rows(done: Study) -> list[tuple[str, list[float], list[float]]]:
    # the paper's second figure is shown under both meanings that "speed" may have
    position, speed = PUBLISHED["reduction"]
    rows = [("paper: IMM, single CV", [position, speed, speed], [np.nan] * 3)]
    values = {result.system: per_run(done, result) for result in done.results}
    mine = values[done.results[-1].system]
    for other in list(values)[:-1]:
        pairs = [reduction(mine[name], values[other][name]) for name in ERRORS]
        rows.append((f"against {other}", [p[0] for p in pairs], [p[1] for p in pairs]))
    return rows


def _points(done: Study) -> FloatArray:
    """x and y (K, 2) of all detections of the first run."""
    points = []
    for scan in done.run.scans:
        pose = scan.pose[scan.sensor[: scan.n]]
        z = scan.z[: scan.n]
        angle = pose[:, POSE_HEADING] + z[:, BEARING]
        points.append(
            np.stack(
                (
                    pose[:, POSE_X] + z[:, RANGE] * np.cos(angle),
                    pose[:, POSE_Y] + z[:, RANGE] * np.sin(angle),
                ),
                axis=-1,
            )
        )
    return np.concatenate(points)
