"""Write a study that has the settings of another one and few insertions, to try it in seconds.

    python studies/shorten.py STUDY --out FILE

STUDY is the name of a shipped study. One repeat, the first case, and of each axis the first value; the first two
controllers, since its report compares them, and two worlds. An axis with "all" values stays.
"""

import argparse
from pathlib import Path
from typing import Any

import tomli_w

from flexneedle.lab.study.spec import STUDIES


def shorten(study: dict[str, Any]) -> dict[str, Any]:
    """Return the values of a short study."""
    cases = [{**case, **_first(case, "targets", 1)} for case in study.get("cases", [])[:1]]
    axes = [
        {**axis, **_first(axis, "values", 2 if axis["key"] == "controller" else 1)} for axis in study["axes"]
    ]
    repeats = {"repeats": 1} if "repeats" in study else {}
    return {**study, **repeats, **({"cases": cases} if cases else {}), "axes": axes}


def _first(table: dict[str, Any], key: str, count: int) -> dict[str, Any]:
    match table.get(key):
        case list() as values:
            return {key: values[:count]}
        case dict() as numbers:
            return {key: {**numbers, "count": count + 1}}  # the first world alone may be out of reach
    return {}


def main() -> None:
    """Write the file."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("study", choices=STUDIES.names(), metavar="STUDY")
    parser.add_argument("--out", type=Path, required=True, metavar="FILE")
    args = parser.parse_args()
    args.out.write_text(tomli_w.dumps(shorten(STUDIES.read_shipped(args.study))), encoding="utf-8")


if __name__ == "__main__":
    main()
