"""The Bernoulli filter's parameter study (Törő, Bécsi and Aradi 2018, section 4) by Monte Carlo.

Four sweeps, one parameter at a time: time between scans, particles, and the factors k_s and k_m of
the covariances of measurement and process.  k_s is the sensors' true noise, too.  The first second
is not judged: at the first detections little is known of the speed.  Run k of a setting uses seed
``seed + k``; with equal T_s and k_s settings see the same detections, and so do all systems.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from can_imm.estimation.bernoulli import BernoulliFilter, BernoulliModel
from can_imm.sim.cooperative import CooperativeScene, load_scene, play_scene
from can_imm.sim.scene import SceneRun
from can_imm.studies.cooperative_ekf import CooperativeEkf
from can_imm.studies.montecarlo import run_jobs
from can_imm.types import FloatArray, X, Y

PRODUCT, UNION, EKF = "bernoulli-product", "bernoulli-union", "ekf"
SYSTEMS = (PRODUCT, UNION, EKF)


@dataclass(frozen=True)
class Setting:
    """What is varied: T_s [s], N_p, k_s, k_m."""

    period: float = 0.1
    particles: int = 100
    k_s: float = 1.0
    k_m: float = 1.0


SWEEPS: dict[str, tuple[float, ...]] = {
    "period": (1.0, 0.5, 0.1, 0.05, 0.01, 0.005),
    "particles": (1, 10, 100, 1000, 10000),
    "k_s": (0.5, 1.0, 1.5, 2.0, 2.5, 3.0),
    "k_m": (0.5, 1.0, 1.5, 2.0, 2.5, 3.0),
}
QUICK_SWEEPS: dict[str, tuple[float, ...]] = {
    **SWEEPS, "period": (1.0, 0.5, 0.1, 0.05), "particles": (1, 10, 100, 1000),
}  # fmt: skip
"""Those of ``--quick``: the same without the longest runs."""

APPEARS_S, DISAPPEARS_S = 3.0, 6.0
EXISTENCE: dict[str, Any] = {"p_detection": 0.9, "clutter": 5.0}
"""Setting of the existence test: the object is there for a while, seen badly, in much clutter."""

PRESENT, ABSENT = 0.99, 0.1
"""The object is found, and lost, when q passes these."""

SETTLE_S = 1.0
"""From this time on a run is judged [s]."""

BINS = 50
"""Of the paper's histograms."""


def settings(sweeps: dict[str, tuple[float, ...]]) -> list[tuple[str, float, Setting]]:
    """(sweep, value, setting) of every point of the sweeps."""
    rows = []
    for name, values in sweeps.items():
        for value in values:
            kind: type = int if name == "particles" else float
            rows.append((name, value, replace(Setting(), **{name: kind(value)})))
    return rows


def model_for(setting: Setting, *, union: bool = False, **changes: float) -> BernoulliModel:
    """The filter's model; ``changes`` replace other parameters of it."""
    base, noise = BernoulliModel(), math.sqrt(setting.k_s)
    return replace(
        base,
        std_range=base.std_range * noise,
        std_bearing=base.std_bearing * noise,
        std_rate=base.std_rate * noise,
        density=base.density * setting.k_m,
        period_s=setting.period,
        union=union,
        **changes,
    )


def play(scene: CooperativeScene, model: BernoulliModel, seed: int) -> SceneRun:
    """One run of the scene with sensors as the model believes them to be."""
    radar = replace(
        scene.radar,
        std_range=model.std_range,
        std_bearing=model.std_bearing,
        std_rate=model.std_rate,
        detection=model.p_detection,
        clutter=model.clutter,
        range_max=model.range_max,
        rate_span=model.rate_span,
    )
    run = replace(scene, radar=radar, period=model.period_s)
    return play_scene(run, np.random.default_rng(seed))


def follow(
    run: SceneRun, model: BernoulliModel, particles: int, seed: int
) -> tuple[FloatArray, FloatArray]:
    """The Bernoulli filter's means (N, 4) and existence probabilities (N,) after every scan."""
    # another stream than the run's
    rng = np.random.default_rng([seed, 1])
    capacity = max(scan.n for scan in run.scans)
    f = BernoulliFilter(
        model, rng, particles=particles, births=5 * particles, capacity=max(capacity, 1)
    )
    x, q = np.zeros((len(run.scans), 4)), np.zeros(len(run.scans))
    before = run.scans[0].t_ns
    for k, scan in enumerate(run.scans):
        s, n = scan.n_sensors, scan.n
        dt = (scan.t_ns - before) * 1e-9
        f.step(dt, scan.pose[:s], scan.delay[:s], scan.sensor[:n], scan.z[:n])
        before = scan.t_ns
        x[k], q[k] = f.mean, f.q
    return x, q


