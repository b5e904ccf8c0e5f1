"""`flexneedle emulate`: an emulated tracker or motion controller, for tests without hardware."""

from __future__ import annotations

import argparse
import signal
import sys
from pathlib import Path

from flexneedle.console.common import HelpFormatter, examples, seed

_EXAMPLES = examples(
    "flexneedle emulate aurora --link /tmp/aurora",
    "flexneedle emulate galil --port 2323",
)
_AURORA_EXAMPLES = examples(
    "flexneedle emulate aurora --link /tmp/aurora",
    "flexneedle emulate aurora --still --sensors 2 --seed 3",
)
_GALIL_EXAMPLES = examples(
    "flexneedle emulate galil --port 2323",
    "flexneedle emulate galil --port 2323 --fault stall=A@5",
)


_LAST_PORT = 65535


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the command to the parser of `flexneedle`."""
    parser = subparsers.add_parser(
        "emulate",
        help="emulate a device, for tests without hardware",
        epilog=_EXAMPLES,
        formatter_class=HelpFormatter,
    )
    devices = parser.add_subparsers(title="devices", metavar="DEVICE", required=True)
    _add_aurora(devices)
    _add_galil(devices)


def _add_aurora(devices: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    aurora = devices.add_parser(
        "aurora",
        help="an NDI Aurora on a pseudo-terminal",
        description="Print the path of the emulated device and serve it until interrupted (Ctrl-C). "
        "The tip moves along an arc; a line X Y Z on stdin (mm, tracker frame) stops it at that position.",
        epilog=_AURORA_EXAMPLES,
        formatter_class=HelpFormatter,
    )
    aurora.add_argument(
        "--link",
        type=Path,
        metavar="PATH",
        help="path of the device (default: one in a new folder under /tmp)",
    )
    aurora.add_argument(
        "--fault",
        action="append",
        default=[],
        metavar="KIND[=DETAIL]@SECONDS[:DURATION]",
        help="inject a fault at SECONDS after the start of tracking; repeatable; see docs/tracking/aurora.md",
    )
    aurora.add_argument("--still", action="store_true", help="start with the tip at rest")
    aurora.add_argument(
        "--sensors", type=int, choices=range(1, 5), default=4, help="number of connected sensors (default: 4)"
    )
    aurora.add_argument(
        "--firmware", metavar="TEXT", help="firmware tag in the reply to VER (default: AURORA Rev 008)"
    )
    aurora.add_argument(
        "--no-bx", action="store_true", help="do not support binary readings (BX), as old firmware"
    )
    aurora.add_argument(
        "--seed", type=seed, default=0, metavar="N", help="seed of jitter and corrupted bytes (default: 0)"
    )
    aurora.set_defaults(handler=_emulate_aurora)


def _add_galil(devices: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    galil = devices.add_parser(
        "galil",
        help="a Galil DMC-4143 on a TCP port",
        description="Print the address of the emulated controller and serve it until interrupted (Ctrl-C). "
        "Its four motors move in real time.",
        epilog=_GALIL_EXAMPLES,
        formatter_class=HelpFormatter,
    )
    galil.add_argument(
        "--host", default="127.0.0.1", help="address to listen on (default: 127.0.0.1, only this machine)"
    )
    galil.add_argument(
        "--port", type=_port, default=0, metavar="N", help="port to listen on (default: one that is free)"
    )
    galil.add_argument(
        "--fault",
        action="append",
        default=[],
        metavar="KIND[=DETAIL]@SECONDS[:DURATION]",
        help="inject a fault at SECONDS after the first motion; repeatable; see docs/rig/galil.md",
    )
    galil.add_argument("--seed", type=seed, default=0, metavar="N", help="seed of changed bytes (default: 0)")
    galil.set_defaults(handler=_emulate_galil)


def _port(text: str) -> int:
    if not (text.isascii() and text.isdigit() and int(text) <= _LAST_PORT):
        raise argparse.ArgumentTypeError(f"{text}: must be a port from 0 (one that is free) to {_LAST_PORT}")
    return int(text)


def _emulate_aurora(args: argparse.Namespace) -> int:
    from time import monotonic

    from flexneedle.rig.devices.priority import set_realtime_priority
    from flexneedle.rig.emulator.aurora import FAULTS, FIRMWARE, fresh
    from flexneedle.rig.emulator.faults import parse_fault
    from flexneedle.rig.emulator.motion import CENTRE
    from flexneedle.rig.emulator.orders import Orders
    from flexneedle.rig.emulator.server import EmulatorSession, Serial, serve

    faults = [parse_fault(spec, FAULTS) for spec in args.fault]
    device = fresh(args.sensors, args.firmware or FIRMWARE, has_bx=not args.no_bx)
    with Serial(args.link) as serial:
        signal.signal(signal.SIGTERM, signal.default_int_handler)  # so that the link is removed then too
        set_realtime_priority()  # a real device does not wait for other processes on this machine
        try:
            print(serial.link, flush=True)
            session = EmulatorSession(
                device, faults, args.seed, monotonic(), rest=CENTRE if args.still else None
            )
            serve(session, serial, Orders(None if sys.stdin is None else sys.stdin.fileno()), _print_line)
        except KeyboardInterrupt:
            return 0


def _emulate_galil(args: argparse.Namespace) -> int:
    from time import monotonic

    from flexneedle.rig.devices.priority import set_realtime_priority
    from flexneedle.rig.emulator.faults import parse_fault
    from flexneedle.rig.emulator.galil.controller import Device
    from flexneedle.rig.emulator.galil.server import FAULTS, GalilSession, Tcp, serve

    faults = [parse_fault(spec, FAULTS) for spec in args.fault]
    with Tcp(args.host, args.port) as tcp:
        signal.signal(signal.SIGTERM, signal.default_int_handler)
        set_realtime_priority()  # a real device does not wait for other processes on this machine
        try:
            print("{}:{}".format(*tcp.address), flush=True)
            serve(GalilSession(Device(), faults, monotonic(), args.seed), tcp, _print_line)
        except KeyboardInterrupt:
            return 0


def _print_line(line: str) -> None:
    print(line, file=sys.stderr, flush=True)
