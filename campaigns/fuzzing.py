"""Shared parts of the fuzzing campaigns: arguments, limits, progress and reports of failures.

A part of a study is a generator: from randomness it makes one input after another, tries it, and yields a note on all
inputs. It has no end, and raises `Failure` if a rule does not hold. Parts with the same seed try the same inputs.
"""

import argparse
import math
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing
from random import Random
from time import monotonic

PROGRESS_S = 10.0
ODD = (0.0, -0.0, 1.0, -1.0, 5e-324, -2e-308, 9999.9, 1e4, 3.4e38, 1e39, 1e308, math.inf, -math.inf, math.nan)
"""Numbers that a device should not send, or at the limits of a format."""

Part = Callable[[Random], Iterator[str]]


class Failure(Exception):
    """A rule that does not hold, with the input."""


def main(description: str | None, parts: Mapping[str, Part]) -> int:
    """Run the parts that the command line chooses, and print; return the exit status: 1 after a failure."""
    parser = argparse.ArgumentParser(
        description=description, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--inputs", type=int, default=1_000_000, metavar="N")
    parser.add_argument("--seconds", type=float, default=600.0, metavar="S")
    parser.add_argument("--seed", type=int, default=0, metavar="N")
    parser.add_argument("--part", choices=parts)
    args = parser.parse_args()
    try:
        for name in [args.part] if args.part else parts:
            begun = monotonic()
            done, note = run(parts[name], args.inputs, args.seconds, args.seed)
            print(f"{name}: {done} inputs in {monotonic() - begun:.0f} s{note}", flush=True)
    except Failure as failure:
        print(f"{name}: {failure}")
        return 1
    except KeyboardInterrupt:
        return 130
    return 0


def run(part: Part, inputs: int, seconds: float, seed: int) -> tuple[int, str]:
    """Try inputs until one of both limits is reached; return their number and the last note. Raises Failure."""
    begun = shown = monotonic()
    done, note = 0, ""
    with closing(part(Random(seed))) as tried:
        try:
            for done, note in enumerate(tried, 1):
                now = monotonic()
                if done == inputs or now - begun >= seconds:
                    break
                if now - shown >= PROGRESS_S:
                    shown = now
                    print(f"{done} inputs, {now - begun:.0f} s{note}", file=sys.stderr, flush=True)
        except Failure as failure:
            raise Failure(f"seed {seed}, input {done + 1}: {failure}") from failure
    return done, note


def mutate(random: Random, data: bytes, likely: bytes) -> bytes:
    """Return data with up to three changes: bytes replaced, removed, repeated or added; or only `likely` bytes."""
    if random.random() < 0.1:
        return bytes(random.choices(likely, k=random.randint(0, 40)))
    found = bytearray(data)
    for _ in range(random.randint(0, 3)):
        at = random.randint(0, len(found))
        match random.randrange(5):
            case 0:
                found[at : at + 1] = random.randbytes(1)
            case 1:
                found[at : at + 1] = bytes([random.choice(likely)])
            case 2:
                del found[at : at + random.randint(1, 8)]
            case 3:
                found[at:at] = found[: random.randint(0, len(found))]
            case _:
                found[at:at] = bytes([random.choice(likely)])
    return bytes(found)
