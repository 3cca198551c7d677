"""Many runs on many processes, kept in a file as they finish, so that a broken study can go on."""

from __future__ import annotations

import json
import multiprocessing
import signal
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any, TypeVar

from can_imm.types import CanImmError

J = TypeVar("J")
R = TypeVar("R")

Work = Callable[[str], Any]
"""Does the job of this key; must be a module's function, its result something JSON can hold."""


def run_jobs(
    work: Work,
    keys: Sequence[str],
    *,
    jobs: int = 1,
    store: Path | None = None,
    progress: Callable[[], None] = lambda: None,
) -> dict[str, Any]:
    """The result of each key; does not depend on ``jobs`` or on how often it was interrupted.

    Args:
        work: does one job.
        keys: what there is to do; a key must say everything that its result depends on.
        jobs: number of processes.
        store: file of finished jobs, a JSON object per line; what it holds is not done again, and
            what gets done is added.
        progress: called for every key.

    Raises:
        CanImmError: the store holds something else.
    """
    wanted = list(dict.fromkeys(keys))
    results = {k: v for k, v in _read(store).items() if k in set(wanted)}
    for _ in results:
        progress()
    todo = [key for key in wanted if key not in results]
    with _appending(store) as file:
        for key, result in _finished(work, todo, jobs):
            results[key] = result
            if file is not None:
                file.write(json.dumps({"key": key, "result": result}) + "\n")
                file.flush()
            progress()
    return {key: results[key] for key in wanted}


def _read(store: Path | None) -> dict[str, Any]:
    if store is None or not store.exists():
        return {}
    results = {}
    lines = store.read_text("utf-8").splitlines()
    for number, line in enumerate(lines, start=1):
        try:
            entry = json.loads(line)
            results[entry["key"]] = entry["result"]
        except (ValueError, KeyError, TypeError):
            if number == len(lines):
                break  # it was killed while writing
            raise CanImmError(f"{store}: line {number} is not a finished run") from None
    return results


@contextmanager
def _appending(store: Path | None) -> Iterator[IO[str] | None]:
    if store is None:
        yield None
        return
    text = store.read_text("utf-8") if store.exists() else ""
    with store.open("a", encoding="utf-8") as file:
        if text and not text.endswith("\n"):
            file.truncate(len(text[: text.rfind("\n") + 1].encode()))
        yield file


def _finished(work: Work, todo: Sequence[str], jobs: int) -> Iterator[tuple[str, Any]]:
    if jobs == 1:
        for key in todo:
            yield key, work(key)
        return
    # spawn: the same on every platform, and no fork of a process with threads
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(jobs, context, _leave_interrupts_to_the_parent) as pool:
        try:
            futures = {pool.submit(work, key): key for key in todo}
            for future in as_completed(futures):
                yield futures[future], future.result()
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise


def map_jobs(work: Callable[[J], R], todo: Sequence[J], jobs: int) -> Iterator[R]:
    """The result of each job, in their order; ``work`` must be a module's function."""
    if jobs == 1:
        yield from map(work, todo)
        return
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(jobs, context, _leave_interrupts_to_the_parent) as pool:
        try:
            yield from pool.map(work, todo)
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise


def _leave_interrupts_to_the_parent() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
