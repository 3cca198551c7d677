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

SWITCH_INTERVAL_S = 1e-4
"""So soon a thread that computes hands over to the loop [s]; Python's own value is 5 ms."""

_MCL_CURRENT_AND_FUTURE = 3


def ask_process() -> None:
    """Lock memory, freeze the collector, shorten the switch interval; call it once, when
    everything is allocated.  What is refused is left as it was."""
    sys.setswitchinterval(SWITCH_INTERVAL_S)
    gc.collect()
    gc.freeze()
    gc.disable()
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL(None, use_errno=True).mlockall(_MCL_CURRENT_AND_FUTURE)


def ask_thread() -> None:
    """Ask for SCHED_FIFO and the last of the allowed cores, for the calling thread."""
    with contextlib.suppress(OSError, AttributeError):
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    with contextlib.suppress(OSError, AttributeError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))


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
