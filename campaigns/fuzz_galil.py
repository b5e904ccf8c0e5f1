"""Random and mutated inputs to the Galil driver and its emulated controller.

    python campaigns/fuzz_galil.py [--inputs N] [--seconds S] [--seed N] [--part parser|controller|driver]

Three parts, each until N inputs (default: a million) or S seconds (default: 600):

parser      replies to the driver, as bytes: read, or refused with GarbledError; nothing is lost or added
controller  lines to the emulated controller: each command is answered, the state stays valid, and an axis begins to
            move only by BG, or by PA in position tracking, with its motor on
driver      calls of `GalilMotors` on a controller that answers by damaged, partial, huge, late, no or true replies: a
            state that is what was sent, or DriverError; never later than the reply timeout; no motion but by `follow`

Prints the inputs and the largest times; at the first failure its seed and input, and exit status 1.
"""

import re
import socket
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from random import Random
from time import monotonic

from flexneedle.errors import DriverError
from flexneedle.lab.emulators.galil.controller import ControllerState, advance_controller, reply
from flexneedle.lab.emulators.galil.motor_axis import MotorAxis
from flexneedle.lab.rig.devices.galil.motors import GalilMotors, factory
from flexneedle.lab.rig.devices.galil.replies import GarbledError, parse_numbers, parse_replies, parse_text
from flexneedle.lab.rig.devices.galil.states import make_report
from flexneedle.ports import MotorState
from fuzzing import Failure, Part, main, mutate

FARTHEST = 2.0**31
TIMEOUT_MS, SLACK_S = 10.0, 1.0  # slack: the machine may be busy with other processes
RECOVERY_S = 20.0
LETTERS = "AB"
MOVES = re.compile(r"(^|;)\s*(BG|PA|PR|PT)(?![A-H]*\?)")


# The parser

REPLIES = (
    b" 200, -10\r\n: 200, -10\r\n: 15, 143\r\n: 1, 0\r\n:",
    b" 200.0000 -2147483648.0000\r\n:",
    b" DMC4143 Rev 1.3d\r\n:",
    b" 22 Begin not possible due to Limit Switch\r\n:",
    b":::",
    b"?",
)
BYTES = b" -0123456789,.:?\r\n;$eEnaif\x00\x7f\x80\xba\xbf\xff"


def parser_inputs(random: Random) -> Iterator[str]:
    """Parse one input after another."""
    while True:
        received = mutate(random, random.choice(REPLIES), BYTES)
        count = random.randint(1, 5)
        with suppress(GarbledError):
            found = parse_replies(received, count)
            if found is not None:
                rebuilt = "".join(each.data + "?:"[each.accepted] for each in found).encode()
                if rebuilt != received or len(found) != count:
                    raise Failure(f"{received!r} as {count} replies: {found}")
                values = [value for each in found for value in parse_numbers(each.data, random.randint(1, 3))]
                if not all(abs(value) < 1e10 for value in values):
                    raise Failure(f"{received!r}: {values}")
                make_report(*(values * 4)[:4])
        with suppress(GarbledError):
            parse_text(received.decode("latin-1"))
        yield ""


# The emulated controller

MOTION = ("SH", "MO", "BG", "ST", "AB", "PR", "PA", "PT", "DP")
SETTINGS = ("SP", "AC", "DC", "SD", "FL", "BL", "ER", "OE")
OTHERS = ("TP", "RP", "TE", "TV", "TS", "SC", "TC", "MG", "EO", "XX", "A")
NAMES = (*MOTION, *MOTION, *SETTINGS, *OTHERS)
SMALL = ("0", "1", "-1", "2", "100", "-100", "5000", "1e3", "2e5")
LARGE = ("2147483647", "-2147483648", "2147483648", "nan", "inf")
NUMBERS = (*SMALL, *SMALL, *LARGE, "?", "", "0.5", "--1")
VALID_CODES = {0, 1, 2, 3, 4, 7, 8}


def controller_inputs(random: Random) -> Iterator[str]:
    """Send one line after another to controllers that last for some hundred lines each."""
    while True:
        device = ControllerState()
        for _ in range(random.randint(1, 300)):
            line = random_line(random)
            device = check_line(device, line, random.randint(0, 8))
            yield ""


