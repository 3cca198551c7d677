"""What the operating system grants to a loop that wants to be on time."""

from __future__ import annotations

import contextlib
import ctypes
import gc
import os
import sys
from typing import Any

PRIORITY = 50
"""Under SCHED_FIFO; above ordinary work, below the kernel's own threads."""

_MCL_CURRENT_AND_FUTURE = 3


def ask_process() -> None:
    """Lock memory, freeze the collector, and ask for SCHED_FIFO for the calling thread and those
    that it will start; call it once, when everything is allocated.  What is refused is left as it
    was.

    The threads beside the loop need it, too: one of them may hold the interpreter's lock when the
    loop wants it, and must not be made to wait then.  The switch interval stays Python's own: were
    it shorter, every thread that is woken by a frame would break into the step.
    """
    gc.collect()
    gc.freeze()
    gc.disable()
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL(None, use_errno=True).mlockall(_MCL_CURRENT_AND_FUTURE)
    _ask_fifo(PRIORITY - 1)


def ask_thread() -> None:
    """Ask for the last of the allowed cores and precedence over the other threads, for the calling
    thread."""
    with contextlib.suppress(OSError, AttributeError):
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    _ask_fifo(PRIORITY)


def _ask_fifo(priority: int) -> None:
    with contextlib.suppress(OSError, AttributeError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))


def granted() -> dict[str, Any]:
    """What the calling thread and its process have."""
    names = {getattr(os, f"SCHED_{name}", -1): name.lower() for name in ("OTHER", "FIFO", "RR")}
    known = hasattr(os, "sched_getscheduler")
    return {
        "scheduler": names.get(os.sched_getscheduler(0), "?") if known else "unknown",
        "affinity": sorted(os.sched_getaffinity(0)) if known else [],
        "locked_memory_kib": _status("VmLck"),
        "collector": ("on" if gc.isenabled() else "off")
        + (", frozen" if gc.get_freeze_count() else ""),
        "switch_interval_s": sys.getswitchinterval(),
    }


def in_words(granted: dict[str, Any]) -> str:
    """What `granted` returned, in one line."""
    return ", ".join(f"{key.replace('_', ' ')} {value}" for key, value in granted.items())


def resident_kib() -> int:
    """Memory of this process [KiB], 0 where the system does not tell."""
    return _status("VmRSS")


def _status(key: str) -> int:
    try:
        with open("/proc/self/status", encoding="ascii") as file:
            lines = [line for line in file if line.startswith(f"{key}:")]
    except OSError:
        return 0
    return int(lines[0].split()[1]) if lines else 0
