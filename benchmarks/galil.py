"""Time from command to reply of the motors on an emulated Galil: python benchmarks/galil.py [--calls N] [--quick].

Loopback, the emulated controller in a separate process, four axes. `read()` and `follow()` are alternated at the rate
at which they come (without a pause), while two axes move; between them an echo of as many bytes as a reading has, by a
plain TCP server in a third process: what the machine needs for a round trip alone. Median, 99 % and largest time of
each, and the ratio to the echo. To judge the machine: processor time taken by the host (Linux in a virtual machine).
Exit status 1 if the 99 % of read() or follow() are above 2 ms; 2 if the 99 % of the echo are above 1 ms: the
machine is busy, and the times do not describe the driver. With --quick, 50 calls, times are not judged.
"""

import socket
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from time import perf_counter

import numpy as np
from measuring import parser_of, quantiles, running, show, steal

from flexneedle.lab.rig.devices.galil.motors import GalilMotors, factory

CHANNELS = "ABCD"
BAR_MS, BUSY_MS = 2.0, 1.0
_ECHO = """
import socket
with socket.create_server(("127.0.0.1", 0)) as server:
    print(server.getsockname()[1], flush=True)
    connection, _ = server.accept()
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    while data := connection.recv(4096):
        connection.sendall(data)
"""
_REPLY = b" 12345, -12345, 0, 0\r\n:" * 4


def main() -> int:
    """Measure and print."""
    parser = parser_of(__doc__)
    parser.add_argument("--calls", type=int, default=5000)
    parser.add_argument("--quick", action="store_true", help="50 calls, times are not judged")
    args = parser.parse_args()
    found = measure(50 if args.quick else args.calls)
    show(found, as_json=args.json)
    if args.quick:
        return 0
    if found["echo, 99 %, ms"] > BUSY_MS:
        return 2
    return 1 if max(found["read(), 99 %, ms"], found["follow(), 99 %, ms"]) > BAR_MS else 0


def measure(calls: int) -> dict[str, float]:
    """Return the times of `calls` calls of each kind."""
    stolen = steal()
    emulator = running(sys.executable, "-m", "flexneedle", "emulate", "galil")
    with emulator as (_, address), echo() as line, connected(address) as motors:
        prepare(motors)
        motion = targets()
        kinds: dict[str, Callable[[], object]] = {
            "echo": lambda: exchanged(line),
            "read()": motors.read,
            "follow()": lambda: motors.follow(next(motion)),
        }
        times: dict[str, list[float]] = {name: [] for name in kinds}
        for _ in range(calls):
            for name, call in kinds.items():
                begun = perf_counter()
                call()
                times[name].append(perf_counter() - begun)
        motors.stop()
    found = {text: value for name, values in times.items() for text, value in quantiles(name, values).items()}
    for name in ("read()", "follow()"):
        ratio = np.median(times[name]) / np.median(times["echo"])
        found[f"{name}, times the echo (medians)"] = round(float(ratio), 2)
    found["processor time taken by the host, s"] = round(steal() - stolen, 1)
    return found


def connected(address: str) -> GalilMotors:
    """Return the motors of a controller."""
    return factory({"address": address, "reply_timeout_ms": 1000.0}, list(CHANNELS))


def prepare(motors: GalilMotors) -> None:
    """Switch the motors on."""
    for channel in CHANNELS:
        motors.power(channel, True)
        motors.set_speed(channel, 20_000.0, 1_024_000.0)


def targets() -> Iterator[dict[str, float]]:
    """Targets of two axes, ahead of where they are."""
    position = 0.0
    while True:
        position += 10.0
        yield {"A": position, "B": -position}


def exchanged(line: socket.socket) -> None:
    """Send as many bytes as a reading has, and receive them."""
    line.sendall(_REPLY)
    received = 0
    while received < len(_REPLY):
        received += len(line.recv(4096))


@contextmanager
def echo() -> Iterator[socket.socket]:
    """Run the echo server; yield a connection to it."""
    with (
        running(sys.executable, "-c", _ECHO) as (_, port),
        socket.create_connection(("127.0.0.1", int(port))) as line,
    ):
        line.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        yield line


if __name__ == "__main__":
    sys.exit(main())
