"""`flexneedle emulate`: an emulated tracker or motion controller, for tests without hardware."""

from __future__ import annotations

import argparse
import json
import signal
import sys
from collections.abc import Callable, Mapping
from functools import partial
from typing import TYPE_CHECKING, Any

from flexneedle.arguments import expand_home
from flexneedle.cli.commands import Commands, add_command, add_group
from flexneedle.cli.common import add_seed
from flexneedle.cli.progress import print_line, print_note
from flexneedle.cli.values import port

if TYPE_CHECKING:
    from flexneedle.lab.emulators.emulated_rig.job import EmulationJob
    from flexneedle.lab.emulators.galil.galil_server import TcpServer
    from flexneedle.lab.emulators.orders import Orders


def add_parser(commands: Commands) -> None:
    """Add the command to the parser of `flexneedle`."""
    add_group(
        commands,
        "emulate",
        "emulate a device, for tests without hardware",
        (_add_aurora, _add_galil, _add_fbgs, _add_rig),
        "flexneedle emulate aurora --link /tmp/aurora",
        "flexneedle emulate rig emulated phantom",
        title="devices",
    )


def _add_aurora(commands: Commands) -> None:
    aurora = add_command(
        commands,
        "aurora",
        "an NDI Aurora on a pseudo-terminal",
        _emulate_aurora,
        "flexneedle emulate aurora --link /tmp/aurora",
        "flexneedle emulate aurora --still --sensors 2 --seed 3",
        about="Print the path of the emulated device and serve it until Ctrl-C or SIGTERM. The tip moves along an "
        "arc; a line X Y Z on stdin (mm, tracker frame) stops it there.",
    )
    aurora.add_argument(
        "--link",
        type=expand_home,
        metavar="PATH",
        help="path of the device (default: one in a new folder under /tmp)",
    )
    _add_fault(aurora, "a fault at SECONDS after the start of tracking", "docs/tracking/aurora.md")
    aurora.add_argument("--still", action="store_true", help="start with the tip at rest")
    aurora.add_argument(
        "--sensors", type=int, choices=range(1, 5), default=4, help="number of connected sensors (default: 4)"
    )
    aurora.add_argument(
        "--firmware", metavar="TEXT", help="firmware tag in the reply to VER (default: AURORA Rev 008)"
    )
    aurora.add_argument(
        "--no-bx", action="store_true", help="do not support binary readings (BX), like old firmware"
    )
    add_seed(aurora, "seed of jitter and corrupted bytes")


def _add_galil(commands: Commands) -> None:
    galil = add_command(
        commands,
        "galil",
        "a Galil DMC-4143 on a TCP port",
        _emulate_galil,
        "flexneedle emulate galil --port 2323",
        "flexneedle emulate galil --port 2323 --fault stall=A@5",
        about="Print the address of the emulated controller and serve it until Ctrl-C or SIGTERM. Its four motors "
        "move in real time.",
    )
    _add_address(galil)
    _add_fault(galil, "a fault at SECONDS after the first motion", "docs/rig/galil.md")
    add_seed(galil, "seed of corrupted bytes")


def _add_fbgs(commands: Commands) -> None:
    fbgs = add_command(
        commands,
        "fbgs",
        "an FBGS ShapeCore on a TCP port",
        _emulate_fbgs,
        "flexneedle emulate fbgs --port 50012",
        "flexneedle emulate fbgs --port 50012 --fault unplug@5:2",
        about="Print the address of the emulated stream and send 100 frames a second to each client until Ctrl-C or "
        "SIGTERM. The fibre has the shape of an arc that turns about its axis.",
    )
    _add_address(fbgs)
    _add_fault(fbgs, "a fault at SECONDS after the first client has connected", "docs/rig/fbgs.md")
    add_seed(fbgs, "seed of changed bytes")


def _add_address(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--host", default="127.0.0.1", help="address to listen on (default: 127.0.0.1, only this machine)"
    )
    parser.add_argument(
        "--port", type=port, default=0, metavar="N", help="port to listen on (default: any free port)"
    )


def _add_rig(commands: Commands) -> None:
    rig = add_command(
        commands,
        "rig",
        "a whole rig: motors that move a virtual needle, and a tracker and sensors that measure it",
        _emulate_rig,
        "flexneedle emulate rig emulated phantom --seed 3 --truth truth.csv",
        "flexneedle emulate rig my-rig.toml phantom3d --fault galil:stall=A@5 --fault aurora:jump@8:0.5",
        about="Emulate the controller and tracker of a rig file, with the virtual phantom of a scenario "
        "between them, and an FBGS stream and an OpenIGTLink server if the scenario has such sensors along the needle, "
        "each in a process, until Ctrl-C or SIGTERM. Prints one line when all are ready, and one per event. "
        "A line fault DEVICE:KIND[=DETAIL][:DURATION] on stdin injects a fault, clear ends all faults.",
    )
    rig.add_argument("rig", metavar="RIG", help="path of a rig file, or emulated")
    rig.add_argument(
        "scenario", metavar="SCENARIO", help="preset name, wide:NUMBER, world:NUMBER or path of a scenario"
    )
    add_seed(rig, "seed of phantom and noise, as in flexneedle insert --seed N")
    rig.add_argument(
        "--plan",
        type=expand_home,
        metavar="DIR",
        help="folder of a plan, if the scenario has a free entry",
    )
    rig.add_argument(
        "--truth", type=expand_home, metavar="FILE", help="write the true states to a new CSV file"
    )
    rig.add_argument(
        "--save",
        type=expand_home,
        metavar="FILE",
        help="write the rig file with the addresses of the devices, and with the sensors, to a new file",
    )
    _add_fault(
        rig,
        "a fault of aurora, galil or fbgs at SECONDS after the start of tracking, the first motion or the first client",
        "docs/rig/emulate.md",
        device="DEVICE:",
    )