def random_line(random: Random) -> str:
    """Return some commands, most of them valid."""
    return ";".join(random_command(random) for _ in range(random.randint(1, 3)))


def random_command(random: Random) -> str:
    if random.random() < 0.05:
        return "".join(chr(random.randrange(256)) for _ in range(random.randint(0, 12)))
    name, kind = random.choice(NAMES), random.random()
    axes = "".join(random.sample("ABCD", random.randint(0, 4)))
    if kind < 0.4:
        return f"{name}{random.choice('ABCDE')}={random.choice(NUMBERS)}"
    if kind < 0.6:
        return f"{name} {','.join(random.choice(NUMBERS) for _ in range(random.randint(1, 5)))}"
    if kind < 0.7:
        return f"MG _{name}{axes[:1]},_{random.choice(NAMES)}A"
    return name + axes


def check_line(
    device: ControllerState,
    line: str,
    samples: int,
    answered: Callable[[ControllerState, str], tuple[ControllerState, str]] = reply,
) -> ControllerState:
    """Return the controller after a line and some samples. answered: the controller. Raises Failure."""
    try:
        after, answer = answered(device, line)
        later = advance_controller(after, samples)
    except Exception as error:
        raise Failure(f"{line!r} on {device}: {error!r}") from error
    if answer.count(":") + answer.count("?") != line[:80].count(";") + 1:
        raise Failure(f"{line!r}: {answer!r}")
    begins = any(command.strip()[:2] in ("BG", "PA") for command in line[:80].split(";"))
    for before, now, moved in zip(device.axes, after.axes, later.axes, strict=True):
        check_axis(moved, line)
        if now.running and not before.running and not (begins and now.servo):
            raise Failure(f"{line!r}: an axis began to move: {now}")
        if moved.encoder != now.encoder and not (now.running and now.servo):
            raise Failure(f"{line!r}: an axis at rest moved: {now}")
    return later


def check_axis(axis: MotorAxis, line: str) -> None:
    """Raise Failure if an axis is in a state that cannot be."""
    profile = axis.profile
    good = (
        abs(profile.position) <= 2 * FARTHEST
        and abs(axis.encoder) <= 2 * FARTHEST
        and abs(profile.velocity) <= 15e6 + 1e-6
        and profile.speed % 2 == profile.acceleration % 1024 == axis.deceleration % 1024 == 0.0
        and axis.stop in VALID_CODES
        and (axis.servo or not (axis.running or axis.tracking))
    )
    if not good:
        raise Failure(f"{line!r}: {axis}")


# The driver


@dataclass
class Server:
    """A controller that answers as `damage` has it, from the line on at which it is set."""

    port: int
    device: ControllerState = field(default_factory=ControllerState)
    damage: Callable[[bytes], bytes | None] | None = None
    sent: bytes = b""
    lines: list[str] = field(default_factory=list)

    def answer(self, line: str) -> bytes | None:
        """Return what to send; None: nothing, b"": the connection is closed."""
        self.lines.append(line)
        self.device, true = reply(advance_controller(self.device, 2), line)
        complete = true.encode()
        found = complete if self.damage is None else self.damage(complete)
        self.sent = found or b""
        return found


@contextmanager
def serving() -> Iterator[Server]:
    """Run the controller in a thread."""
    with socket.create_server(("127.0.0.1", 0)) as listening:
        server = Server(listening.getsockname()[1])
        thread = threading.Thread(target=serve, args=(listening, server), daemon=True)
        thread.start()
        try:
            yield server
        finally:
            listening.shutdown(socket.SHUT_RDWR)
            thread.join()


def serve(listening: socket.socket, server: Server) -> None:
    """Answer one connection after another until the socket is closed."""
    while True:
        try:
            connection, _ = listening.accept()
        except OSError:
            return
        with connection:
            try:
                converse(connection, server)
            except OSError:
                continue


def converse(connection: socket.socket, server: Server) -> None:
    """Answer lines until the connection is closed."""
    received = b""
    while data := connection.recv(4096):
        *complete, received = (received + data).split(b"\r")
        for line in complete:
            answer = server.answer(line.decode("ascii", "replace"))
            if answer == b"":
                return
            if answer is not None:
                connection.sendall(answer)


