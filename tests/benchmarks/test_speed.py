"""What a change costs: ``pytest -m benchmark``, compare runs with ``--benchmark-compare``."""

from __future__ import annotations

import pytest

from can_imm.bus.profile import load_profile
from can_imm.manoeuvres import load_bank
from can_imm.studies import bench

pytestmark = pytest.mark.benchmark


@pytest.mark.parametrize("objects", [1, 64])
def test_six_filters(benchmark, objects):
    benchmark(bench.Estimator(bench.six_filters(), objects).run)


@pytest.mark.parametrize("count", [500, 5000])
def test_particles(benchmark, count):
    benchmark(bench.Estimator(bench.with_particles(count), 1).run)


def test_decode(benchmark):
    benchmark(bench.decode_case().ours.run)


def test_replay(benchmark, tmp_path):
    log = tmp_path / "simulated.log"
    bench.write_log(log, seconds=5)
    cases = bench.replay_cases(log, load_profile("can_imm"), load_bank("two-lane"), 1.0)
    benchmark(cases[0].ours.run)
