"""`--help` of every command ends with two examples that the parser accepts."""

import argparse
import re
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


PARSERS = {
    " ".join(("flexneedle", *path)): parser
    for path, parser in (((), build_parser()), *commands(build_parser()))
}
BANNED = (
    *("tells", "told", "said", "says", "learnt", "believed", "belief", "sees", "looks", "sight"),
    *("stands", "lies", "goes on", "in turn", "aside", "lateral place", "the way", "sought again"),
    *("as it was meant", "if it is meant", "who steers", "so long", "so far", "that many"),
    *("turn of the bevel", "turned over", "held for the tracker"),
)


def examples_of(parser):
    _before, found, after = parser.format_help().rpartition("\nexamples:\n")
    assert found, "no examples"
    return after.splitlines()


def test_all_commands_exist():
    names = {"plan", "insert", "study", "report", "view", "export", "emulate", "emulate aurora"}
    names |= {f"scenario {name}" for name in ("list", "show", "check", "schema")}
    assert {f"flexneedle {name}" for name in names} < set(PARSERS)


@pytest.mark.parametrize("name", PARSERS)
def test_the_help_ends_with_two_examples(name):
    lines = examples_of(PARSERS[name])
    assert len(lines) == 2
    assert all(f"{line} ".startswith(f"  {name} ") for line in lines)


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
    words = " ".join(text.split()).lower()
    assert [word for word in BANNED if re.search(rf"\b{word}\b", words)] == []
