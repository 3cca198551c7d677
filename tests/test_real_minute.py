"""A minute of a real radar on a motorway, by what can be read off its tracks by hand."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import pytest

from can_imm.cli.main import main

LOG = Path(__file__).parents[2] / "shared/data/comma2k19/comma2k19_rav4_bus0_bus1.log"
BEGIN_S = 46408.6
MIDDLE_S = 7.8
"""Object 2 leaves the ego's lane to the right between 5 and 10 s; half of its way is done then."""

pytestmark = pytest.mark.skipif(not LOG.exists(), reason="the recording is not here")


@pytest.mark.parametrize("options", [[], ["--smooth"]])
def test_a_minute_on_the_motorway(tmp_path: Path, options: list[str]) -> None:
    events, table = tmp_path / "events.json", tmp_path / "rows.csv"
    files = ["--events", str(events), "--csv", str(table)]
    command = ["replay", str(LOG), "--profile", "toyota", "--preset", "motorway"]
    assert main([*command, *files, *options]) == 0
    changes: list[dict[str, Any]] = [
        event
        for event in json.loads(events.read_text())["events"]
        if event["manoeuvre"] == "LANE_CHANGE"
    ]
    (its,) = (event for event in changes if event["object_id"] == 2 and event["from_s"] < 46420.0)
    middle = 0.5 * (its["from_s"] + its["to_s"]) - BEGIN_S
    assert middle == pytest.approx(MIDDLE_S, abs=0.7)
    assert (its["direction"], its["event"]) == ("right", "CUT_OUT")
    assert len(changes) <= 2, "one may be false"
    with table.open() as file:
        rows = list(csv.DictReader(file))
    lanes = [
        row["lane"]
        for row in rows
        if row["object_id"] == "3" and 10.7 <= float(row["time_s"]) - BEGIN_S <= 51.5
    ]
    assert len(lanes) > 800
    assert lanes.count("-1") >= 0.95 * len(lanes)
