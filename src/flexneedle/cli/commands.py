"""Parsers of commands: each has a help that ends with example command lines, and a handler or subcommands."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable
from typing import Any, TypeAlias

Commands: TypeAlias = "argparse._SubParsersAction[argparse.ArgumentParser]"
"""The commands of a parser, to which others are added; argparse has no public name for them."""
Handler = Callable[[argparse.Namespace], int]
"""Carries out a command with its arguments; returns the exit status."""


def add_command(
    commands: Commands,
    name: str,
    summary: str,
    handler: Handler,
    *examples: str,
    about: str | None = None,
    notes: str = "",
) -> argparse.ArgumentParser:
    """Add a command, and return its parser without arguments yet.

    summary: its line in the help of the parser above; about: text before its arguments; notes: text after them, before
    the examples.
    """
    parser = commands.add_parser(name, help=summary, **help_texts(*examples, about=about, notes=notes))
    parser.set_defaults(handler=handler)
    return parser


def add_group(
    commands: Commands,
    name: str,
    summary: str,
    adders: Iterable[Callable[[Commands], None]],
    *examples: str,
    title: str = "commands",
) -> None:
    """Add a command with subcommands, which `adders` add to it; title: their plural."""
    parser = commands.add_parser(name, help=summary, **help_texts(*examples))
    inner = parser.add_subparsers(title=title, metavar=title.upper().removesuffix("S"), required=True)
    for add in adders:
        add(inner)


def help_texts(*examples: str, about: str | None = None, notes: str = "") -> dict[str, Any]:
    """Return the options of an `ArgumentParser` for the texts before and after its arguments."""
    end = "\n".join(["examples:", *(f"  {line}" for line in examples)])
    return {"description": about, "epilog": notes + end, "formatter_class": _HelpFormatter}


class _HelpFormatter(argparse.HelpFormatter):
    """Wraps single-line texts and keeps the line breaks of others, such as the examples."""

    def _fill_text(self, text: str, width: int, indent: str) -> str:
        if "\n" not in text:
            return super()._fill_text(text, width, indent)
        return "".join(indent + line for line in text.strip("\n").splitlines(keepends=True))
