"""docs/studies.md agrees with the code."""

import re
import tomllib
from pathlib import Path

import pyarrow.parquet as pq

from flexneedle.control.controllers import CONTROLLERS
from flexneedle.lab.study.grid import load_study
from flexneedle.lab.study.spec import STUDIES
from flexneedle.scenario.files import load_scenario

DOCS_FOLDER = Path(__file__).parents[3] / "docs"
DOCS = (DOCS_FOLDER / "studies.md").read_text()


def test_the_example_study_has_the_expected_size(tmp_path):
    text = re.search(r"```toml\n(.*?)```", DOCS, re.DOTALL)[1]
    path = tmp_path / "friction.toml"
    path.write_text(text)
    assert len(load_study(path)) == 2 * 2 * 3 * len(CONTROLLERS) * 10
    assert tomllib.loads(text)["name"] == "friction"


def test_the_example_of_structural_mismatch_loads():
    text = re.search(r"```toml\n(.*?)```", (DOCS_FOLDER / "worlds.md").read_text(), re.DOTALL)[1]
    structure = tomllib.loads(text)["phantom"]["structure"]
    scenario = load_scenario("phantom").with_values({"phantom.structure": structure})
    assert scenario.phantom.structure.hidden_layer.top_mm == 12.0


def test_every_shipped_study_is_documented():
    table = DOCS.split("## The studies that come")[1].split("##")[0]
    assert sorted(re.findall(r"^\| ?`([a-z-]+)`", table, re.MULTILINE)) == sorted(STUDIES.names())


def test_every_column_is_documented(quick, uninterrupted):
    documented = set(
        re.findall(r"`([a-z_]+)`", DOCS.split("## Files of a study")[1].split("## Interruption")[0])
    )
    scenario = set(load_study(quick).points[0].scenario.flat())
    names = [set(pq.read_schema(uninterrupted / f"{table}.parquet").names) for table in ("runs", "timing")]
    assert set.union(*names) - scenario <= documented


def test_the_example_that_reads_a_table_runs(uninterrupted, capsys):
    (code,) = re.findall(r"```python\n(import pyarrow.*?)```", DOCS, re.DOTALL)
    exec(code.replace("studies/mine", str(uninterrupted)))
    printed = capsys.readouterr().out
    assert "'case': 'bias'" in printed
    assert "'true_error_mm_max': " in printed
