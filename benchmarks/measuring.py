"""Parts of several benchmarks: options, printed figures, processes, and processor time that the host has taken."""

import argparse
import json
import subprocess
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
import psutil

LOOPBACK = (
    '<CycloneDDS><Domain><General><Interfaces><NetworkInterface name="lo"/></Interfaces>'
    "<AllowMulticast>false</AllowMulticast></General><Discovery><ParticipantIndex>auto</ParticipantIndex>"
    '<Peers><Peer Address="localhost"/></Peers></Discovery></Domain></CycloneDDS>'
)
"""Settings of Cyclone DDS that keep it on the loopback interface."""


def parser_of(description: str | None) -> argparse.ArgumentParser:
    """Return a parser with the option `--json`."""
    parser = argparse.ArgumentParser(
        description=description, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    return parser


def show(found: Mapping[str, Any], *, as_json: bool) -> None:
    """Print figures by name, groups of figures below their title; as_json: as one JSON object."""
    if as_json:
        print(json.dumps(found))
        return
    for name, value in found.items():
        group = isinstance(value, Mapping)
        lines = [f"  {key}: {_rounded(each)}" for key, each in value.items()] if group else []
        print(name if group else f"{name}: {_rounded(value)}", *lines, sep="\n")


def _rounded(value: Any) -> str:
    if isinstance(value, list):
        return ", ".join(map(_rounded, value))
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def quantiles(name: str, seconds: Sequence[float]) -> dict[str, float]:
    """Return median, 99 % quantile and maximum (ms) of times (s)."""
    values = 1e3 * np.percentile(seconds, (50, 99, 100))
    kinds = zip(("median", "99 %", "largest"), values.tolist(), strict=True)
    return {f"{name}, {kind}, ms": round(value, 3) for kind, value in kinds}


def steal() -> float:
    """Return the processor time (s) that the host of a virtual machine has taken until now."""
    return float(getattr(psutil.cpu_times(), "steal", 0.0))


@contextmanager
def running(*command: Any) -> Iterator[tuple["subprocess.Popen[str]", str]]:
    """Run a process; yield it with the first line that it prints. It ends with the block."""
    pipe = subprocess.PIPE
    with subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True) as process:
        try:
            yield process, process.stdout.readline().strip() if process.stdout else ""
        finally:
            process.terminate()  # SIGINT is ignored in a background process of a shell
