"""Read an emulated FBGS stream with four sensors:

    python benchmarks/fbgs.py [--seconds S] [--insertions N] [--quick] [--json]

The device is another process; the four sensors are in this one. Prints for 100 frames a second, each of 15.8 kB like a
captured one: frames and lost frames of each sensor, the time from the device's stamp to the reading, the duration of
`read()`, and the processor time of a sensor. With --insertions, as many pairs of insertions by the tracker on an
emulated rig, without sensors and beside four that read the stream of its needle; of each period with a decision, the
time to decide and to observe, and late periods. To judge the machine: processor time taken by the host (Linux in a
virtual machine). Exit status 1 if a frame was lost or the 99 % quantile of the time is above 5 ms. With --quick, one
second, nothing is judged.
"""

import sys
import tempfile
import time
from contextlib import ExitStack, closing
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from measuring import parser_of, quantiles, running, show, steal

import flexneedle
from emulated_rig import rig_in
from flexneedle.lab.emulators.fbgs import POSITIONS_MM
from flexneedle.lab.rig.devices.clock import WallClock
from flexneedle.lab.rig.devices.fbg.fbgs import FbgsSensor, FbgsSettings, make_sensor
from flexneedle.lab.rig.rig_file import load_rig
from flexneedle.lab.rig.supervised import SupervisedRig
from flexneedle.results import Period, Plan
from flexneedle.scenario.files import dump_scenario
from flexneedle.scenario.model import Scenario
from flexneedle.scenario.sensors.fbg import Fbg

SENSORS, PERIOD_S, BAR_MS = 4, 0.2, 5.0
DEPTH_MM = 20.0
SITES_MM = (20.0, 50.0, 80.0, 105.0)


class TimedSensor(FbgsSensor):
    """A sensor that keeps the line and the delay (s) of each frame; the emulated device stamps monotonic time."""

    def __init__(self, *arguments: Any) -> None:
        self.lines, self.delays = list[int](), list[float]()
        super().__init__(*arguments)

    def _take(self, frames: Any, arrival: float) -> None:
        super()._take(frames, arrival)
        now = time.monotonic()
        self.lines += [one.line for one in frames]
        self.delays += [now - one.stamp for one in frames]

    @property
    def lost(self) -> int:
        """Frames that did not arrive."""
        return self.lines[-1] - self.lines[0] + 1 - len(self.lines)


def main() -> int:
    """Measure and print."""
    parser = parser_of(__doc__)
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--insertions", type=int, default=0, metavar="N", help="pairs of insertions")
    parser.add_argument("--quick", action="store_true", help="one second, nothing is judged")
    args = parser.parse_args()
    stolen = steal()
    found = measure(1.0 if args.quick else args.seconds) | measure_insertions(args.insertions)
    found["processor time taken by the host, s"] = round(steal() - stolen, 1)
    show(found, as_json=args.json)
    return int(not args.quick and (found["frames lost"] > 0 or found["after stamp, 99 %, ms"] > BAR_MS))


def measure(seconds: float) -> dict[str, Any]:
    """Return the figures of `seconds`."""
    with running(sys.executable, "-m", "flexneedle", "emulate", "fbgs") as (_, address), ExitStack() as stack:
        host, _, port = address.rpartition(":")
        settings = FbgsSettings(host=host, port=int(port), positions_mm=POSITIONS_MM, first=3)
        clock, wanted = WallClock(), Fbg(kind="fbg", sites_mm=SITES_MM)
        sensors = [stack.enter_context(closing(TimedSensor(settings, clock, wanted))) for _ in range(SENSORS)]
        reads, begun, used = list[float](), time.monotonic(), time.process_time()
        while time.monotonic() - begun < seconds:
            time.sleep(PERIOD_S)
            for one in sensors:
                at = time.perf_counter()
                one.read()
                reads.append(time.perf_counter() - at)
        share = (time.process_time() - used) / seconds / SENSORS
        delays = [delay for one in sensors for delay in one.delays]
    found = {"frames": [len(one.lines) for one in sensors], "frames lost": sum(one.lost for one in sensors)}
    found |= quantiles("after stamp", delays) | quantiles("read()", reads)
    return found | {"processor of a sensor, %": round(100.0 * share, 2)}


def measure_insertions(pairs: int) -> dict[str, Any]:
    """Return the figures of the control periods of insertions without and beside four sensors, alternately."""
    if not pairs:
        return {}
    plain = flexneedle.load_scenario("phantom").with_values({"target.depth_mm": DEPTH_MM})
    plan, found = flexneedle.plan(plain, seed=0), dict[int, list[Period]]({0: [], SENSORS: []})
    for seed, sensors in product(range(pairs), found):
        found[sensors] += insert(plain, plan, seed, sensors)
    figures: dict[str, Any] = {}
    for sensors, periods in found.items():
        name = f"beside {sensors} sensors"
        figures |= quantiles(f"period {name}", [one.durations["total"] for one in periods])
        figures[f"periods {name}, late"] = [len(periods), sum(one.late for one in periods)]
    return figures


def insert(plain: Scenario, plan: Plan, seed: int, sensors: int) -> list[Period]:
    """Insert on an emulated rig by its tracker, beside sensors; return the periods with a decision."""
    with tempfile.TemporaryDirectory() as given, ExitStack() as stack:
        folder = Path(given)
        scenario, path = folder / "scenario.toml", folder / "saved.toml"
        fibre = {"kind": "fbg", "sites_mm": list(SITES_MM)}
        scenario.write_text(dump_scenario(plain.with_values({"sensor": [fibre]})), encoding="utf-8")
        emulate = *(sys.executable, "-m", "flexneedle", "emulate", "rig"), rig_in(folder), scenario
        stack.enter_context(running(*emulate, "--save", path))
        rig, clock, wanted = load_rig(path), WallClock(), Fbg.model_validate(fibre)
        settings = rig.sensor[0].settings
        others = [stack.enter_context(closing(make_sensor(settings, clock, wanted))) for _ in range(sensors)]
        source = SupervisedRig(rig.model_copy(update={"sensor": ()}))
        listeners = [lambda _event: [one.read() for one in others] and None]
        done = flexneedle.insert(plain, plan, seed, rig=source, listeners=listeners)
    return [one for one in done.periods if np.isfinite(one.miss[0])]


if __name__ == "__main__":
    sys.exit(main())