def driver_inputs(random: Random) -> Iterator[str]:
    """Call the driver in both modes with one damaged reply after another."""
    longest, rigs = 0.0, []
    with ExitStack() as stack:
        for mode in ("tracking", "moves"):
            server = stack.enter_context(serving())
            settings = {"address": f"127.0.0.1:{server.port}", "reply_timeout_ms": TIMEOUT_MS, "mode": mode}
            motors = stack.enter_context(factory(settings, list(LETTERS)))
            server.device, _ = reply(server.device, "SH")
            rigs.append((motors, server))
        while True:
            longest = max(longest, call_driver(*random.choice(rigs), random.choice(CALLS), random))
            yield f", longest call {1e3 * longest:.0f} ms of {TIMEOUT_MS:.0f}"


def damages(random: Random) -> Callable[[bytes], bytes | None] | None:
    """Return damages of true replies."""
    kind = random.random()
    if kind < 0.2:
        return None
    if kind < 0.25:
        return lambda _true: None
    if kind < 0.28:
        return lambda _true: b""
    if kind < 0.3:
        return lambda _true: b" 1" * 5000
    if kind < 0.4:
        return lambda true: true[: len(true) // 2] or None
    if kind < 0.5:
        return lambda true: b" 17.0000\r\n" + true
    if kind < 0.6:
        return lambda true: true + true
    return lambda true: mutate(random, true, BYTES) or None


def call_driver(motors: GalilMotors, server: Server, name: str, random: Random) -> float:
    """Make a call with damaged replies; return how long it took. Raises Failure."""
    server.damage = damages(random)
    server.lines.clear()
    begun = monotonic()
    try:
        found = ACTIONS[name](motors, random)
    except DriverError:
        found = None
    except Exception as error:
        raise Failure(f"{name} answered by {server.sent!r}: {error!r}") from error
    took = monotonic() - begun
    if took > TIMEOUT_MS / 1e3 + SLACK_S:
        raise Failure(f"{name} answered by {server.sent!r} took {took:.3f} s")
    if name == "read" and found is not None:
        compare_states(found, server.sent)
    server.damage = None
    if not connect(motors):
        recover(motors)
    if name != "follow" and (moves := [line for line in server.lines if MOVES.search(line)]):
        raise Failure(f"{name} answered by {server.sent!r} sent {moves}")
    return took


def compare_states(states: Mapping[str, MotorState], sent: bytes) -> None:
    """Raise Failure if states differ from the sent ones."""
    first, second = re.findall(rb"-?[0-9.]+", sent)[:2], re.findall(rb"-?[0-9.]+", sent)[2:4]
    true = [float(value) for value in first + second]
    read = [state.position for state in states.values()] + [state.commanded for state in states.values()]
    if true != read:
        raise Failure(f"{sent!r} read as {states}")


def connect(motors: GalilMotors) -> bool:
    """Return whether a reading succeeds."""
    try:
        motors.read()
    except DriverError:
        return False
    return True


def recover(motors: GalilMotors) -> None:
    """Connect again to a controller that answers. Raises Failure if that does not succeed."""
    deadline, reason = monotonic() + RECOVERY_S, ""
    while monotonic() < deadline:
        try:
            motors.reconnect()
        except DriverError as error:
            reason = str(error)
            continue
        return
    raise Failure(f"no connection to a controller that answers: {reason}")


ACTIONS: dict[str, Callable[[GalilMotors, Random], object]] = {
    "read": lambda motors, _: motors.read(),
    "follow": lambda motors, random: motors.follow({"A": random.uniform(-1e4, 1e4)}),
    "set_speed": lambda motors, random: motors.set_speed("B", random.uniform(0, 1e5), random.uniform(0, 1e6)),
    "stop": lambda motors, _: motors.stop(),
    "define": lambda motors, random: motors.define("A", random.uniform(-1e4, 1e4)),
    "power": lambda motors, random: motors.power("B", random.random() < 0.5),
    "setup": lambda motors, _: motors.setup(),
    "reconnect": lambda motors, _: motors.reconnect(),
}
CALLS = ("read", "read", "follow", *ACTIONS)
PARTS: dict[str, Part] = {"parser": parser_inputs, "controller": controller_inputs, "driver": driver_inputs}

if __name__ == "__main__":
    sys.exit(main(__doc__, PARTS))
