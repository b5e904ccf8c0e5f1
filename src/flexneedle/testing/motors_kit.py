"""Conformance kit of the port `Motors`, of the driver of a rig file."""

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext, suppress
from time import monotonic, sleep
from typing import Any
from unittest import SkipTest

from flexneedle.errors import DriverError
from flexneedle.lab.rig.devices.opening import setups_rule, states_rule, text_rule
from flexneedle.plugins import parts_of
from flexneedle.ports import MotorPaces, Motors, MotorState
from flexneedle.testing.checks import require, require_error, require_finite, require_parts

_POLL_S = 0.01


class MotorsConformance:
    """Checks of a motor driver. `make` returns the motors, connected and at rest. The first channel moves.

    Override `now` and `wait` for motors in simulated time.

    Attributes:
        channels: Channels as in the rig file.
        distance: Way of a motion to either side of the start (counts).
        speed: Speed of the motions (counts/s).
        acceleration: Acceleration of the motions (counts/s²).
        tolerance: Tolerance of a position at rest (counts).
        reply_s: Longest time of a call (s).
        patience_s: Time in which a motion ends (s).
        switches_off: Whether motors can be switched off; if not, they stay on, with or without a DriverError.
    """

    channels: tuple[str, ...] = ("X",)
    distance = 500.0
    speed = 2000.0
    acceleration = 100_000.0
    tolerance = 2.0
    reply_s = 0.2
    patience_s = 5.0
    switches_off = True

    def make(self) -> Motors:
        """Return the motors of `channels`, connected and at rest."""
        raise NotImplementedError("make: define it in your class, and return your part")

    def now(self) -> float:
        """Return the time (s) of the motors."""
        return monotonic()

    def wait(self, seconds: float) -> None:
        """Wait in the time of the motors."""
        sleep(seconds)

    def disconnect(self, motors: Motors) -> None:  # noqa: ARG002  for a subclass
        """Make the device fail, so that no command is carried out (default: the check is skipped)."""
        raise SkipTest(f"{type(self).__name__} has no disconnect()")

    @property
    def _channel(self) -> str:
        return self.channels[0]

    @contextmanager
    def _open(self, *, on: bool = False) -> Iterator[Motors]:
        """Open the motors; on: with the first one powered, and its speed set."""
        motors = self.make()
        try:
            if on:
                motors.power(self._channel, True)
                motors.set_speed(self._channel, self.speed, self.acceleration)
            yield motors
        finally:
            motors.stop()
            motors.close()

    def _read(self, motors: Motors) -> MotorState:
        return motors.read()[self._channel]

    def _rest(self, motors: Motors) -> MotorState:
        """Return the state at the end of the motion."""
        end = self.now() + self.patience_s
        while (state := self._read(motors)).moving:
            require(self.now() < end, f"a motion did not end in {self.patience_s} s: {state}")
            self.wait(_POLL_S)
        return state

    def _move(self, motors: Motors, way: float) -> MotorState:
        """Return the state at the end of a motion to `way` counts from the present position."""
        goal = self._read(motors).position + way
        motors.follow({self._channel: goal})
        self.wait(_POLL_S)
        state = self._rest(motors)
        self._require_at("the end of a motion", state.position, goal)
        return state

    def _calls(self, motors: Motors, position: float) -> dict[str, Callable[[], Any]]:
        """Return the calls of the first motor that need the device, by name."""
        return {
            "read": motors.read,
            "set_speed": lambda: motors.set_speed(self._channel, self.speed, self.acceleration),
            "follow": lambda: motors.follow({self._channel: position}),
            "stop": motors.stop,
            "power": lambda: motors.power(self._channel, True),
            "define": lambda: motors.define(self._channel, position),
        }

    def _require_at(self, name: str, position: float, wanted: float) -> None:
        require(
            abs(position - wanted) <= self.tolerance, f"{name} must be at {wanted} counts, not {position}"
        )

    def test_has_the_parts_of_the_port(self) -> None:
        """Require all methods of `Motors`, and the optional ones in their types."""
        with self._open() as motors:
            require_parts("the driver", motors, *parts_of(Motors))
            for name in ("identity", "address"):
                require(not (rule := text_rule(getattr(motors, name, ""))), f"{name} {rule}")
            require(not (rule := setups_rule(getattr(motors, "setup", dict)())), f"setup() {rule}")
            paces = getattr(motors, "paces", None)
            require(
                paces is None or isinstance(paces, MotorPaces), f"paces must be MotorPaces, not {paces!r}"
            )

    def test_read_returns_the_state_of_each_channel(self) -> None:
        """Require a mapping of exactly these channels to states with finite positions."""
        with self._open() as motors:
            states = motors.read()
            require(not (rule := states_rule(states)), f"read() {rule}")
            require(
                set(states) == set(self.channels), f"read() must have the channels {self.channels}: {states}"
            )
            for state in states.values():
                require_finite("a position", (state.position, state.commanded))

    def test_opening_and_reading_move_nothing(self) -> None:
        """Require motors at rest that read the same, also after a caller has changed what it was given."""
        with self._open() as motors:
            states = motors.read()
            before = {name: state.position for name, state in states.items()}
            if isinstance(states, dict):
                states.clear()
            self.wait(5 * _POLL_S)
            for name, state in motors.read().items():
                require(not state.moving, f"{name} moves without a command")
                self._require_at(f"{name}, without a command,", state.position, before[name])
            require(
                set(motors.read()) == set(self.channels),
                "a changed result of read() must not change the next",
            )

    def test_power_holds_the_motor_where_it_is(self) -> None:
        """Require that `on` follows the switch, and that the commanded position is the measured one."""
        with self._open() as motors:
            before = self._read(motors).position
            for on in (True, False, True):
                with nullcontext() if on or self.switches_off else suppress(DriverError):
                    motors.power(self._channel, on)
                state, wanted = self._read(motors), on or not self.switches_off
                require(bool(state.on) is wanted, f"after power({on}) the state has on = {state.on}")
                self._require_at("a motor that is switched", state.position, before)
            self._require_at("the commanded position of a motor that is switched on", state.commanded, before)

    def test_follow_moves_to_a_position_and_stops_there(self) -> None:
        """Require a motion to an absolute position, to either side, without overshoot."""
        with self._open(on=True) as motors:
            for way in (self.distance, -self.distance):
                begin = self._read(motors).position
                motors.follow({self._channel: begin + way})
                found = [self._read(motors)]
                self.wait(_POLL_S)
                while (state := self._read(motors)).moving:
                    found.append(state)
                    require(len(found) < self.patience_s / _POLL_S, f"a motion did not end: {state}")
                    self.wait(_POLL_S)
                self._require_at("the end of a motion", state.position, begin + way)
                require(any(one.moving for one in found), "moving must be True during a motion")
                for one in found:
                    share = (one.position - begin) / way
                    margin = self.tolerance / self.distance
                    require(-margin <= share <= 1.0 + margin, f"a motion left its way: {share:.0%} of it")

    def test_follow_does_not_wait_for_the_end(self) -> None:
        """Require that `follow` returns during the motion and does not change its argument."""
        with self._open(on=True) as motors:
            given = {self._channel: self._read(motors).position + self.distance}
            before = dict(given)
            motors.follow(given)
            require(self._read(motors).moving, "follow must return at once, during the motion")
            require(given == before, "follow must not change the positions that it is given")
            self._rest(motors)

    def test_follow_replaces_the_position_before(self) -> None:
        """Require that a motor under way turns to a new position."""
        with self._open(on=True) as motors:
            begin = self._read(motors).position
            motors.follow({self._channel: begin + self.distance})
            self.wait(3 * _POLL_S)
            end = self.now() + self.patience_s
            # A driver may finish the motion under way first: the position is repeated, as in an insertion.
            while abs(self._read(motors).position - begin) > self.tolerance or self._read(motors).moving:
                require(self.now() < end, f"a new position was not reached: {self._read(motors)}")
                motors.follow({self._channel: begin})
                self.wait(_POLL_S)

    def test_speed_is_limited(self) -> None:
        """Require no more than the speed (counts/s) that was set."""
        with self._open(on=True) as motors:
            motors.set_speed(self._channel, 0.5 * self.speed, self.acceleration)
            begin, start = self._read(motors).position, self.now()
            motors.follow({self._channel: begin + self.distance})
            self.wait(_POLL_S)
            state = self._rest(motors)
            least = self.distance / (0.5 * self.speed)
            taken = self.now() - start
            require(
                taken >= 0.95 * least,
                f"{self.distance} counts took {taken} s, at least {least} s at this speed",
            )
            self._require_at("the end of a motion", state.position, begin + self.distance)

    def test_stop_ends_a_motion(self) -> None:
        """Require a stop on the way, with the motor on, at rest from then on; a repeated stop changes nothing."""
        with self._open(on=True) as motors:
            begin = self._read(motors).position
            motors.follow({self._channel: begin + self.distance})
            self.wait(5 * _POLL_S)
            motors.stop()
            state = self._rest(motors)
            way = state.position - begin
            require(
                way < self.distance - self.tolerance,
                f"stop must end the motion on its way: {way} counts done",
            )
            motors.stop()
            self.wait(5 * _POLL_S)
            after = self._read(motors)
            require(not after.moving, "a motor must rest after a stop")
            require(bool(after.on), "a stop must leave the motor powered")
            self._require_at("a motor after a stop", after.position, state.position)

    def test_define_renames_the_position(self) -> None:
        """Require the defined position without a motion, and later positions in its terms."""
        with self._open(on=True) as motors:
            motors.define(self._channel, 10_000.0)
            state = self._read(motors)
            self._require_at("a defined position", state.position, 10_000.0)
            require(not self._rest(motors).moving, "define must move nothing")
            self._move(motors, -self.distance)
            motors.define(self._channel, 0.0)
            self._require_at("a defined position", self._read(motors).position, 0.0)

    def test_motor_that_is_off_does_not_move(self) -> None:
        """Require that `follow` of a motor without power raises DriverError, or moves nothing."""
        if not self.switches_off:
            raise SkipTest(f"{type(self).__name__} cannot switch motors off")
        with self._open() as motors:
            motors.power(self._channel, False)
            begin = self._read(motors).position
            try:
                motors.follow({self._channel: begin + self.distance})
            except DriverError:
                return
            self.wait(10 * _POLL_S)
            self._require_at("a motor without power", self._read(motors).position, begin)

    def test_position_that_is_not_finite_is_refused(self) -> None:
        """Require DriverError for positions of infinity and NaN, and no motion."""
        with self._open(on=True) as motors:
            begin = self._read(motors).position
            for position in (math.nan, math.inf):
                with require_error(f"follow({position})", DriverError):
                    motors.follow({self._channel: position})
            self._require_at("a motor after a refusal", self._rest(motors).position, begin)

    def test_reconnect_moves_nothing(self) -> None:
        """Require the same positions over a new connection, which may take several calls."""
        with self._open(on=True) as motors:
            begin, end = self._read(motors).position, self.now() + self.patience_s
            while True:
                try:
                    motors.reconnect()
                    break
                except DriverError:
                    require(self.now() < end, f"reconnect did not succeed in {self.patience_s} s")
                    self.wait(0.25)
            self._require_at("a motor after reconnect", self._read(motors).position, begin)

    def test_calls_reply_in_time(self) -> None:
        """Require that no call takes longer than `reply_s`."""
        with self._open(on=True) as motors:
            begin = self._read(motors).position
            for name, call in self._calls(motors, begin).items():
                self._rest(motors)
                start = self.now()
                call()
                require(self.now() - start <= self.reply_s, f"{name} took {self.now() - start} s")

    def test_failures_are_driver_errors(self) -> None:
        """Require DriverError from each call after `disconnect`."""
        motors = self.make()
        try:
            self.disconnect(motors)
            calls = {**self._calls(motors, 0.0), "reconnect": motors.reconnect}
            for name, call in calls.items():
                with require_error(f"{name} without a device", DriverError):
                    call()
        finally:
            motors.close()

    def test_close_can_be_repeated(self) -> None:
        """Require that a second `close` does nothing."""
        motors = self.make()
        motors.close()
        motors.close()
