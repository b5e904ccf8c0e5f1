"""Write docs/reference/commands.md: the help of every command.

python tools/docs/command_reference.py
"""

import argparse
import os
import re
from collections import Counter
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
        every = list(parsers(build_parser()))
        shared = _shared(every)
        sections = [_common(shared), *(_section(parser, shared) for parser in every)]
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


def _arguments(parser: argparse.ArgumentParser) -> list[argparse.Action]:
    commands = argparse._SubParsersAction
    return [each for each in parser._actions if each.dest != "help" and not isinstance(each, commands)]


def _key(action: argparse.Action) -> tuple[str, str]:
    name = action.option_strings[-1] if action.option_strings else action.metavar
    return f"`{name}`", str(action.help)


def _shared(every: list[argparse.ArgumentParser]) -> dict[tuple[str, str], argparse.Action]:
    """Return the arguments that several commands have with the same help."""
    arguments = [(_key(action), action) for parser in every for action in _arguments(parser)]
    found = Counter(key for key, _ in arguments)
    return {key: action for key, action in arguments if found[key] > 1}


def _common(shared: dict[tuple[str, str], argparse.Action]) -> str:
    parser = argparse.ArgumentParser(add_help=False)
    for action in shared.values():
        parser._add_action(action)
    return f"## Common arguments\n\n```text\n{_help(parser)}\n```\n"


def _section(parser: argparse.ArgumentParser, shared: dict[tuple[str, str], argparse.Action]) -> str:
    level = "#" * min(3, 1 + len(parser.prog.split()))
    common = [action for action in _arguments(parser) if _key(action) in shared]
    names = ", ".join(_key(action)[0] for action in common)
    for action in common:
        action.help = argparse.SUPPRESS
    text = _EXAMPLES.sub("", _help(parser)).rstrip()
    parts = [
        f"{level} {parser.prog}",
        f"```text\n{text}\n```" if text else "",
        f"[Common arguments](#common-arguments): {names}" if names else "",
    ]
    return "\n\n".join(filter(None, parts)) + "\n"


def _help(parser: argparse.ArgumentParser) -> str:
    return _NOTHING_ELSE.sub("", _USAGE_AND_HELP.sub("", parser.format_help())).rstrip()


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
