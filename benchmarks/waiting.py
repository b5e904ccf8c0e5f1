"""Measure how long commands keep their user waiting: python benchmarks/waiting.py [--quick] [--before TREE] [--json].

Each command runs in a new process with compiled kernels: wall clock, and processor time (user + sys), medians of
several runs. The stages are wall clock of the same runs; `other` is the interpreter, the options and the table. With
`--before`, the commands of another checkout run alternately: its figures, and the medians of the ratios to them.
"""

import json
import os
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from statistics import median
from typing import Any

COMMANDS = ("--version", "plan phantom", "plan phantom3d", "insert phantom")
KERNELS, IMPORTS = "kernels loaded", "imports"
STAGES = {
    "flexneedle.phantom.kernels": {KERNELS: ["compile_kernels"]},
    "flexneedle.planning.planner": {"search": ["plan"]},
    "flexneedle.loop.insertions": {"insertion": ["carry_out"]},
    "flexneedle.record.figures": {"figure": ["draw_run"]},
    "flexneedle.record.folder": {"record": ["Folder.claim", "Folder.write"]},
    "flexneedle.record.writer": {"record": ["TraceWriter.__init__", "TraceWriter.add", "TraceWriter.close"]},
}
"""Functions of each stage by their module; a stage does not include the stages inside it."""


class Stopwatch:
    """Wall-clock time of nested stages, each without those inside it, in the main thread."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = defaultdict(float)
        self._open, self._since = ["other"], time.perf_counter()

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Count the block as a stage; imports that load kernels belong to the kernels."""
        self._change(lambda: self._open.append(KERNELS if self._open[-1] == KERNELS else name))
        try:
            yield
        finally:
            self._change(self._open.pop)

    def _change(self, change: Callable[[], Any]) -> None:
        now = time.perf_counter()
        self.seconds[self._open[-1]] += now - self._since
        self._since = now
        change()

    def wrap(self, owner: Any, name: str, stage: str) -> None:
        """Count the calls of a function of a module or class as a stage."""
        outer, _, last = name.rpartition(".")
        owner = getattr(owner, outer) if outer else owner
        function = getattr(owner, last)

        def timed(*given: Any, **options: Any) -> Any:
            with self.stage(stage):
                return function(*given, **options)

        setattr(owner, last, timed)


def run_timed(out: Path, argv: list[str]) -> int:
    """Run a command in this process, and write the seconds of its stages to a file."""
    watch = Stopwatch()
    bootstrap: Any = sys.modules["_frozen_importlib"]
    find = bootstrap._find_and_load

    def find_timed(name: str, import_: Any) -> Any:
        with watch.stage(IMPORTS):
            module = find(name, import_)
        for stage, functions in STAGES.pop(name, {}).items():
            for function in functions:
                watch.wrap(module, function, stage)
        return module

    bootstrap._find_and_load = find_timed
    try:
        from flexneedle.cli.main import main

        return main(argv)
    finally:
        with watch.stage("other"):
            out.write_text(json.dumps(watch.seconds))


def measure(command: str, source: Path, folder: Path) -> dict[str, float]:
    """Return wall clock, processor time and stages (s) of one run of a command."""
    argv = [*command.split(), *(["--out", str(folder / "run")] if "phantom" in command else [])]
    stages = folder / "stages.json"
    environment = {**os.environ, "PYTHONPATH": str(source)}
    environment.pop("PYTHONDONTWRITEBYTECODE", None)  # would compile this package's sources in each run
    begun = time.perf_counter()
    child = os.posix_spawn(
        sys.executable,
        [sys.executable, __file__, "--stages", str(stages), *argv],
        environment,
        file_actions=[(os.POSIX_SPAWN_OPEN, fd, os.devnull, os.O_WRONLY, 0) for fd in (1, 2)],
    )
    _, status, usage = os.wait4(child, 0)
    wall = time.perf_counter() - begun
    if status:
        raise RuntimeError(f"flexneedle {command} ended with status {os.waitstatus_to_exitcode(status)}")
    found = {"wall": wall, "user + sys": usage.ru_utime + usage.ru_stime} | json.loads(stages.read_text())
    return found | {
        "other": wall - sum(found[name] for name in found.keys() - {"wall", "user + sys", "other"})
    }


def measure_pairs(command: str, trees: list[Path], runs: int) -> list[list[dict[str, float]]]:
    """Return, for each run, the figures of each source tree, which run alternately; a first run is not counted."""
    rounds = []
    for _ in range(runs + 1):
        row = []
        for tree in trees:
            with tempfile.TemporaryDirectory() as folder:
                row.append(measure(command, tree, Path(folder)))
        rounds.append(row)
    return rounds[1:]


def summarize(rounds: list[list[dict[str, float]]]) -> dict[str, float]:
    """Return medians (s) by name, and of a second tree, and the median ratios to it."""
    found = {f"{name}, s": median(row[0][name] for row in rounds) for name in rounds[0][0]}
    if len(rounds[0]) > 1:
        for name in ("wall", "user + sys"):
            found[f"{name} before, s"] = median(row[1][name] for row in rounds)
            found[f"{name}, ratio to before"] = median(row[0][name] / row[1][name] for row in rounds)
    return found


def main() -> None:
    """Measure and print."""
    from measuring import parser_of, show  # not in the measured process, since it imports NumPy

    parser = parser_of(__doc__)
    parser.add_argument("--quick", action="store_true", help="one run of each command")
    parser.add_argument("--runs", type=int, default=9, metavar="N", help="runs of each command (default: 9)")
    parser.add_argument("--before", type=Path, metavar="TREE", help="checkout to compare with")
    args = parser.parse_args()
    trees = [tree.resolve() / "src" for tree in (Path(__file__).parents[1], args.before) if tree]
    runs = 1 if args.quick else args.runs
    show(
        {f"flexneedle {command}": summarize(measure_pairs(command, trees, runs)) for command in COMMANDS},
        as_json=args.json,
    )


if __name__ == "__main__":
    if sys.argv[1:2] == ["--stages"]:
        sys.exit(run_timed(Path(sys.argv[2]), sys.argv[3:]))
    main()