def follow_ekf(run: SceneRun, model: BernoulliModel) -> FloatArray:
    """The EKF's means (N, 4) after every scan; NaN before it has begun."""
    ekf = CooperativeEkf(model)
    x = np.full((len(run.scans), 4), np.nan)
    before = run.scans[0].t_ns
    for k, scan in enumerate(run.scans):
        ekf.step((scan.t_ns - before) * 1e-9, scan)
        before = scan.t_ns
        if ekf.x is not None:
            x[k] = ekf.x
    return x


def _distance(scene: CooperativeScene, run: SceneRun, x: FloatArray) -> FloatArray:
    """(N,) Euclidean position errors of states in the road's axes [m]."""
    truth = scene.target.state(np.multiply(run.t_ns, 1e-9, dtype=np.float64))
    error: FloatArray = np.hypot(x[:, X] - truth[:, X], x[:, Y] - truth[:, Y])
    return error


def _errors_of(run: SceneRun, error: FloatArray, known: Any) -> list[float | None]:
    """Standard deviation about the mean, RMS, and share of the scans without an estimate."""
    judged = run.t_ns >= round(SETTLE_S * 1e9)
    missing = 1.0 - float(known[judged].mean())
    error = error[judged & known]
    if not len(error):
        return [None, None, missing]
    return [float(error.std()), float(np.sqrt(np.mean(error**2))), missing]


def errors_job(key: str) -> dict[str, list[float | None]]:
    """One run of one setting with all systems: [std, RMS, missing] of each (`_errors_of`)."""
    data = json.loads(key)
    setting, seed = Setting(**data["setting"]), int(data["seed"])
    scene = load_scene("cooperative")
    model = model_for(setting)
    run = play(scene, model, seed)
    results = {}
    for system in (PRODUCT, UNION):
        mine = replace(model, union=system == UNION)
        x, q = follow(run, mine, setting.particles, seed)
        results[system] = _errors_of(run, _distance(scene, run, x), q > 0.5)
    x = follow_ekf(run, model)
    results[EKF] = _errors_of(run, _distance(scene, run, x), np.isfinite(x[:, X]))
    return results


def existence_job(key: str) -> dict[str, list[int]]:
    """Scans with the object until q > .99, without it until q < .1, for both updates."""
    data = json.loads(key)
    seed, particles = int(data["seed"]), int(data["particles"])
    scene = load_scene("cooperative")
    target = replace(scene.target, appears=APPEARS_S, disappears=DISAPPEARS_S)
    scene = replace(scene, target=target, duration=9.0)
    model = model_for(Setting(), **EXISTENCE)
    run = play(scene, model, seed)
    t_s = np.multiply(run.t_ns, 1e-9)
    results = {}
    for system in (PRODUCT, UNION):
        _, q = follow(run, replace(model, union=system == UNION), particles, seed)
        there = q[(t_s >= APPEARS_S - 1e-9) & (t_s < DISAPPEARS_S - 1e-9)]
        gone = q[t_s >= DISAPPEARS_S - 1e-9]
        results[system] = [_first(there > PRESENT), _first(gone < ABSENT)]
    return results


def _first(is_so: Any) -> int:
    """Number of scans up to the first at which it is so; one more than there are if none."""
    return int(np.argmax(is_so)) + 1 if is_so.any() else len(is_so) + 1


@dataclass(frozen=True)
class Point:
    """One system at one point of a sweep: (R,) values of the runs, NaN where there is none."""

    system: str
    sweep: str
    value: float
    setting: Setting
    std: FloatArray
    rmse: FloatArray
    missing: FloatArray


@dataclass(frozen=True)
class Study:
    """Everything but run times; ``existence`` holds per system (R, 2) numbers of scans."""

    runs: int
    seed: int
    points: list[Point]
    existence: dict[str, FloatArray]


def study(
    runs: int,
    seed: int,
    *,
    sweeps: dict[str, tuple[float, ...]] | None = None,
    jobs: int = 1,
    store: Path | None = None,
    progress: Callable[[], None] = lambda: None,
) -> Study:
    """Run everything; see `run_jobs` for ``jobs``, ``store`` and ``progress``."""
    rows = settings(sweeps or SWEEPS)
    seeds = range(seed, seed + runs)
    keys, existence_keys = _keys(rows, seeds)
    done = run_jobs(job, keys + existence_keys, jobs=jobs, store=store, progress=progress)
    points = []
    for sweep, value, setting in rows:
        mine = [done[_key(setting, k)] for k in seeds]
        for system in SYSTEMS:
            table = np.array([result[system] for result in mine], dtype=np.float64)
            points.append(Point(system, sweep, value, setting, *table.T))
    existence = {
        system: np.array([done[key][system] for key in existence_keys], dtype=np.float64)
        for system in (PRODUCT, UNION)
    }
    return Study(runs, seed, points, existence)


