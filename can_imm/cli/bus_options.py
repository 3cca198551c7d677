"""python-can's own bus options on our commands."""

from __future__ import annotations

import argparse
import logging

import can.cli

OPTIONS = ("channel", "interface", "bitrate", "fd", "data_bitrate", "timing", "bus_kwargs")


def add_bus_arguments(parser: argparse.ArgumentParser) -> None:
    """Add python-can's options for one bus."""
    can.cli.add_bus_arguments(parser)
    for action in parser._actions:
        if action.dest == "interface" and action.choices:
            # two dozen names in braces, twice, would bury everything else
            action.metavar = "INTERFACE"
            action.help = f"the CAN interface: {', '.join(action.choices)}"


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


def bus_name(args: argparse.Namespace, bus: can.BusABC) -> str:
    """Name an open bus in a message to the user."""
    if bus.channel_info != "unknown":
        return bus.channel_info
    return f"{getattr(args, 'interface', 'bus')} {getattr(args, 'channel', '')}".rstrip()
