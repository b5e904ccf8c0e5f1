"""The keys of a period's row that the scripts of the page use are keys of the rows that the worker sends."""

import re
from pathlib import Path

import pytest

import flexneedle.lab.page
from flexneedle.lab.page.worker.recordings import row_of
from recorded_page import row
from synthetic import make_insertion

STATIC = Path(flexneedle.lab.page.__file__).parent / "static"
SCRIPTS = {
    path.relative_to(STATIC).as_posix(): path.read_text()
    for path in STATIC.rglob("*.js")
    if "vendor" not in path.parts
}
ROW = r"(?:\brow|\brows\[[^\]]*\]|\brows\.at\([^)]*\)|`rows [^`]*`\)(?:\?\.)?\[[^\]]*\])"
MEMBER = re.compile(ROW + r"\??\.(\w+)")
PATH = re.compile(r'\bpathOfRows\(\w+, "(\w+)"\)')
OF_ROWS = re.compile(r"\brows\.\w+\(\(\{([^}]*)\}\) =>")
PARAMETER = re.compile(r"\(\{([^}]*)\}\) (?:=>|\{)")
DESTRUCTURED = {"plots.js", "insertion/decisions.js"}
"""Scripts in which each object that a function takes apart is a row."""


def keys_in(name, text):
    """Yield the keys of rows that a script uses."""
    yield from MEMBER.findall(text)
    yield from PATH.findall(text)
    for names in (PARAMETER if name in DESTRUCTURED else OF_ROWS).findall(text):
        yield from re.findall(r"(\w+)(?:: \w+)?", names)


@pytest.fixture(scope="module")
def sent():
    """The keys of a row that the worker sends."""
    made = make_insertion()
    return set(row_of(made.periods[0], made.plan))


def test_the_scripts_use_keys_of_rows_only(sent):
    used = {(name, key) for name, text in SCRIPTS.items() for key in keys_in(name, text)}
    assert {one for one in used if one[1] not in sent} == set()
    assert {key for _, key in used} == sent  # so that each way of naming a key is found


def test_the_rows_of_the_browser_tests_have_the_same_keys(sent):
    assert set(row(0)) == sent
