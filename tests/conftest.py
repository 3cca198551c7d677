"""Shared by all tests; its place also puts this directory on the path, for ``oracles``."""

from __future__ import annotations

import signal

from hypothesis import settings

# A shell starts its background jobs with SIGINT ignored, and programs that the tests start would
# inherit that; a handler they do not.
signal.signal(signal.SIGINT, signal.default_int_handler)

# The first example of many tests compiles kernels, so there is no deadline per example; the same
# examples in every run, so that a red run is red again.
settings.register_profile("can_imm", deadline=None, derandomize=True)
settings.load_profile("can_imm")
