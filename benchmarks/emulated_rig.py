"""Insert into an emulated rig at 5 mm/s: python benchmarks/emulated_rig.py [--json].

In the plane and in space the insertion axis moves to a depth of 40 mm while the guide moves, and the bevel rolls on the
way; a client asks the controller for positions and reads the tracker at 40 Hz, as a rig's loop does. Printed: processor
time of each process over the time of the motion (in % of a core), and the lag of the phantom behind the motors (median,
99 %, largest). To judge the machine: processor time taken by the host and by other processes.
"""

import json
import os
import socket
import sys
import tempfile
from importlib.resources import files
from pathlib import Path
from time import monotonic

import numpy as np
import psutil
from measuring import parser_of, quantiles, running, show, steal

from flexneedle.lab.emulators.emulated_rig.truth import read_truth
from flexneedle.lab.rig.devices.aurora.aurora_tracker import Aurora
from flexneedle.lab.rig.devices.clock import WallClock

SPEED_MM_S, COUNTS_PER_MM, PERIOD_S = 5.0, 2000, 0.025
DEPTH_MM, AIR_MM, ROLL_AT_MM = 40.0, 28.5, 20.0
HALF_TURN = 18_000


def main() -> int:
    """Run both insertions and print them."""
    parser = parser_of(__doc__)
    parser.add_argument("--depth", type=float, default=DEPTH_MM, help="mm (default: 40)")
    args = parser.parse_args()
    show({name: measure(name, args.depth) for name in ("phantom", "phantom3d")}, as_json=args.json)
    return 0


def measure(scenario: str, depth: float) -> dict[str, float]:
    """Insert into a scenario's phantom; return shares of the processor (%) and lags (ms)."""
    with tempfile.TemporaryDirectory() as folder:
        truth = Path(folder) / "truth.csv"
        command = (sys.executable, "-m", "flexneedle", "emulate", "rig", rig_in(Path(folder)), scenario)
        with running(*command, "--truth", truth) as (_, ready):
            return inserted(json.loads(ready), truth, depth)


def rig_in(folder: Path) -> str:
    """Write the emulated rig of the package with a free port and a separate link; return its path."""
    text = (files("flexneedle.lab.rig") / "rigs" / "emulated.toml").read_text(encoding="utf-8")
    path = folder / "rig.toml"
    path.write_text(
        text.replace(":2323", ":0").replace("/tmp/aurora", str(folder / "aurora")), encoding="utf-8"
    )
    return str(path)


def inserted(ready: dict, truth: Path, depth: float) -> dict[str, float]:
    """Insert with a guide that moves, in two parts with a half turn between them; return the figures."""
    host, port = ready["ready"]["galil"].rsplit(":", 1)
    processes = {name: psutil.Process(pid) for name, pid in ready["pids"].items()}
    clock = WallClock()
    with (
        socket.create_connection((host, int(port))) as line,
        Aurora(ready["ready"]["aurora"], clock) as aurora,
    ):
        ask(line, "SHABCD;SP 10000,36000,400,300")
        ask(line, "AC 500000,360000,500000,500000;DC 500000,360000,500000,500000")
        before, begun, taken = busy(processes), monotonic(), steal()
        first, second = AIR_MM + ROLL_AT_MM, depth - ROLL_AT_MM
        frames = move(line, aurora, clock, counts(first), "ACD")
        frames += move(line, aurora, clock, f"PRB={HALF_TURN};BGB", "B")
        frames += move(line, aurora, clock, counts(second), "ACD")
        lasted, after = monotonic() - begun, busy(processes)
        counted = aurora.counts
    shares = {
        f"{name}, % of a core": round(100 * (after[name] - before[name]) / lasted, 1) for name in processes
    }
    return (
        shares
        | lags(truth)
        | {
            "frames": frames,
            "frames lost": counted.missed,
            "motion, s": round(lasted, 1),
            "taken by the host, s": round(steal() - taken, 1),
            "load of the machine (cores)": round(os.getloadavg()[0], 1),
        }
    )


def counts(advance: float) -> str:
    """The command for an advance (mm) at 5 mm/s with the guide."""
    return f"PR {round(COUNTS_PER_MM * advance)},,2000,-1500;BGACD"


def move(line: socket.socket, aurora: Aurora, clock: WallClock, commands: str, letters: str) -> int:
    """Begin a motion, and ask and read at 40 Hz until it has ended; return the number of frames."""
    ask(line, commands)
    frames = 0
    query = "MG " + ",".join(f"_BG{letter}" for letter in letters)
    while any(map(float, ask(line, query).strip(" \r\n:").split())):
        ask(line, "TP")
        frames += len(aurora.read())
        clock.wait(PERIOD_S)
    return frames


def ask(line: socket.socket, commands: str) -> str:
    """Send a line to the controller; return its reply."""
    line.sendall(f"{commands}\r".encode())
    answer = b""
    while answer.count(b":") + answer.count(b"?") <= commands.count(";"):
        answer += line.recv(4096)
    return answer.decode()


def busy(processes: dict[str, psutil.Process]) -> dict[str, float]:
    """Processor time (s) of each process."""
    return {name: sum(process.cpu_times()[:2]) for name, process in processes.items()}


def lags(path: Path) -> dict[str, float]:
    """Lags (ms) of the phantom while the motors moved."""
    truth = read_truth(path)
    travel = np.stack(list(truth.counts.values()), axis=-1)
    moving = np.append((np.diff(travel, axis=0) != 0.0).any(axis=1), False)
    return quantiles("lag", truth.lag[moving]) | {
        "rows a second in motion": round(1.0 / float(np.median(np.diff(truth.time)[moving[:-1]]))),
    }


if __name__ == "__main__":
    sys.exit(main())
