"""Opening a bus: python-can's own options and configuration files, one clear line on failure."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from typing import Any

import can
from can.cli import create_bus_from_namespace
from can.interfaces.virtual import VirtualBus
from can.util import load_config

from can_imm.bus.errors import one_line
from can_imm.types import CanImmError

MULTICAST_GROUP = "239.74.163.2"
"""python-can's IPv4 group; with a hop limit of 0 the packets do not leave the machine."""


def open_bus(
    interface: str | None = None, channel: str | None = None, **options: Any
) -> can.BusABC:
    """Open a bus by python-can; what is not given comes from its configuration files.

    Raises:
        CanImmError: there is no such bus, or it cannot be opened.
    """
    given = {"interface": interface, "channel": channel, **options}
    given = {key: value for key, value in given.items() if value is not None}
    settings = {**_defaults(given), **given}
    return _open(lambda: can.Bus(**settings), settings)


def open_bus_from_namespace(
    namespace: argparse.Namespace, *, prefix: str | None = None, **options: Any
) -> can.BusABC:
    """Open the bus that the options of `can.cli.add_bus_arguments` describe.

    Raises:
        CanImmError: there is no such bus, or it cannot be opened.
    """
    start = f"{prefix}_" if prefix else ""
    given = {
        key: getattr(namespace, start + key)
        for key in ("interface", "channel")
        if hasattr(namespace, start + key)
    }
    settings = {**_defaults(given), **options}
    return _open(
        lambda: create_bus_from_namespace(namespace, prefix=prefix, **settings),
        {**settings, **given},
    )


def in_one_process(bus: can.BusABC) -> bool:
    """Whether the bus reaches no further than this process."""
    return isinstance(bus, VirtualBus)


def _defaults(given: dict[str, Any]) -> dict[str, Any]:
    """What a user of udp_multicast would want without saying so: stay on this machine."""
    interface = given.get("interface")
    configured: dict[str, Any] = {}
    if interface is None:
        try:
            configured = dict(load_config(config=dict(given)))
        except can.CanError:
            return {}
        interface = configured.get("interface")
    if interface != "udp_multicast":
        return {}
    defaults: dict[str, Any] = {"hop_limit": configured.get("hop_limit", 0)}
    if "channel" not in given and configured.get("channel") is None:
        defaults["channel"] = MULTICAST_GROUP
    return defaults


def _open(create: Callable[[], can.BusABC], settings: dict[str, Any]) -> can.BusABC:
    try:
        return create()
    except Exception as error:  # drivers raise whatever they like
        # create_bus_from_namespace hides the reason behind a line on its arguments
        hidden = error.__cause__ if isinstance(error, argparse.ArgumentError) else None
        interface = settings.get("interface", "(no interface)")
        channel = settings.get("channel", "(no channel)")
        reason = one_line(hidden or error)
        raise CanImmError(f"cannot open bus {interface} {channel}: {reason}") from error
