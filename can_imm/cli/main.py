"""The ``can-imm`` command: finds the subcommand, runs it, turns errors into one line and a status.

A subcommand is a module of this package, named in `COMMANDS`, with two functions::

    def add_arguments(parser: argparse.ArgumentParser) -> None: ...
    def run(args: argparse.Namespace) -> int: ...  # the exit status

The module's docstring is the description that ``can-imm COMMAND --help`` shows.  Only the chosen
command's module is imported, so ``can-imm --help`` costs no numpy, numba or python-can: import
nothing heavy at the top of this file, and nothing heavy at the top of a command's module that its
``add_arguments`` can do without.

Exit status: 0 done, 1 failed (one line ``can-imm: error: ...`` on stderr), 2 wrong usage,
128 + the signal's number when a signal ended the command.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib
import io
import os
import signal
import sys
from collections.abc import Iterable, Iterator, Sequence
from types import FrameType
from typing import Any

from can_imm import __version__

COMMANDS = {
    "demo": "watch the detector follow the published scenario, then read how well it did",
    "simulate": "play a scenario as radar frames onto a bus and/or into a log file",
    "track": "make objects of the detections of several sensors, on a bus or in a log",
    "detect": "listen on a bus and answer with manoeuvre frames until Ctrl-C",
    "replay": "run the detector over a recorded log",
    "profiles": "list the radars that can be read, or explain a profile of your own",
    "latency": "measure how long answers take on a bus, stage by stage",
    "bench": "measure the speed beside filterpy, cantools and python-can",
    "study": "measure the detector by Monte Carlo and draw the paper's figures",
}


def build_parser(commands: Iterable[str]) -> argparse.ArgumentParser:
    """Return the parser, with the arguments of ``commands`` filled in (the others stay empty)."""
    parser = argparse.ArgumentParser(
        prog="can-imm",
        description="Detect driving manoeuvres from radar objects on a CAN bus, in real time.",
        epilog="Try 'can-imm demo' first; 'can-imm COMMAND --help' explains a command.",
    )
    parser.add_argument("--version", action="version", version=f"can-imm {__version__}")
    parser.add_argument(
        "--print-completion",
        action=_PrintCompletion,
        choices=("bash", "zsh", "tcsh"),
        help="print a shell completion script and exit",
    )
    subparsers = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    wanted = set(commands)
    for name, summary in COMMANDS.items():
        subparser = subparsers.add_parser(
            name, help=summary, formatter_class=argparse.RawDescriptionHelpFormatter
        )
        if name in wanted:
            module = importlib.import_module(f"can_imm.cli.{name}")
            subparser.description = (module.__doc__ or "").strip()
            subparser.set_defaults(run=module.run)
            module.add_arguments(subparser)
    return parser


class _PrintCompletion(argparse.Action):
    def __call__(
        self,
        parser: argparse.ArgumentParser,
        namespace: argparse.Namespace,
        values: Any,
        option_string: str | None = None,
    ) -> None:
        import shtab

        print(shtab.complete(build_parser(COMMANDS), values))
        parser.exit(0)


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; ``argv`` defaults to the process's arguments.  Returns the exit status."""
    argv = sys.argv[1:] if argv is None else list(argv)
    try:
        args = _parse(argv)
        with _sigterm_raises():
            status: int = args.run(args)
        sys.stdout.flush()
        return status
    except KeyboardInterrupt:
        return 128 + signal.SIGINT
    except _Terminated:
        return 128 + signal.SIGTERM
    except BrokenPipeError:
        # The reader of our output left.  Nothing more can be said, not even at interpreter exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 128 + signal.SIGPIPE
    except OSError as error:
        where = f"{error.filename}: " if error.filename else ""
        return _fail(f"{where}{error.strerror or error}")
    except Exception as error:
        from can_imm.types import CanImmError

        if not isinstance(error, CanImmError):
            raise
        return _fail(str(error))


def _fail(message: str) -> int:
    print(f"can-imm: error: {message}", file=sys.stderr)
    return 1


def _parse(argv: list[str]) -> argparse.Namespace:
    chosen = [arg for arg in argv if arg in COMMANDS][:1]
    # python-can's option parsers print to stdout, which may carry data.  Help and version texts
    # come with a SystemExit and are let through.
    said = io.StringIO()
    try:
        with contextlib.redirect_stdout(said):
            return build_parser(chosen).parse_args(argv)
    except SystemExit:
        sys.stdout.write(said.getvalue())
        raise


class _Terminated(BaseException):
    """SIGTERM arrived; raised so that files are closed and the terminal is left in order."""


@contextlib.contextmanager
def _sigterm_raises() -> Iterator[None]:
    def handler(number: int, frame: FrameType | None) -> None:
        raise _Terminated

    previous = {n: signal.getsignal(n) for n in (signal.SIGINT, signal.SIGTERM)}
    signal.signal(signal.SIGTERM, handler)
    try:
        yield
    finally:
        for number, action in previous.items():
            signal.signal(number, action)
