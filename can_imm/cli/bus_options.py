"""python-can's own bus options on our commands."""

from __future__ import annotations

import argparse
import logging
from typing import TYPE_CHECKING

from can.cli import add_bus_arguments

if TYPE_CHECKING:
    import can

__all__ = ["add_bus_arguments", "bus_wanted", "open_bus_from"]

OPTIONS = ("channel", "interface", "bitrate", "fd", "data_bitrate", "timing", "bus_kwargs")


def bus_wanted(args: argparse.Namespace) -> bool:
    """Whether any bus option was given on the command line."""
    return any(hasattr(args, option) for option in OPTIONS)


def open_bus_from(args: argparse.Namespace) -> can.BusABC:
    """Open the bus that the options and python-can's configuration files describe.

    Raises:
        CanImmError: there is none, or it cannot be opened.
    """
    from can_imm.bus.buses import open_bus_from_namespace

    # The driver's log lines would say a second time what our one line says.
    logging.getLogger("can").addHandler(logging.NullHandler())
    return open_bus_from_namespace(args)
