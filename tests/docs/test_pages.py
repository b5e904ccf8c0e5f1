"""Every example of README.md and docs/ runs, and prints what the page shows."""

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path
from pkgutil import resolve_name

import pytest

from flexneedle.cli.main import build_parser
from markdown_examples import PAGES, ROOT, SHELL, blocks, printed, same
from scenario_reference import schema, tables

# Pages that take more than about 5 s, and the longest pages.
LONG = {"emulate.md", "index.md", "warnings.md"}
SLOW = {
    "calibrate.md",
    "controllers.md",
    "extend.md",
    "needle-and-tissue.md",
    "results.md",
    "slicer.md",
    "studies.md",
    "targets.md",
    "tutorial.md",
}
KEYS = {key.name for table in tables(schema()) for key in table.keys}
TEXTS = {str(path.relative_to(ROOT)): path.read_text(encoding="utf-8") for path in PAGES}
BLOCKS = {name: blocks(text) for name, text in TEXTS.items()}
EXAMPLES = [name for name, found in BLOCKS.items() if any(block.runs for block in found)]


def marked(name: str) -> object:
    page = Path(name).name
    marks = [mark for mark, pages in ((pytest.mark.long, LONG), (pytest.mark.slow, SLOW)) if page in pages]
    return pytest.param(name, marks=marks, id=name)


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """An empty folder, which is the current one, and from which modules are imported."""
    before = set(sys.modules)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setenv("MPLBACKEND", "agg")
    yield tmp_path
    for name in set(sys.modules) - before:
        if str(tmp_path) in str(getattr(sys.modules[name], "__file__", "")):
            del sys.modules[name]


@pytest.mark.parametrize("name", [marked(name) for name in EXAMPLES])
def test_examples_run_and_print_what_the_page_shows(name, folder):
    differences = [
        f"{name}, line {block.line}\n{difference}"
        for block, real in printed(BLOCKS[name], folder)
        if block.output is not None and (difference := same(block.output, real))
    ]
    assert not differences, "\n".join(differences)


def commands() -> list[tuple[str, str]]:
    """All command lines of the pages, indented or in a block, without redirections, comments and pipes."""
    shell = [(name, b.code) for name, found in BLOCKS.items() for b in found if b.language in SHELL]
    indented = [
        (name, line) for name, text in TEXTS.items() for line in re.findall(r"^ {4}\S.*$", text, re.MULTILINE)
    ]
    return [
        (name, re.split(r" [|>&<]| 2>|\s#", line.strip())[0])
        for name, code in (*shell, *indented)
        for line in code.splitlines()
        if line.strip().startswith("flexneedle ")
    ]


def test_every_command_of_the_pages_parses():
    failures = []
    for name, line in commands():
        try:
            build_parser().parse_args(shlex.split(line.replace("…", "x"))[1:])
        except SystemExit as error:
            failures += [f"{name}: {line}"] if error.code else []
    assert len(commands()) > 60
    assert failures == []


def test_scripts_of_the_pages_have_the_options_shown():
    shown = {
        match
        for text in TEXTS.values()
        for match in re.findall(
            r"python ((?:studies|campaigns|benchmarks)/\w+\.py)((?: --?[\w-]+(?: [\w.]+)*)*)", text
        )
    }
    assert len(shown) > 15
    for script, options in shown:
        assert (ROOT / script).is_file(), script
        if options:
            printed = subprocess.run(
                [sys.executable, ROOT / script, "--help"], capture_output=True, text=True
            ).stdout
            assert [one for one in options.split() if one.startswith("-") and one not in printed] == [], (
                script
            )


def test_make_has_every_target_of_the_pages():
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    named = {
        target
        for text in TEXTS.values()
        for target in re.findall(r"(?:^ {4}|`)make ([a-z-]+)", text, re.MULTILINE)
    }
    assert len(named) > 8
    assert named <= targets


def test_the_code_that_the_theory_cites_exists():
    """Names with a dot are keys of scenarios, or modules and functions below `flexneedle`."""
    cited = re.findall(r"`([a-z_]+(?:\.\w+)+)`", TEXTS["docs/theory.md"])
    code = set(cited) - KEYS - {"module.function"}
    assert len(code) > 20
    for name in code:
        resolve_name(f"flexneedle.{name}")


def test_few_blocks_are_not_run_and_each_has_a_reason():
    skipped = [(name, b.skipped) for name, found in BLOCKS.items() for b in found if b.skipped]
    assert {reason for _, reason in skipped} <= {
        "installs into an environment of yours",
        "a scenario with a fibre whose time stamps are late",
        "needs an Aurora",
        "runs until Ctrl-C",
    }
    assert len(skipped) < 14


def test_the_files_that_the_readme_links_exist():
    targets = re.findall(r"\]\((?!https?:)([^)#]+)\)", TEXTS["README.md"])
    assert targets
    assert [target for target in targets if not (ROOT / target).exists()] == []


@pytest.mark.parametrize(
    ("shown", "real"),
    [
        ("error 0.123 mm", "error 0.124 mm"),
        ("a  b", "a b"),
        ("time … s", "time 3.2 s"),
        ("first\n…\nlast", "first\n1\n2\nlast"),
        ("…\nmiddle\n…", "1\nmiddle\n2\n3"),
    ],
)
def test_outputs_agree_up_to_last_digits_spaces_and_ellipses(shown, real):
    assert same(shown, real) == ""


@pytest.mark.parametrize(
    ("shown", "real"),
    [
        ("error 0.123 mm", "error 0.133 mm"),
        ("error 12 mm", "error -12 mm"),
        ("done", "held"),
        ("first", "first\nsecond"),
        ("first\nsecond", "first"),
        ("first\n…\nlast", "first\nlast\nmore"),
    ],
)
def test_outputs_differ_in_a_number_a_word_or_a_line(shown, real):
    assert same(shown, real) != ""


def test_a_block_has_its_file_its_output_or_the_reason_not_to_run():
    page = (
        '```python title="a.py"\nx = 1\n```\n\n```sh\necho 1\n```\n\n```text\n1\n```\n'
        "<!-- no-run: no device -->\n```sh\nread\n```\n\n<!-- run: true -->\n```toml\na = 1\n```\n"
    )
    module, shown, text, skipped, hidden, table = blocks(page)
    assert (module.title, module.runs) == ("a.py", False)
    assert (shown.output, shown.runs, text.runs) == ("1\n", True, False)
    assert (skipped.skipped, skipped.runs) == ("no device", False)
    assert (hidden.code, hidden.runs, table.runs) == ("true\n", True, False)


def test_a_command_that_fails_is_an_error(folder):
    (block,) = blocks("```sh\nfalse\n```\n")
    with pytest.raises(RuntimeError, match="exit status 1"):
        list(printed([block], folder))
    assert os.getcwd() == str(folder)  # noqa: PTH109 - where the page runs
