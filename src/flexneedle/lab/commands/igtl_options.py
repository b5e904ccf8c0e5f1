"""Options of a connection to OpenIGTLink."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from flexneedle.errors import InputError

if TYPE_CHECKING:
    from flexneedle.lab.igtl.settings import IgtlAddress, IgtlSettings

_PORT, _REGISTRATION = 18944, "ImageToNeedle"


def add_igtl(parser: argparse.ArgumentParser, *, target: bool) -> None:
    """Add the options; target: whether a peer may choose the target."""
    parser.add_argument(
        "--igtl",
        type=_address,
        nargs="?",
        const=str(_PORT),
        metavar="ADDRESS",
        help="send to OpenIGTLink (3D Slicer) and receive stops: PORT or HOST:PORT to listen on, or "
        f"connect:HOST:PORT to connect to (without ADDRESS: {_PORT}, on loopback)",
    )
    if target:
        parser.add_argument(
            "--igtl-target",
            action="store_true",
            help="with --igtl: wait for target and entry, as points of these names or as a trajectory",
        )
    parser.add_argument(
        "--igtl-registration",
        default=_REGISTRATION,
        metavar="NAME",
        help="with --igtl: device name of the transform from the image to the needle's frame "
        f"(default: {_REGISTRATION})",
    )


def igtl_settings(args: argparse.Namespace) -> IgtlSettings | None:
    """Return the settings of the arguments, None without --igtl."""
    from flexneedle.lab.igtl.settings import IgtlSettings

    if args.igtl is None:
        return None
    if args.image is None:
        return IgtlSettings(args.igtl, args.igtl_registration)
    from flexneedle.lab.images.case_file import load_case

    return IgtlSettings(args.igtl, args.igtl_registration, load_case(args.image).skin_radius_mm)


def _address(text: str) -> IgtlAddress:
    from flexneedle.lab.igtl.settings import IgtlAddress

    try:
        return IgtlAddress.parse(text)
    except InputError as error:
        raise argparse.ArgumentTypeError(str(error)) from None
