"""Runs in processes, kept in a file."""

from __future__ import annotations

import pytest

from can_imm.studies.montecarlo import run_jobs
from can_imm.types import CanImmError

CALLS: list[str] = []


def work(key):
    CALLS.append(key)
    if key == "stop":
        raise KeyboardInterrupt
    return {"twice": 2 * int(key)}


@pytest.fixture(autouse=True)
def _fresh():
    CALLS.clear()


def test_results_by_key_in_their_order_and_each_once():
    seen = []
    done = run_jobs(work, ["3", "1", "3"], progress=lambda: seen.append(1))
    assert done == {"3": {"twice": 6}, "1": {"twice": 2}}
    assert list(done) == ["3", "1"]
    assert CALLS == ["3", "1"]
    assert len(seen) == 2


def test_goes_on_where_it_was_interrupted(tmp_path):
    store = tmp_path / "runs.jsonl"
    with pytest.raises(KeyboardInterrupt):
        run_jobs(work, ["1", "2", "stop", "4"], store=store)
    with store.open("a") as file:
        file.write('{"key": "4", "resu')  # killed while writing
    CALLS.clear()
    seen = []
    keys = ["1", "2", "4", "5"]
    done = run_jobs(work, keys, store=store, progress=lambda: seen.append(1))
    assert CALLS == ["4", "5"]
    assert len(seen) == 4
    assert done == {k: {"twice": 2 * int(k)} for k in keys}
    CALLS.clear()
    assert run_jobs(work, keys, store=store) == done
    assert CALLS == []


def test_a_file_of_something_else_is_refused_and_left_alone(tmp_path):
    store = tmp_path / "letter.txt"
    store.write_text("dear reader\nhello\n")
    with pytest.raises(CanImmError, match=r"letter\.txt: line 1 is not a finished run"):
        run_jobs(work, ["1"], store=store)
    assert store.read_text() == "dear reader\nhello\n"


@pytest.mark.slow
def test_processes_give_the_same():
    from can_imm.studies.bernoulli import study

    sweeps = {"particles": (10, 30)}
    one, two = (study(2, 3, sweeps=sweeps, jobs=jobs) for jobs in (1, 2))
    for a, b in zip(one.points, two.points, strict=True):
        assert (a.rmse == b.rmse).all()
