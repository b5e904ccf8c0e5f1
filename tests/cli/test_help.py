"""`--help` of every command ends with two examples that the parser accepts."""

import argparse
import shlex
from importlib.metadata import EntryPoint

import pytest

from flexneedle.cli import main
from flexneedle.cli.main import build_parser


def commands(parser, path=()):
    """Yield all subparsers with their command words."""
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for name, below in action.choices.items():
                yield (*path, name), below
                yield from commands(below, (*path, name))


PARSERS = {
    " ".join(("flexneedle", *path)): parser
    for path, parser in (((), build_parser()), *commands(build_parser()))
}


def examples_of(parser):
    _before, found, after = parser.format_help().rpartition("\nexamples:\n")
    assert found, "no examples"
    return after.splitlines()


def test_a_command_of_a_broken_package_is_reported_and_left_out(capsys, monkeypatch):
    broken = EntryPoint("broken", "no_such_package:add_parser", "flexneedle.commands")
    monkeypatch.setattr(main, "entry_points", lambda **_: [broken])
    assert "usage: flexneedle" in build_parser().format_help()
    assert "no_such_package" in capsys.readouterr().err


def test_all_commands_exist():
    names = {"plan", "insert", "study", "report", "view", "export", "emulate", "emulate aurora"}
    names |= {f"scenario {name}" for name in ("list", "show", "check", "schema")}
    assert {f"flexneedle {name}" for name in names} < set(PARSERS)


@pytest.mark.parametrize("name", PARSERS)
def test_the_help_fits_and_ends_with_two_examples_that_are_accepted(name, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "100")
    assert max(map(len, PARSERS[name].format_help().splitlines())) <= 100
    lines = examples_of(PARSERS[name])
    assert len(lines) == 2
    for line in lines:
        assert f"{line} ".startswith(f"  {name} ")
        words = shlex.split(line.split(" | ")[0].split(" > ")[0])
        assert callable(build_parser().parse_args(words[1:]).handler), capsys.readouterr().err
