"""Measure the page in a browser: python benchmarks/page.py [--viewers N] [--minutes M] [--seed S] [--quick].

The real server with its workers, and Debian's Chromium, on targets drawn at random in several scenarios. WebGL's draw
calls do nothing, since drawing in software is not what users have. Printed: for each bar the figure and whether it is
kept; exit status 1 if one is not. A computer that does something else at the same time is slower: see its load below
the table. With --quick everything but the memory is measured once, in a short world, and no time is judged.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import numpy as np
import psutil
from playwright.sync_api import Browser, Page, sync_playwright

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
from measuring import steal
from page_drive import DEPTHS, SHARES, VIEWS, Pointer, inserted, loaded, new_page, until, until_ended
from page_figures import (
    Figure,
    Log,
    clicked,
    estimate_delays,
    growth,
    plan_delay,
    processor_times,
    rate,
    refusals,
    spread,
    table,
)

from chromium import ARGUMENTS, CHROMIUM
from flexneedle.planning.planner import plan
from flexneedle.scenario.files import load_scenario
from flexneedle.scenario.model import Scenario

PRESETS = ("phantom", "phantom3d")
FIRST_WORLD, WORLDS_END = 100_000, 200_000  # numbers for reports (flexneedle/scenario/worlds.py)
WARM_S = 60.0
"""Time after which memory is compared with that at the end."""


@dataclass(frozen=True)
class Size:
    """Amount of measurements: visits, drags of each scenario, seconds of each insertion, random worlds."""

    visits: int
    drags: int
    worlds: int


FULL, QUICK = Size(visits=20, drags=12, worlds=4), Size(visits=1, drags=1, worlds=0)
SHORT = "world:100120"


def main() -> int:
    """Run the measurements and print them."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--quick", action="store_true", help="each once, in a short world; no time is judged")
    parser.add_argument(
        "--viewers", type=int, default=10, help="pages of the memory measurement (default: 10)"
    )
    parser.add_argument("--minutes", type=float, help="its length (default: 10; with --quick 0: none)")
    parser.add_argument("--seed", type=int, default=0, help="of scenarios and targets (default: 0)")
    args = parser.parse_args()
    if CHROMIUM is None:
        parser.error("no chromium on the path: apt-get install chromium")
    rng, size = np.random.default_rng(args.seed), QUICK if args.quick else FULL
    minutes = (0.0 if args.quick else 10.0) if args.minutes is None else args.minutes
    worlds = rng.integers(FIRST_WORLD, WORLDS_END, size.worlds).tolist()
    names = [SHORT] if args.quick else [*PRESETS, *(f"world:{number}" for number in worlds)]
    taken, begun = steal(), time.monotonic()
    with tempfile.TemporaryDirectory() as folder, served(Path(folder)) as server, browsers() as browser:
        figures = [*measured(browser, server, names, size, rng)]
        if minutes:
            figures += grown(browser, server, args.viewers, 60.0 * minutes, rng)
    figures.append(searched(names, size.drags, rng))
    print(table(figures))
    share = (steal() - taken) / (time.monotonic() - begun)
    print(f"load {os.getloadavg()[1]:.1f} on {os.cpu_count()} cores, {share:.0%} of one taken by the host")
    judged = [figure for figure in figures if not args.quick or figure.bar == 0.0]
    return 0 if all(figure.kept for figure in judged) else 1


# The server


@dataclass(frozen=True)
class Server:
    """A server that runs: its address and its process, whose children are its workers."""

    address: str
    process: psutil.Process

    def busy(self) -> tuple[float, float]:
        """Processor time (s) of the server and of its workers until now."""
        workers = sum(busy(worker) for worker in self.process.children())
        return busy(self.process), workers

    def memory(self) -> tuple[float, float]:
        """Resident memory (MB) of the server, and of its workers."""
        workers = sum(worker.memory_info().rss for worker in self.process.children())
        return 1e-6 * self.process.memory_info().rss, 1e-6 * workers


