"""Quick modes of make targets: each target that runs scripts has one, and it overwrites no result."""

import re
import sys
from pathlib import Path

import pytest
import tomli_w

import tune
import validation
from flexneedle.lab.study.grid import load_study
from flexneedle.lab.study.spec import STUDIES
from shorten import shorten

ROOT = Path(__file__).resolve().parents[1]
MAKEFILE = (ROOT / "Makefile").read_text(encoding="utf-8")
RECIPES = dict(re.findall(r"^([a-z-]+):.*\n((?:\t.*\n)+)", MAKEFILE, re.MULTILINE))
(SCRIPTS,) = (line.split() for line in re.findall(r"^SCRIPTS := (.*)", MAKEFILE, re.MULTILINE))
OF_SCRIPTS = re.compile(
    r"(benchmarks|campaigns|studies)/\w+\.py|flexneedle insert|\$\(call study|-m slow|tools/docs"
)


def test_every_target_that_runs_scripts_has_a_quick_mode_that_ci_runs():
    assert sorted(SCRIPTS) == sorted(name for name, recipe in RECIPES.items() if OF_SCRIPTS.search(recipe))
    assert "$(SCRIPTS)" in RECIPES["quick"]
    assert re.search(r"^make quick$", (ROOT / ".ci" / "run").read_text(), re.MULTILINE)


@pytest.mark.parametrize("name", SCRIPTS)
def test_every_script_of_a_target_is_quick(name):
    lines = [line for line in RECIPES[name].splitlines() if OF_SCRIPTS.search(line)]
    assert [line for line in lines if not re.search(r"call (quick|study)", line)] == []


@pytest.mark.parametrize("study", STUDIES.names())
def test_a_shortened_study_has_few_insertions_of_the_study(study, tmp_path):
    path = tmp_path / "short.toml"
    full = STUDIES.read_shipped(study)
    path.write_text(tomli_w.dumps(shorten(full)), encoding="utf-8")
    short = load_study(path)
    assert 1 <= len(short) <= 9
    assert short.title == full["title"]
    assert short.insertion(0).seed == full.get("first_seed", 100_000)


@pytest.mark.parametrize(("study", "arguments"), [(tune, ["ce-mpc"]), (validation, [])])
def test_a_quick_run_overwrites_no_result(study, arguments, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["study", *arguments, "--quick"])
    with pytest.raises(SystemExit):
        study.main()
    assert re.search(r"--quick: .* no result: .* with --out", capsys.readouterr().err)
