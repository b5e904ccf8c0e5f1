"""Options of `flexneedle insert` for a rig, ROS 2 and OpenIGTLink."""

from __future__ import annotations

import argparse
import signal
from contextlib import ExitStack
from shlex import quote
from typing import TYPE_CHECKING, Any

from flexneedle.cli.commands import Commands
from flexneedle.cli.common import with_target
from flexneedle.cli.insert import Connection
from flexneedle.cli.progress import print_line, print_note
from flexneedle.errors import InputError
from flexneedle.interrupts import SIGNALS
from flexneedle.lab.commands.confirmation import ARMS, confirm_motions, require_terminal
from flexneedle.lab.commands.igtl_options import add_igtl, igtl_settings
from flexneedle.lab.rig.notices import STILL_IN
from flexneedle.loop.events import AllGates, Gate

if TYPE_CHECKING:
    from flexneedle.cli.progress import Progress
    from flexneedle.lab.igtl.bridge import IgtlBridge
    from flexneedle.lab.link.bridge import LinkBridge
    from flexneedle.lab.rig.rig_file import RigFile, RosSettings
    from flexneedle.lab.ros.bridge import Bridge
    from flexneedle.planning.events import Listener
    from flexneedle.record.folder import Folder
    from flexneedle.scenario.model import Scenario


def add_options(commands: Commands) -> None:
    """Add the options to the command `insert`."""
    parser = commands.choices["insert"]
    parser.set_defaults(connection=_connection)
    parser.add_argument(
        "--rig",
        metavar="FILE",
        help="path of a rig file, or emulated: insert with its motors and tracker from the present positions "
        "(default: virtual phantom)",
    )
    parser.add_argument(
        "--dry-run",
        action="store_true",
        help="with --rig: read motors and tracker, but move only the virtual phantom",
    )
    parser.add_argument(
        "--ros",
        metavar="PROFILE",
        help="without --rig: publish to ROS 2 and subscribe to the stop topic; name or path of a profile",
    )
    add_igtl(parser, target=True)
    parser.add_argument("--yes", action="store_true", help="with --rig: insert without a confirmation")


def _connection(args: argparse.Namespace) -> Connection:
    """Return the connection for the arguments. Raises InputError for options that contradict each other."""
    if args.rig is not None:
        return RigConnection(args)
    if args.dry_run:
        raise InputError("--dry-run: needs --rig FILE; without a rig every insertion is virtual")
    return LinkedConnection(args)


class LinkedConnection(Connection):
    """The virtual rig, with an insertion that other programs follow and stop, over ROS 2 or OpenIGTLink."""

    _ros_bridge: Bridge | None = None
    _igtl_bridge: IgtlBridge | None = None

    @property
    def _bridges(self) -> dict[str, LinkBridge]:
        found = {"ros": self._ros_bridge, "igtl": self._igtl_bridge}
        return {name: bridge for name, bridge in found.items() if bridge is not None}

    def _ros(self) -> RosSettings | None:
        from flexneedle.lab.rig.rig_file import RosSettings, check_settings

        return None if self.args.ros is None else check_settings(RosSettings, {"profile": self.args.ros})

    def start(self, stack: ExitStack, scenario: Scenario) -> Scenario:
        """Open the connections, and wait for the target if it comes from there."""
        ros, igtl = self._ros(), igtl_settings(self.args)
        self._check_targets(ros)
        if ros is not None:
            from flexneedle.lab.ros.bridge import Bridge

            self._ros_bridge = stack.enter_context(Bridge(ros, print_line))
        if igtl is not None:
            from flexneedle.lab.igtl.bridge import IgtlBridge

            bridge = IgtlBridge(igtl, print_line, scenario, awaits=self.args.igtl_target)
            self._igtl_bridge = stack.enter_context(bridge)
        if self._ros_bridge is not None and ros is not None and ros.target:
            return with_target(scenario, self._ros_bridge.await_target())
        if self._igtl_bridge is not None and self.args.igtl_target:
            return self._igtl_bridge.await_target()
        return scenario

    def _check_targets(self, ros: RosSettings | None) -> None:
        """Raise InputError for a second source of the target, and for --igtl-target without --igtl."""
        by_ros = ros is not None and ros.target
        where = "with target = true in [ros] of the rig file, which takes it from ROS"
        if by_ros and self.args.target is not None:
            raise InputError(f"--target: not {where}")
        if not self.args.igtl_target:
            return
        if self.args.igtl is None:
            raise InputError("--igtl-target: needs --igtl")
        if by_ros:
            raise InputError(f"--igtl-target: not {where}")
        if self.args.target is not None:
            raise InputError("--target: not with --igtl-target, which takes it from OpenIGTLink")

    def add_record(self, folder: Folder) -> None:
        """Add what was received and refused, and a loss of a node, to `timing`."""
        folder.timing |= {name: bridge.record for name, bridge in self._bridges.items()}

    def listeners(self, progress: Progress) -> tuple[Listener, ...]:
        """Return the connections, whose lines are printed above the progress from now on."""
        for bridge in self._bridges.values():
            bridge.show = progress.print_line
        return tuple(self._bridges.values())

    def gate(self, progress: Progress, scenario: Scenario) -> Gate | None:
        """Return the gates of the connections."""
        return AllGates(*self._bridges.values())


