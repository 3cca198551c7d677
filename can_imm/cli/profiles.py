"""List the radars that can be read, or explain a profile: what of a bus or a log it would read.

  can-imm profiles                              the built-in profiles
  can-imm profiles check my-radar.toml          a profile of your own, in words
  can-imm profiles check ars408 --log drive.blf also what it finds in a recording

A profile is a TOML file beside a DBC: see the top of dbc/ars408.toml, and the README.
"""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from can_imm.bus.profile import Profile
    from can_imm.types import Scan


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.set_defaults(what="list")
    actions = parser.add_subparsers(metavar="ACTION")
    check = actions.add_parser("check", help="explain a profile and look for mistakes in it")
    check.set_defaults(what="check")
    check.add_argument("profile", metavar="NAME|FILE", help="a built-in profile, or a TOML file")
    check.add_argument("--log", metavar="LOG", help="count what of this recording it reads")
    check.add_argument(
        "--sensor", type=int, metavar="N", help="the sensor's number, where several share a bus"
    )


def run(args: argparse.Namespace) -> int:
    if args.what == "list":
        _list()
        return 0
    from can_imm.bus.describe import describe
    from can_imm.bus.profile import load_profile

    profile = load_profile(args.profile, sensor=args.sensor)
    for heading, lines in describe(profile):
        for k, line in enumerate(lines):
            print(f"{heading if k == 0 else '':<12}{line}")
    if args.log:
        _print_log(profile, args.log)
    return 0


def _list() -> None:
    from can_imm.bus.describe import frame_ids, measures, tells_ego
    from can_imm.bus.profile import builtin_profiles, load_profile

    rows = [("name", "scans/s", "frames", "measures", "ego motion", "protection", "radar")]
    for name in builtin_profiles():
        profile = load_profile(name)
        rows.append(
            (
                name, f"{1e9 / profile.period_ns:.3g}", frame_ids(profile), measures(profile),
                tells_ego(profile), profile.protection, profile.description,
            )
        )  # fmt: skip
    widths = [max(len(row[k]) for row in rows) for k in range(len(rows[0]))]
    for row in rows:
        print(
            "  ".join(text.ljust(width) for text, width in zip(row, widths, strict=True)).rstrip()
        )


def _print_log(profile: Profile, log: str) -> None:
    """Print what the profile reads of a recording."""
    from collections import Counter
    from dataclasses import asdict

    from can_imm.bus.decoder import ScanDecoder
    from can_imm.bus.sources import LogSource

    decoder = ScanDecoder(profile, 255)
    seen: Counter[int] = Counter()
    first = None
    sizes = 0
    begin = end = None
    with LogSource(log) as source:
        for frame in source:
            if frame.id in decoder.ids:
                seen[frame.id] += 1
            scan = decoder.feed(frame)
            if scan is None:
                continue
            sizes += scan.n
            begin = scan.t_ns if begin is None else begin
            end = scan.t_ns
            if first is None and scan.n:
                first = _object_lines(profile, scan)
    counts = decoder.counts
    print(f"{'log':<12}{log}")
    names = _names(profile)
    for frame_id in sorted(seen)[:24]:
        print(f"{'':<12}0x{frame_id:X} {names.get(frame_id, '')}: {seen[frame_id]:,} frames")
    if len(seen) > 24:
        print(f"{'':<12}... and {len(seen) - 24} ids more")
    fates = ", ".join(f"{n:,} {name.replace('_', ' ')}" for name, n in asdict(counts).items() if n)
    print(f"{'':<12}{fates or 'nothing'}")
    if decoder.sensor is not None and profile.sensors.number > 1:
        print(f"{'':<12}sensor {decoder.sensor} was read")
    if counts.scans and begin is not None and end is not None and end > begin:
        rate = (counts.scans - 1) / (end - begin) * 1e9
        print(f"{'':<12}{rate:.3g} scans per second, {sizes / counts.scans:.1f} objects each")
    for k, line in enumerate(first or ["none: nothing in this log is an object of this profile"]):
        print(f"{'first object' if k == 0 else '':<13}{line}")


def _names(profile: Profile) -> dict[int, str]:
    names = {}
    headers = [profile.header.message] if profile.header else []
    for sensor in range(profile.sensors.number):
        for message in (*headers, *profile.object_messages):
            step = sensor * profile.sensors.id_step
            of = f" of sensor {sensor}" if profile.sensors.number > 1 else ""
            names[message.frame_id + step] = message.name + of
    for part in profile.ego.parts if profile.ego else ():
        if part is not None:
            names[part.message.frame_id] = part.message.name
    return names


def _object_lines(profile: Profile, scan: Scan) -> list[str]:
    import math

    from can_imm.bus.profile_parts import STATES

    z, std, valid = scan.z[0], scan.std[0], scan.valid[0]
    lines = [f"id {scan.ids[0]} at {scan.t_ns / 1e9:.6f} s"]
    if profile.polar:
        lines.append(f"along the line of sight, {math.degrees(scan.angle[0]):.1f} deg to the left:")
    names = ("range", "rate", "across") if profile.polar else STATES
    units = ("m", "m/s", "m", "m/s")
    values = [
        f"{name} {z[k]:.2f} +- {std[k]:.2f} {units[k]}" if valid[k] else f"{name} not available"
        for k, name in enumerate(names)
        if profile.state[k] is not None
    ]
    lines.append(", ".join(values))
    if profile.existence is not None:
        lines.append(f"probability of existence {scan.existence[0]:g}")
    lines.append(f"ego speed {scan.ego_speed:.2f} m/s, yaw rate {scan.ego_yaw_rate:.4f} rad/s")
    return lines