def busy(process: psutil.Process) -> float:
    """Processor time (s) of a process."""
    return float(sum(process.cpu_times()[:2]))


@contextmanager
def served(runs: Path) -> Iterator[Server]:
    """`flexneedle serve`, with kernels that are compiled before it starts."""
    warm = "from flexneedle.lab.page.worker.plan_jobs import warm_up; warm_up()"
    subprocess.run([sys.executable, "-c", warm], check=True)
    command = [sys.executable, "-m", "flexneedle", "serve", "--no-open", "--port", "0", "--runs", str(runs)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            yield Server(process.stdout.readline().strip(), psutil.Process(process.pid))
        finally:
            process.terminate()


@contextmanager
def browsers() -> Iterator[Browser]:
    """A browser."""
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=ARGUMENTS)
        yield browser
        browser.close()


# One viewer


def measured(
    browser: Browser, server: Server, names: Sequence[str], size: Size, rng: np.random.Generator
) -> Iterator[Figure]:
    """Figures with one page."""
    page = new_page(browser, server.address)
    until(page, "flexneedle.store.get('plan manipulation')")  # so that both workers are ready
    yield first_picture(browser, server, size.visits)
    yield from dragged(page, server, names, size.drags, rng)
    fewer = names[: len(PRESETS) + size.worlds // 2]
    yield from inserting(page, server, fewer, rng)
    yield painted(browser, page, fewer, rng)
    page.context.close()


def first_picture(browser: Browser, server: Server, count: int) -> Figure:
    """Time from navigation to the first picture, each time with nothing cached."""
    times = []
    for _ in range(count):
        page = new_page(browser, server.address)
        times.append(page.evaluate("probe.first"))
        page.context.close()
    return spread("navigation to the first picture", "ms", times, 1000.0)


def dragged(
    page: Page, server: Server, names: Sequence[str], count: int, rng: np.random.Generator
) -> Iterator[Figure]:
    """Times of estimates and plans while targets are dragged, and what the server itself takes."""
    estimates, plans, shares, all_logs = {}, {}, [], []
    for name in names:
        loaded(page, name)
        before, begun = server.busy(), time.monotonic()
        logs = [Pointer(page, rng).drag_target() for _ in range(count)]
        shares.append(100.0 * (server.busy()[0] - before[0]) / (time.monotonic() - begun))
        estimates[name] = [delay for log in logs for delay in estimate_delays(log)]
        plans[name] = [plan_delay(log) for log in logs]
        all_logs += logs
    yield refusals("refused while targets are dragged", all_logs)
    yield spread("dragged target to the estimate of its plan", "ms", estimates, 200.0)
    yield spread("release to the plan", "ms", plans, 1000.0)
    yield spread("server while targets are dragged", "% of a core", shares, 15.0)


def inserting(page: Page, server: Server, names: Sequence[str], rng: np.random.Generator) -> Iterator[Figure]:
    """Figures while insertions play in real time with 64 sampled paths, with the section in view, and the plots."""
    shares, workers = [], []
    logs_of: dict[str, list[Log]] = {view: [] for view in VIEWS}
    for name, view in product(names, VIEWS):
        loaded(page, name)
        pointer = Pointer(page, rng)
        pointer.drag_target()
        inserted(page)
        page.evaluate("probe.reset()")
        before, begun = server.busy(), time.monotonic()
        pointer.click_until_ended(view)
        lasted, after = time.monotonic() - begun, server.busy()
        shares.append(100.0 * (after[0] - before[0]) / lasted)
        workers.append(100.0 * (after[1] - before[1]) / lasted)
        logs_of[view].append(page.evaluate("probe"))
    logs = [log for some in logs_of.values() for log in some]
    yield refusals("refused while insertions play", logs)
    for view, some in logs_of.items():
        yield rate(f"animation frames, {view} in view", [log["frames"] for log in some], 55.0)
    for view, some in logs_of.items():
        times = [ms for log in some for ms in log["paints"]]
        yield spread(f"script of a paint, by the clock, {view} in view", "ms", times, 5.0)
    yield clicked("click to its painting", logs, "clicks", 50.0)
    yield clicked("click to the painting of the server's answer", logs, "answered", 50.0)
    yield spread("server while insertions play", "% of a core", shares, 15.0)
    yield spread("its workers", "% of a core", workers, None)


def painted(browser: Browser, page: Page, names: Sequence[str], rng: np.random.Generator) -> Figure:
    """Processor time of the page's script, while insertions are traced by the browser.

    The time by the clock has what other processes took of the page's core, too: on two cores the insertion, the
    server and the browser's own drawing.
    """
    times: dict[str, list[float]] = {view: [] for view in VIEWS}
    for name, view in product(names, VIEWS):
        loaded(page, name)
        inserted(page)
        browser.start_tracing(page=page, categories=["devtools.timeline"])
        Pointer(page, rng).click_until_ended(view)
        times[view] += processor_times(json.loads(browser.stop_tracing()))
    return spread("script of a paint, its processor time", "ms", times, 5.0)


# The plan by itself


def searched(names: Sequence[str], count: int, rng: np.random.Generator) -> Figure:
    """Times of plans to random targets like the dragged ones, while neither page nor server runs."""
    plan(names[0])  # compiles or loads the kernels
    times = {name: [1e3 * plan(aimed(name, rng)).seconds for _ in range(count)] for name in names}
    return spread("such a plan by itself", "ms", times, None)


def aimed(name: str, rng: np.random.Generator) -> Scenario:
    """A scenario with a random target; in space it is off in a random direction."""
    scenario = load_scenario(name)
    depth, share = scenario.target.depth_mm * rng.uniform(*DEPTHS), rng.uniform(*SHARES)
    angle = rng.uniform(0.0, np.pi) if scenario.setup.axes == 2 else 0.0
    values = {"lateral_mm": depth * share * np.cos(angle), "lateral_z_mm": depth * share * np.sin(angle)}
    return scenario.with_values(
        {"target.depth_mm": depth, **{f"target.{key}": value for key, value in values.items()}}
    )


# Several viewers


def grown(
    browser: Browser, server: Server, viewers: int, seconds: float, rng: np.random.Generator
) -> Iterator[Figure]:
    """Growth of memory while pages watch insertions in real time, one after the other."""
    pages = [new_page(browser, server.address) for _ in range(viewers)]
    memory, warm, shares, begun = [], 0, [], time.monotonic()
    while time.monotonic() - begun < seconds:
        loaded(pages[0], PRESETS[0])
        pages[0].evaluate("seed => flexneedle.link.ask({type: 'options', seed})", int(rng.integers(2**31)))
        inserted(pages[0])
        started, before = time.monotonic(), server.busy()[0]
        until_ended(pages[0])
        shares.append(100.0 * (server.busy()[0] - before) / (time.monotonic() - started))
        memory.append((*server.memory(), *heaps(pages)))
        warm += time.monotonic() - begun < WARM_S
    for page in pages:
        page.context.close()
    yield spread(f"server, {viewers} pages watch", "% of a core", shares, 15.0)
    yield from growth(memory, warm, viewers)


def heaps(pages: Sequence[Page]) -> tuple[float, float]:
    """Memory (MB) of the largest page after collecting garbage: objects of its scripts, and their arrays."""
    found = []
    for page in pages:
        page.evaluate("probe.reset()")  # whose notes are no memory of the page
        session = page.context.new_cdp_session(page)
        session.send("HeapProfiler.collectGarbage")
        usage = session.send("Runtime.getHeapUsage")
        found.append((1e-6 * usage["usedSize"], 1e-6 * usage.get("backingStorageSize", 0.0)))
        session.detach()
    objects, arrays = np.max(found, axis=0).tolist()
    return objects, arrays


if __name__ == "__main__":
    sys.exit(main())