def number_of_jobs(runs: int, sweeps: dict[str, tuple[float, ...]]) -> int:
    """How often ``progress`` is called by a study."""
    return runs * (len({setting for _, _, setting in settings(sweeps)}) + 1)


def job(key: str) -> Any:
    """One run, see `run_jobs`."""
    return existence_job(key) if "existence" in json.loads(key) else errors_job(key)


def _key(setting: Setting, seed: int) -> str:
    return json.dumps({"setting": asdict(setting), "settle_s": SETTLE_S, "seed": seed})


def _keys(
    rows: Sequence[tuple[str, float, Setting]], seeds: Iterable[int]
) -> tuple[list[str], list[str]]:
    # the longest first, so that no process ends long after the others
    chosen = sorted({row[2] for row in rows}, key=lambda s: -s.particles / s.period)
    keys = [_key(setting, seed) for setting in chosen for seed in seeds]
    existence = {"existence": EXISTENCE, "particles": Setting().particles}
    return keys, [json.dumps({**existence, "seed": seed}) for seed in seeds]


def mean_and_error(values: FloatArray) -> tuple[float, float]:
    """Mean and its standard error of the values that exist; NaN where there are too few."""
    known = values[np.isfinite(values)]
    n = len(known)
    mean = float(known.mean()) if n else math.nan
    return mean, float(known.std(ddof=1) / math.sqrt(n)) if n > 1 else math.nan


def linearity(x: FloatArray, y: FloatArray) -> tuple[float, float, float]:
    """Slope, intercept and R² of the straight line through the points."""
    slope, intercept = np.polyfit(x, y, 1)
    rest = y - (slope * x + intercept)
    return float(slope), float(intercept), float(1.0 - rest @ rest / np.sum((y - y.mean()) ** 2))


def sweep_means(done: Study, system: str, sweep: str, reading: str) -> tuple[FloatArray, ...]:
    """Values of the sweep, means and standard errors of ``std`` or ``rmse``."""
    points = [p for p in done.points if p.system == system and p.sweep == sweep]
    table = [(p.value, *mean_and_error(getattr(p, reading))) for p in points]
    return tuple(np.array(column) for column in zip(*table, strict=True))


def trends(done: Study) -> dict[str, Any]:
    """What the paper concludes, in numbers: per system and reading R² of the error over √k_s and
    over k_s, and the range of its means over k_m relative to their mean."""
    result: dict[str, Any] = {}
    for system in SYSTEMS:
        result[system] = {}
        for reading in ("std", "rmse"):
            k_s, over_k_s, _ = sweep_means(done, system, "k_s", reading)
            _, over_k_m, _ = sweep_means(done, system, "k_m", reading)
            result[system][reading] = {
                "r2_sqrt_k_s": round(linearity(np.sqrt(k_s), over_k_s)[2], 6),
                "r2_k_s": round(linearity(k_s, over_k_s)[2], 6),
                "k_m_effect": round(float(np.ptp(over_k_m) / over_k_m.mean()), 6),
            }
    return result


def to_json(done: Study, runtime: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """The study as a JSON object; a value that does not exist is None.

    ``rmse`` and ``std`` are means over runs of a run's position error in both readings [m],
    ``missing`` the mean share of scans without an estimate; standard errors under ``"se"``.
    """
    results = []
    for point in done.points:
        names = ("rmse", "std", "missing")
        found = {name: mean_and_error(getattr(point, name)) for name in names}
        mean, error = ({name: _known(pair[i]) for name, pair in found.items()} for i in (0, 1))
        setting = {"sweep": point.sweep, **asdict(point.setting)}
        results.append({"system": point.system, "setting": setting, **mean, "se": error})
    existence = []
    for system, scans in done.existence.items():
        appear, vanish = mean_and_error(scans[:, 0]), mean_and_error(scans[:, 1])
        existence.append(
            {
                "system": system,
                "setting": EXISTENCE,
                "scans_to_appear": _known(appear[0]),
                "scans_to_vanish": _known(vanish[0]),
                "worst_to_appear": int(scans[:, 0].max()),
                "worst_to_vanish": int(scans[:, 1].max()),
                "se": {
                    "scans_to_appear": _known(appear[1]), "scans_to_vanish": _known(vanish[1]),
                },
            }
        )  # fmt: skip
    return {
        "runs": done.runs,
        "seed": done.seed,
        "results": results,
        "existence": existence,
        "trends": trends(done),
        "runtime": list(runtime),
    }


def _known(value: float) -> float | None:
    return round(value, 6) if math.isfinite(value) else None
