"""`--help` of every command ends with two examples that the parser accepts."""

import argparse
import shlex

import pytest

from flexneedle.cli.main import build_parser


def commands(parser, path=()):
    """Yield all subparsers with their command words."""
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for name, below in action.choices.items():
                yield (*path, name), below
                yield from commands(below, (*path, name))


PARSERS = {" ".join(path): parser for path, parser in commands(build_parser())}


def examples_of(parser):
    _before, found, after = parser.format_help().rpartition("\nexamples:\n")
    assert found, "no examples"
    return after.splitlines()


def test_all_commands_exist():
    assert {"plan", "insert", "study", "report", "view", "export", "emulate", "emulate aurora"} < set(PARSERS)
    assert {f"scenario {name}" for name in ("list", "show", "check", "schema")} < set(PARSERS)


@pytest.mark.parametrize("name", PARSERS)
def test_the_help_ends_with_two_examples(name):
    lines = examples_of(PARSERS[name])
    assert len(lines) == 2
    assert all(line.startswith(f"  flexneedle {name} ") or line == f"  flexneedle {name}" for line in lines)


@pytest.mark.parametrize("name", PARSERS)
def test_the_examples_are_accepted(name, capsys):
    for line in examples_of(PARSERS[name]):
        words = shlex.split(line.split(" | ")[0].split(" > ")[0])
        assert callable(build_parser().parse_args(words[1:]).handler), capsys.readouterr().err


@pytest.mark.parametrize("name", PARSERS)
def test_the_help_fits_and_has_no_banned_words(name, monkeypatch):
    monkeypatch.setenv("COLUMNS", "100")
    text = PARSERS[name].format_help()
    assert max(map(len, text.splitlines())) <= 100
    words = " ".join(text.split())
    assert not any(word in words for word in ("tells", "told", "believed", "stands", "goes on"))
