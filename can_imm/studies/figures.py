"""The figures of a study: the paper's figures 3 to 8 of one run, and the study's comparisons."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from can_imm.plots import paper as plots
from can_imm.studies.metrics import summarise
from can_imm.studies.paper import TABLE_6, Result
from can_imm.studies.runs import Observation, play
from can_imm.studies.systems import Answer, answer

PROFILE = np.array([(50.0, 0.0), (51.1, 2.1), (52.6, 2.1), (53.75, 0.0)])
"""Corners (gap [m], relative speed [m/s]) of the paper's f(x), Fig. 4."""


def one_run(directory: Path, system: str, truth: str, seed: int) -> list[Path]:
    """Figures 3 to 8 of what a preset (or mode bank) says in one run."""
    scans, observations = play(truth, seed)
    seen = observations[0]
    said = answer(system, scans, observations, seed)[0]
    if said.p is None:
        raise ValueError(f"{system} gives no probabilities to draw")
    return paper_figures(directory, seen, said)


def paper_figures(directory: Path, seen: Observation, said: Answer) -> list[Path]:
    """Figures 3 to 8 of what a system with probabilities says of one object."""
    assert said.manoeuvre is not None
    assert said.p is not None
    true = seen.truth
    run = plots.Run(
        truth_t_s=np.multiply(true.t_ns, 1e-9),
        truth_label=true.label,
        truth_state=true.state,
        speed=true.speed,
        steer=true.steer,
        heading=true.heading,
        t_s=np.multiply(seen.t_ns, 1e-9),
        label=seen.label,
        state=seen.state,
        z=seen.z,
        said=said.manoeuvre,
        p=said.p,
        x=said.x,
        cov=said.cov,
    )
    return plots.paper_figures(directory, run, PROFILE)


def comparisons(directory: Path, runs: int, results: Sequence[Result]) -> list[Path]:
    """Per truth the systems' errors side by side; per system with classes its confusion."""
    paths = []
    for truth in dict.fromkeys(result.truth for result in results):
        here = [result for result in results if result.truth == truth]
        summaries = [summarise(result.metrics) for result in here]
        accuracy, rmse = (
            np.array([[s[name] for name in names] for s in summaries])
            for names in (["accuracy"], [f"rmse_{state}" for state in TABLE_6])
        )
        names = [result.system for result in here]
        if truth != "random":
            # the paper's own figures: no accuracy, no standard errors
            names.append("paper, Table 6")
            accuracy = np.concatenate((accuracy, np.full((1, 1, 2), np.nan)))
            table = np.stack((list(TABLE_6.values()), np.full(4, np.nan)), axis=-1)
            rmse = np.concatenate((rmse, table[None]))
        paths.append(
            plots.comparison(
                directory,
                f"comparison_{truth}",
                f"{_title(truth)}: means of {runs} runs, whiskers ±2 standard errors",
                names,
                1 - accuracy[:, 0, 0],
                accuracy[:, 0, 1],
                rmse[:, :, 0],
                rmse[:, :, 1],
            )
        )
        for result in here:
            counts = np.sum([m.confusion for m in result.metrics], axis=0)
            if counts.any():
                paths.append(
                    plots.confusion(
                        directory,
                        f"confusion_{truth}_{Path(result.system).stem}",
                        f"{result.system}, {_title(truth)}: % of each true manoeuvre",
                        counts,
                    )
                )
    return paths


def _title(truth: str) -> str:
    return "random scenarios" if truth == "random" else f"truth {truth}"
