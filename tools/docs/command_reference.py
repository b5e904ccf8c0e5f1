"""Write docs/reference/commands.md: the help of every command.

python tools/docs/command_reference.py
"""

import argparse
import os
import re
from collections.abc import Iterator
from pathlib import Path

from flexneedle.cli.main import build_parser

PAGE = Path(__file__).parents[2] / "docs" / "reference" / "commands.md"
INTRODUCTION = """# Commands

Results are written to stdout, progress and messages to stderr. The exit status is 0 on success, 1 after a failure or an
insertion that ended more than 1 mm from its target, 2 for bad input and 130 after Ctrl-C. `--help` adds the usage and
examples of a command; this page is generated from it (`make docs`).
"""
_COLUMNS = "90"
_USAGE_AND_HELP = re.compile(r"\Ausage: .*?\n\n|^  -h, --help [^\n]*\n", re.MULTILINE | re.DOTALL)
_NOTHING_ELSE = re.compile(r"^options:\n\n", re.MULTILINE)
_EXAMPLES = re.compile(r"^examples:\n.*", re.MULTILINE | re.DOTALL)


def page() -> str:
    """Return the page, Markdown."""
    before = os.environ.get("COLUMNS")
    os.environ["COLUMNS"] = _COLUMNS
    try:
        sections = [_section(parser) for parser in parsers(build_parser())]
    finally:
        os.environ.pop("COLUMNS")
        os.environ |= {} if before is None else {"COLUMNS": before}
    return "\n".join([INTRODUCTION, *sections])


def parsers(parser: argparse.ArgumentParser) -> Iterator[argparse.ArgumentParser]:
    """Yield a parser and the parsers of its commands, in the order of the help."""
    yield parser
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for inner in action.choices.values():
                yield from parsers(inner)


def _section(parser: argparse.ArgumentParser) -> str:
    level = "#" * min(3, 1 + len(parser.prog.split()))
    text = _NOTHING_ELSE.sub("", _USAGE_AND_HELP.sub("", parser.format_help()))
    text = _EXAMPLES.sub("", text).rstrip()
    return f"{level} {parser.prog}\n" + (f"\n```text\n{text}\n```\n" if text else "")


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
