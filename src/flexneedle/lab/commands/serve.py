"""`flexneedle serve`: the page on which insertions are planned, watched and replayed."""

from __future__ import annotations

import argparse
import math
import os
import sys
from functools import partial
from pathlib import Path
from threading import Thread
from typing import TYPE_CHECKING

from flexneedle.arguments import expand_home
from flexneedle.cli.commands import Commands, add_command
from flexneedle.cli.common import load_named
from flexneedle.cli.progress import print_note
from flexneedle.cli.values import port
from flexneedle.errors import InputError
from flexneedle.files import RUNS
from flexneedle.lab.commands.igtl_options import add_igtl, igtl_settings

if TYPE_CHECKING:
    from flexneedle.lab.page.server.connected_rig import RigReference
    from flexneedle.lab.page.server.request_handler import PageSetup

_HOST, _PORT = "127.0.0.1", 8472
_WORKER = "flexneedle.lab.page.worker"


def add_parser(commands: Commands) -> None:
    """Add the command to the parser of `flexneedle`."""
    parser = add_command(
        commands,
        "serve",
        "open a page in the browser to plan, insert and replay",
        _serve,
        "flexneedle serve",
        "flexneedle serve mine.toml --rig rig.toml",
        about="Serve a page to plan, insert and replay in a browser, without internet access. One client "
        "at a time is in control; every client may watch and stop.",
    )
    parser.add_argument(
        "scenario",
        metavar="SCENARIO",
        nargs="?",
        default="phantom",
        help="preset name, wide:NUMBER, world:NUMBER or path of the scenario to begin with (default: phantom)",
    )
    parser.set_defaults(load=load_named, image=None)
    parser.add_argument(
        "--rig",
        metavar="FILE",
        help="path of a rig file, or emulated; nothing moves before the rig is armed on the page (default: "
        "virtual phantom)",
    )
    add_igtl(parser, target=False)
    parser.add_argument(
        "--runs",
        type=expand_home,
        default=RUNS,
        metavar="DIR",
        help=f"folder of recorded runs (default: {RUNS})",
    )
    parser.add_argument(
        "--host",
        default=_HOST,
        metavar="HOST",
        help="address to listen on; addresses other than loopback require the token in the printed address "
        "(default: 127.0.0.1)",
    )
    parser.add_argument(
        "--port",
        type=port,
        default=_PORT,
        metavar="N",
        help=f"port to listen on, 0 for any free port (default: {_PORT})",
    )
    parser.add_argument(
        "--open",
        action=argparse.BooleanOptionalAction,
        default=None,
        help="open the page in a browser (default: if there is a display)",
    )


def _serve(args: argparse.Namespace) -> int:
    try:
        from flexneedle.lab.page.server.page_server import PageServer
    except ModuleNotFoundError as error:
        if (error.name or "").partition(".")[0] not in ("starlette", "uvicorn", "websockets", "anyio"):
            raise
        raise InputError(
            "the page needs starlette, uvicorn and websockets: pip install 'flexneedle[page]'"
        ) from None
    server = PageServer(_setup(args), args.host, args.port)
    opens = _has_display() if args.open is None else args.open
    server.on_start = partial(_announce, server.address, opens)
    server.serve_until_interrupted()
    return 0


def _setup(args: argparse.Namespace) -> PageSetup:
    from flexneedle.lab.page.server.clients import RIG_LIMITS, PageLimits
    from flexneedle.lab.page.server.page_session import PageSession
    from flexneedle.lab.page.server.request_handler import PageSetup

    session = PageSession.of(Path(args.image or args.scenario).name, args.load(args))
    rig = None if args.rig is None else _load_rig(args.rig)
    plans, igtl = "plans" if rig is None else "plans-beside-a-rig", igtl_settings(args)
    if igtl is not None:
        igtl.address.require_free()
    link = () if igtl is None else (str(igtl.address), igtl.registration)
    workers = (_WORKER, plans), (_WORKER, "insertion", *link)
    limits = PageLimits() if rig is None else RIG_LIMITS
    return PageSetup(
        session, args.runs, limits, workers, rig, math.inf if igtl is None else igtl.entry_radius
    )


def _load_rig(source: str) -> RigReference:
    """Return the rig of a file. No device is opened.

    Raises RigError for a rig that the page cannot insert on.
    """
    from flexneedle.lab.page.rigs import usable_rig
    from flexneedle.lab.page.server.connected_rig import RigReference

    return RigReference(usable_rig(source).name, source)


def _announce(address: str, opens: bool) -> None:
    """Print the address, and open it. A browser may take its time to start, which the server does not wait for."""
    print(address, flush=True)
    print_note("Ctrl-C ends the server")
    if opens:
        from webbrowser import open as open_page

        Thread(target=open_page, args=(address,), daemon=True).start()


def _has_display() -> bool:
    """Return whether a browser could open a window; in a terminal without one a text browser would start."""
    return sys.platform == "darwin" or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
