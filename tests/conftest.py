"""Shared by all tests; its place also puts this directory on the path, for ``oracles``."""

from __future__ import annotations

from hypothesis import settings

# The first example of many tests compiles kernels, so there is no deadline per example; the same
# examples in every run, so that a red run is red again.
settings.register_profile("can_imm", deadline=None, derandomize=True)
settings.load_profile("can_imm")
