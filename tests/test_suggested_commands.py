"""Every command that a message or a docstring suggests exists, with its options."""

import argparse
import ast
import re
from pathlib import Path

import pytest

import flexneedle
from flexneedle.cli.main import build_parser

SOURCES = sorted(Path(flexneedle.__file__).parent.rglob("*.py"))
_RIG = r"(?=\brig (?:check|home|jog|off|ready|retract|show|test)\b)"
_SUGGESTED = re.compile(rf"(?:\bflexneedle |{_RIG})((?:--)?[a-z][\w-]*(?: [^\s;,()`]+)*)")
_ACTION = re.compile(r"\b(?:jog|home) (?:it|the|base|guide|back)\b|\bbring (?:it|the (?:axis|guide|base))\b")
_PARSER = build_parser()


def texts(path):
    """Yield all texts of a module with their line; values within them are X."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.JoinedStr):
            yield (
                node.lineno,
                "".join(str(one.value) if isinstance(one, ast.Constant) else "X" for one in node.values),
            )
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            yield node.lineno, node.value


def subcommands(parser):
    """Return the subcommands of a parser by name, {} if it has none."""
    found = [one for one in parser._actions if isinstance(one, argparse._SubParsersAction)]
    return found[0].choices if found else {}


def problem_of(words):
    """Return the first word that the parser of `flexneedle` does not know, or ""."""
    parser = _PARSER
    while words and (choices := subcommands(parser)):
        if words[0] not in choices:
            return "" if words[0].startswith(("-", "X")) else words[0]
        parser, words = choices[words[0]], words[1:]
    known = {option for action in parser._actions for option in action.option_strings}
    return next((word for word in words if re.fullmatch(r"--[a-z][a-z-]*", word) and word not in known), "")


def suggestions():
    """Yield place and words of each suggested command."""
    for path in SOURCES:
        for line, text in texts(path):
            for match in _SUGGESTED.finditer(text):
                yield f"{path.name}:{line}: {match[1]}", [word.rstrip(".:'\"") for word in match[1].split()]


def test_every_suggested_command_exists():
    found = list(suggestions())
    assert len(found) > 60
    problems = [(place, problem_of(words)) for place, words in found if words[0] in subcommands(_PARSER)]
    unknown = [f"{place} ({problem})" for place, problem in problems if problem]
    assert unknown == []


def test_a_message_that_asks_for_a_motion_names_its_command():
    lacking = [
        f"{path.name}:{line}: {text}"
        for path in SOURCES
        if "lab" in path.parts
        for line, text in texts(path)
        if _ACTION.search(text) and "\n" not in text and not re.search(r"\brig (?:jog|home|ready)\b", text)
    ]
    assert lacking == []


def test_a_command_for_a_rig_names_it_and_begins_with_the_program():
    lacking = [
        f"{path.name}:{line}: {text}"
        for path in SOURCES
        for line, text in texts(path)
        if re.search(
            r"(?<!flexneedle )\brig (?:check|jog|ready|retract|test) (?:X|RIG)|\brig [a-z]+ RIG\b", text
        )
    ]
    assert lacking == []


_UNIT = r"(?:mm|s|N|%|mrad)?"
_LIMITED = re.compile(
    rf"\{{[^{{}}]+:(\.\d[fg]|g)\}}({_UNIT})[^{{}}]*limit \{{[^{{}}]+:(\.\d[fg]|g)\}}({_UNIT})"
)


def test_a_value_and_its_limit_have_one_format():
    found = [
        (path.name, *match)
        for path in SOURCES
        for match in _LIMITED.findall(path.read_text().replace('"\n', ""))
    ]
    assert len(found) > 6
    assert [each for each in found if each[1] != each[3]] == []


@pytest.mark.parametrize(
    ("words", "unknown"),
    [
        ("rig jog RIG guide_z --to 0mm", ""),
        ("rig jog RIG guide_z --at 0mm", "--at"),
        ("rig bring RIG", "bring"),
    ],
)
def test_an_unknown_word_is_found(words, unknown):
    assert problem_of(words.split()) == unknown