def _add_fault(parser: argparse.ArgumentParser, fault: str, page: str, *, device: str = "") -> None:
    parser.add_argument(
        "--fault",
        action="append",
        default=[],
        metavar=f"{device}KIND[=DETAIL]@SECONDS[:DURATION]",
        help=f"inject {fault}; repeatable; see {page}",
    )


def _emulate_aurora(args: argparse.Namespace) -> int:
    from time import monotonic

    from flexneedle.lab.emulators.aurora import FIRMWARE, power_on
    from flexneedle.lab.emulators.aurora_faults import FAULTS
    from flexneedle.lab.emulators.aurora_server import EmulatorSession, SerialPort, execute, serve
    from flexneedle.lab.emulators.faults import parse_fault
    from flexneedle.lab.emulators.motion import CENTRE, CIRCLE, RestingTip
    from flexneedle.lab.rig.devices.priority import set_realtime_priority

    faults = [parse_fault(spec, FAULTS) for spec in args.fault]
    device = power_on(args.sensors, args.firmware or FIRMWARE, has_bx=not args.no_bx)
    with SerialPort(args.link) as serial:
        signal.signal(signal.SIGTERM, signal.default_int_handler)  # so that the link is removed then too
        set_realtime_priority()  # a real device does not wait for other processes on this machine
        try:
            print(serial.link, flush=True)
            tip = RestingTip(CENTRE) if args.still else CIRCLE
            session = EmulatorSession(device, faults, args.seed, monotonic(), tip=tip)
            serve(session, serial, _orders(), lambda line: print_line(execute(session, line)), print_line)
        except KeyboardInterrupt:
            return 0


def _emulate_galil(args: argparse.Namespace) -> int:
    from flexneedle.lab.emulators.galil import galil_server
    from flexneedle.lab.emulators.galil.controller import ControllerState

    make_session = partial(galil_server.GalilSession, ControllerState())
    return _serve_on_tcp(args, galil_server, galil_server.TcpServer, make_session)


def _emulate_fbgs(args: argparse.Namespace) -> int:
    from flexneedle.lab.emulators import fbgs

    return _serve_on_tcp(args, fbgs, fbgs.FbgsServer, fbgs.FbgsSession)


def _serve_on_tcp(
    args: argparse.Namespace, device: Any, server: type[TcpServer], make_session: Callable[..., Any]
) -> int:
    """Serve a device, a module with its faults and `serve`, until interrupted."""
    from time import monotonic

    from flexneedle.lab.emulators.faults import parse_fault
    from flexneedle.lab.rig.devices.priority import set_realtime_priority

    faults = [parse_fault(spec, device.FAULTS) for spec in args.fault]
    with server(args.host, args.port) as tcp:
        signal.signal(signal.SIGTERM, signal.default_int_handler)
        set_realtime_priority()  # a real device does not wait for other processes on this machine
        try:
            print("{}:{}".format(*tcp.address), flush=True)
            session = make_session(faults, monotonic(), args.seed)
            obey = session.schedule.execute
            device.serve(
                session, tcp, _orders(), lambda line: print_line(obey(line, monotonic())), print_line
            )
        except KeyboardInterrupt:
            pass
    return 0


def _emulate_rig(args: argparse.Namespace) -> int:
    from flexneedle.lab.emulators.emulated_rig.emulated_rig import EmulatedRig, split_fault

    faults = tuple(split_fault(given) for given in args.fault)
    job = _job(args, faults)
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        with EmulatedRig(job, _print_message) as rig:
            rig.serve(_orders())
    except KeyboardInterrupt:
        return 0


def _job(args: argparse.Namespace, faults: tuple[tuple[str, str], ...]) -> EmulationJob:
    from flexneedle.lab.emulators.emulated_rig.job import make_job
    from flexneedle.lab.rig.rig_file import load_rig
    from flexneedle.record.loading import load
    from flexneedle.scenario.files import load_scenario

    record = None if args.plan is None else load(args.plan)
    rig, scenario = load_rig(args.rig), load_scenario(args.scenario)
    return make_job(rig, scenario, record, args.seed, args.truth, faults, args.save)


def _print_message(message: Mapping[str, Any]) -> None:
    """Print a message of an emulated rig: a line of JSON, or on stderr a note for a person."""
    if "note" in message:
        print_note(message["note"])
    else:
        print(json.dumps(message), flush=True)


def _orders() -> Orders:
    from flexneedle.lab.emulators.orders import Orders

    return Orders(None if sys.stdin is None else sys.stdin.fileno())
