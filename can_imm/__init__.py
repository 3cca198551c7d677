"""Manoeuvre detection on the CAN bus with a constrained interacting-multiple-model estimator."""

__version__ = "0.1.0"
