"""`GalilMotors`: the motors of a Galil DMC-4143, with the port `Motors`.

Written from the maker's published documents; it was not tried on a controller.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from time import monotonic
from typing import Any, Self

from flexneedle.errors import DriverError
from flexneedle.lab.rig.devices.galil.link import Link
from flexneedle.lab.rig.devices.galil.replies import LONGEST_LINE, GarbledError
from flexneedle.lab.rig.devices.galil.settings import AXES, GalilSettings, check_galil_settings
from flexneedle.lab.rig.devices.galil.states import (
    ABORTED,
    SETUP,
    STOPPED,
    ChannelState,
    MotorReport,
    make_report,
    make_setup,
    take_report,
)
from flexneedle.ports import MotorPaces, MotorSetup, MotorState

CONNECT_S = 2.0
"""Time for the first connection. A new one has to be there within the reply timeout."""

_REVISION = "\x12\x16"  # Ctrl-R Ctrl-V
_FARTHEST = 2_147_483_647
# Types of motor (MT, either sign) whose position an encoder measures; others are steppers.
_SERVOS = (1.0, 1.5, 4.0)
_POSITION_FORMAT = 10.0  # PF: ten digits, no decimals; a shorter format would cut positions off
_SAMPLE_TIME = 1000.0  # TM at which speeds are in counts/s; another scales all speeds and accelerations
_SPEED_STEP, _RATE_STEP = 2, 1024  # the controller rounds down to multiples, at its default sample time
_PACES = MotorPaces((_SPEED_STEP, 15_000_000.0), (_RATE_STEP, 1_073_740_800.0))
_SLOWING_S = 0.5  # time to come to rest if speed and acceleration were not set here
_MARGIN_S = 0.05  # after the time to come to rest


def factory(settings: Mapping[str, Any], channels: Sequence[str]) -> "GalilMotors":
    """Return the connected motors of a rig file's `driver` (entry point `galil`).

    Raises RigError for settings that are not valid, DriverError if the controller cannot be reached.
    """
    return GalilMotors(check_galil_settings(settings, channels), channels)


class GalilMotors:
    """Motors by channel, the axis letters A to H. Positions are whole counts: targets are rounded to the nearest.

    Connecting enables no motor and moves none. Each call takes at most the reply timeout. If a reply is missing or does
    not match the commands, the connection is closed until `reconnect`. Before that the motors are stopped, if this
    object has commanded anything: a driver that only reads stops no motion of another program. Use it as a context
    manager, or call `close`. Not for several threads.

    settings, channels: see `factory`. Raises DriverError if the controller cannot be reached or is not fit: a stepper,
    whose position is not measured, or a format of positions (PF) or sample time (TM) other than the default.
    """

    paces = _PACES
    """Speeds and accelerations that the controller takes, at its default sample time."""

    def __init__(self, settings: GalilSettings, channels: Sequence[str]) -> None:
        self._timeout = settings.reply_timeout_ms / 1e3
        self._tracks = settings.mode == "tracking"
        self._letters = "".join(sorted(channels))
        self._link = Link(settings.host, settings.port)
        self._channels = dict.fromkeys(self._letters, ChannelState())
        self._rates: dict[str, int] = {}
        self._slowing: dict[str, float] = {}
        self._stopping: float | None = None
        self._farewell = ""
        self.identity = ""
        """Model and revision of the firmware."""
        self.address = self._link.address
        """IP address and port."""
        self._connect(monotonic() + CONNECT_S)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_exception: object) -> None:
        self.close()

    def _connect(self, deadline: float) -> None:
        self._channels = dict.fromkeys(self._letters, ChannelState())
        self._rates, self._stopping = {}, None
        self._link.farewell = ""  # it may be any device
        self._link.open(deadline)
        try:
            self._identify(deadline)
        except DriverError as error:
            self._link.close(str(error))
            raise
        self._link.farewell = self._farewell

    def _execute(self, commands: Sequence[str], deadline: float) -> None:
        """Have commands carried out; from the first on, a connection in doubt is left with a stop of the motors."""
        self._farewell = self._link.farewell = f"ST{self._letters}"
        self._link.do(commands, deadline)

    def _identify(self, deadline: float) -> None:
        """Identify the device. Raises DriverError if it is not a controller that can be read without another setup."""
        self._link.ask(["EO 0"], deadline)  # refused where there is no echo to switch off, as on Ethernet
        self.identity = self._link.text(_REVISION, deadline)
        if "DMC" not in self.identity:
            raise self._unfit_error(f"not a Galil motion controller: {self.identity}")
        queries = ["MG _PF,_TM", f"MG {','.join(f'_MT{letter}' for letter in self._letters)}"]
        (form, sample), kinds = self._link.numbers(queries, [2, len(self._letters)], deadline)
        if form != _POSITION_FORMAT:
            raise self._unfit_error(f"positions have the format PF {form:g}: set PF {_POSITION_FORMAT:g}")
        if sample != _SAMPLE_TIME:
            rule = f"set TM {_SAMPLE_TIME:g}, so that speeds are in counts/s"
            raise self._unfit_error(f"the sample time is TM {sample:g}: {rule}")
        for letter, kind in zip(self._letters, kinds, strict=True):
            if abs(kind) not in _SERVOS:
                raise self._unfit_error(
                    f"{letter} is not a servo motor (MT {kind:g}): its position is not measured"
                )
        self._read_states(deadline)

    def _unfit_error(self, problem: str) -> DriverError:
        return DriverError(f"{self._link.name}: {problem}")

    def reconnect(self) -> None:
        """Drop the connection and open a new one. It moves nothing, and changes nothing in the controller.

        Axes that an earlier connection has left in position tracking may count as moving, also at rest, until `stop`,
        `power` or `define`.
        """
        self._connect(self._deadline())

    def close(self) -> None:
        """Close the connection; motors are left as they are."""
        self._link.close()

    def _deadline(self) -> float:
        return monotonic() + self._timeout

    def read(self) -> Mapping[str, MotorState]:
        """Return the present state of every channel, by one line and its reply."""
        return self._read_states(self._deadline())

    def _read_states(self, deadline: float) -> dict[str, MotorState]:
        """Query all channels, and record their states."""
        columns = self._query(("TP", "RP", "TS", "SC"), self._letters, deadline)
        states = {}
        for letter, values in zip(self._letters, zip(*columns, strict=True), strict=True):
            self._channels[letter], states[letter] = take_report(
                self._channels[letter], self._report(*values)
            )
        return states

    def _query(self, names: Sequence[str], letters: str, deadline: float) -> list[tuple[float, ...]]:
        queries = [f"{name}{letters}" for name in names]
        return self._link.numbers(queries, [len(letters)] * len(queries), deadline)

    def _report(self, position: float, commanded: float, switches: float, code: float) -> MotorReport:
        try:
            return make_report(position, commanded, switches, code)
        except GarbledError as error:
            raise self._link.close_in_doubt(str(error)) from None

    def _find_moving(self, letters: str, deadline: float) -> set[str]:
        """Return the channels that the controller counts as in motion."""
        (switches,) = self._query(("TS",), letters, deadline)
        found = zip(letters, switches, strict=True)
        return {letter for letter, value in found if self._report(0.0, 0.0, value, 0.0).moving}

    def follow(self, positions: Mapping[str, float]) -> None:
        """Move channels to absolute positions (counts), from wherever they are; each call replaces the one before.

        In the mode `moves` a channel that is in motion finishes it first. Its new target is sent by the first call that
        finds it at rest: repeat the call until `read` reports rest.
        """
        targets = {letter: self._check_target(letter, position) for letter, position in positions.items()}
        if targets:
            self._stopping = None
            deadline = self._deadline()
            try:
                (self._track if self._tracks else self._move)(targets, deadline)
            except DriverError as error:
                raise DriverError("; ".join((str(error), *self._describe_stops(deadline)))) from None

    def _describe_stops(self, deadline: float) -> list[str]:
        """Return a line for each channel at a limit switch or stopped by the controller, which then refuses targets."""
        if not self._link.is_open:
            return []
        try:
            found = self._read_states(deadline)
        except DriverError:  # the refusal counts
            return []
        reasons = {letter: state.stopped or _at_switch(state) for letter, state in found.items()}
        return [f"{letter}: {why}" for letter, why in reasons.items() if why]

    def _check_target(self, letter: str, position: float) -> int:
        self._check_channel(letter)
        if not math.isfinite(position) or abs(target := round(position)) > _FARTHEST:
            raise DriverError(f"{letter} = {position:.12g} counts: must be from -{_FARTHEST} to {_FARTHEST}")
        return target

    def _check_channel(self, letter: str) -> None:
        if letter not in self._channels:
            raise DriverError(f"{letter}: no such channel; channels: {', '.join(self._letters)}")

    def _track(self, targets: Mapping[str, int], deadline: float) -> None:
        # An axis that the controller itself has stopped has left position tracking, and a target alone does not move
        # it: it moves again only after its stop was reported to the caller.
        entering = {letter: 1 for letter in targets if not self._channels[letter].tracking}
        commands = [_format_assignment("PT", entering)] if entering else []
        self._execute([*commands, *_split_assignment("PA", targets)], deadline)
        for letter, target in targets.items():
            self._channels[letter] = self._channels[letter].with_target(target, tracking=True)

    def _move(self, targets: Mapping[str, int], deadline: float) -> None:
        known = self._channels.items()
        wanted = {k: channel.target for k, channel in known if channel.waiting and channel.target is not None}
        wanted |= targets
        # The controller refuses a new target during a move (PA: not valid while moving).
        moving = self._find_moving("".join(sorted(wanted)), deadline)
        for letter in moving:
            self._channels[letter] = replace(self._channels[letter], target=wanted[letter], waiting=True)
        now = {letter: target for letter, target in wanted.items() if letter not in moving}
        if now:
            self._execute([*_split_assignment("PA", now), f"BG{''.join(sorted(now))}"], deadline)
        for letter, target in now.items():
            self._channels[letter] = self._channels[letter].with_target(target, tracking=False)

    def stop(self) -> None:
        """Stop all channels at once; motors stay powered.

        They slow down with their deceleration. A further call, after the time that this takes, aborts remaining motion:
        AB 1, which stops all axes of the controller without deceleration, and switches off motors with OE.
        """
        deadline = self._deadline()
        slowing = max(self._slowing.get(letter, _SLOWING_S) for letter in self._letters)
        first = self._stopping is None
        began = self._stopping = monotonic() if self._stopping is None else self._stopping
        self._drop_targets(STOPPED)
        try:
            self._execute([f"ST{self._letters}"], deadline)
        except DriverError:
            if self._link.is_open:  # refused
                self._abort(deadline)
            raise
        if (
            not first
            and monotonic() >= began + slowing + _MARGIN_S
            and self._find_moving(self._letters, deadline)
        ):
            self._abort(deadline)

    def _abort(self, deadline: float) -> None:
        self._drop_targets(STOPPED, ABORTED)
        self._execute(["AB 1"], deadline)

    def _drop_targets(self, *codes: int) -> None:
        self._channels = {k: channel.without_target(*codes) for k, channel in self._channels.items()}

    def set_speed(self, channel: str, speed: float, acceleration: float) -> None:
        """Limit speed (counts/s) and acceleration (counts/s²) of present and later motions.

        They are rounded down to the controller's steps: speeds to multiples of 2, accelerations to multiples of 1024.
        The deceleration is the acceleration; a controller refuses to change it during a motion to a position.
        """
        self._check_channel(channel)
        pace = _round_down(f"{channel} speed", speed, *_PACES.speeds, "counts/s")
        rate = _round_down(f"{channel} acceleration", acceleration, *_PACES.accelerations, "counts/s²")
        pace, rate = pace // _SPEED_STEP * _SPEED_STEP, rate // _RATE_STEP * _RATE_STEP
        commands = [f"SP{channel}={pace}"]
        if self._rates.pop(channel, None) != rate:
            commands = [f"DC{channel}={rate}", f"AC{channel}={rate}", *commands]
        self._execute(commands, self._deadline())
        self._rates[channel] = rate
        self._slowing[channel] = pace / rate

    def define(self, channel: str, position: float) -> None:
        """Define the present position of a channel at rest as `position` (counts), as at the end of homing."""
        target = self._check_target(channel, position)
        deadline = self._deadline()
        self._end_tracking(channel, deadline)
        self._execute([f"DP{channel}={target}"], deadline)

    def power(self, channel: str, on: bool) -> None:
        """Switch a motor at rest on or off. Switched on, it is held where it is."""
        self._check_channel(channel)
        deadline = self._deadline()
        self._end_tracking(channel, deadline)
        self._execute([f"{'SH' if on else 'MO'}{channel}"], deadline)

    def _end_tracking(self, letter: str, deadline: float) -> None:
        """End position tracking, in which the controller refuses other commands; stop motion of unknown origin."""
        self._read_states(deadline)
        moving = self._read_states(deadline)[letter].moving  # the second one: see `take_report`
        channel = self._channels[letter]
        if moving and channel.target is not None:
            raise DriverError(f"{self._link.name}: {letter} is in motion")
        if moving or channel.tracking:
            self._execute([f"ST{letter}"], deadline)
            while self._find_moving(letter, deadline):
                pass
        self._channels[letter] = self._channels[letter].without_target(STOPPED)

    def setup(self) -> Mapping[str, MotorSetup]:
        """Return limits and position errors of the controller for each channel. It changes nothing."""
        found = {}
        for letter in self._letters:
            query = f"MG {','.join(f'_{name}{letter}' for name in SETUP)}"
            (values,) = self._link.numbers([query], [len(SETUP)], self._deadline())
            found[letter] = make_setup(values)
        return found


def _at_switch(state: MotorState) -> str:
    sides = ("reverse", state.reverse_limit), ("forward", state.forward_limit)
    names = " and ".join(name for name, is_active in sides if is_active)
    return f"{names} limit switch active" if names else ""


def _format_assignment(name: str, values: Mapping[str, int]) -> str:
    """Return a command that sets values of several axes at once: `PA 100,,50`."""
    last = AXES.index(max(values)) + 1
    return f"{name} {','.join(str(values.get(letter, '')) for letter in AXES[:last])}"


def _split_assignment(name: str, values: Mapping[str, int]) -> list[str]:
    """Return one command for all axes, or two if it is too long: eight positions of ten digits."""
    command = _format_assignment(name, values)
    if len(command) <= LONGEST_LINE:
        return [command]
    letters = sorted(values)
    half = len(letters) // 2
    parts = (letters[:half], letters[half:])
    return [_format_assignment(name, {letter: values[letter] for letter in part}) for part in parts]


def _round_down(name: str, value: float, least: float, most: float, unit: str) -> int:
    """Return a value in whole units, rounded down. Raises DriverError if it is out of range."""
    if not (math.isfinite(value) and least <= value <= most):
        raise DriverError(f"{name} = {value:.12g} {unit}: must be from {least:.0f} to {most:.0f}")
    return math.floor(value)