class RigConnection(LinkedConnection):
    """The rig of a rig file, which the user confirms before motors move."""

    def __init__(self, args: argparse.Namespace) -> None:
        from flexneedle.lab.rig.supervised import SupervisedRig

        if virtual := [f"--{name}" for name in ("phantom", "tracker") if getattr(args, name) is not None]:
            raise InputError(f"{' and '.join(virtual)}: not with --rig, which has its needle and tracker")
        self.args = args
        self.source = self._rig = SupervisedRig(args.rig, dry_run=args.dry_run)

    @property
    def _file(self) -> RigFile:
        return self._rig.file

    @property
    def _asks(self) -> bool:
        """True if motions of motors are confirmed on the terminal: unless --yes is given or ROS arms the rig."""
        ros = self._file.ros
        return self._rig.moves and not (self.args.yes or (ros is not None and ros.arm))

    def _ros(self) -> RosSettings | None:
        if self.args.ros is not None:
            raise InputError("--ros: not with --rig, whose file has a section [ros] for it")
        return self._file.ros

    def with_registration(self, scenario: Scenario) -> Scenario:
        """Return the scenario with the registration of the rig file. Raises InputError for a second one."""
        from flexneedle.lab.rig.preflight.start import with_registration

        if self.args.registration is not None:
            if self._file.registration is not None:
                raise InputError(
                    "--registration: not with a rig whose file has a section [registration]: remove one"
                )
            return super().with_registration(scenario)
        return scenario if self._rig.dry_run else with_registration(self._file, scenario)

    def start(self, stack: ExitStack, scenario: Scenario) -> Scenario:
        """Let SIGTERM and SIGHUP act as Ctrl-C, so that the record is completed; require a terminal."""
        interrupt_on_signals(stack)
        started = super().start(stack, scenario)
        if self._asks:
            require_terminal()  # before the time of planning is spent
        return started

    def gate(self, progress: Progress, scenario: Scenario) -> Gate:
        """Return the gates of the connections, followed by the user's."""
        asked = _UserGate(progress, scenario, moves=self._rig.moves, question="Insert?" if self._asks else "")
        return AllGates(*self._bridges.values(), asked)

    def end(self) -> None:
        """Print how the needle is withdrawn."""
        if self._rig.moves:
            print_note(STILL_IN.format(command=f"flexneedle rig retract {quote(self.args.rig)}"))


def interrupt_on_signals(stack: ExitStack) -> None:
    """Let SIGTERM and SIGHUP act as Ctrl-C until the stack closes: an insertion on a rig completes its record."""
    for number in SIGNALS:
        stack.callback(signal.signal, number, signal.signal(number, signal.default_int_handler))


class _UserGate(Gate):
    """Prints where the axes are, and asks before motors move; question "": does not ask."""

    def __init__(self, progress: Progress, scenario: Scenario, *, moves: bool, question: str) -> None:
        self._progress, self._scenario = progress, scenario
        self._moves, self._question = moves, question

    def confirm(self, rig: Any) -> None:
        """Ask. Raises RunError for any answer but yes."""
        from flexneedle.lab.rig.preflight.moves import describe_insertion

        rig.take_signals()
        if not self._moves:
            return
        with self._progress.pause_display():
            lines = [*describe_insertion(rig.rig, self._scenario, rig.positions), ARMS]
            confirm_motions(lines, self._question)
