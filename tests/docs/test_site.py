"""The generated pages are up to date, and the site builds without a warning and needs no network."""

import html
import os
import re
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Iterator

import pytest

import case_reference
import command_reference
import flexneedle
import math_fence
import recording_reference
import rig_reference
import rig_states
import scenario_reference
from flexneedle.lab.calibration.importing.map_file import RecordingMap
from flexneedle.lab.rig.preflight.fit import fit_problems
from flexneedle.lab.rig.rig_file import load_rig
from flexneedle.scenario.files import load_scenario
from markdown_examples import ROOT, blocks

DOCS = ROOT / "docs"
API = (DOCS / "reference" / "api.md").read_text(encoding="utf-8")
LISTED = re.findall(r"^::: flexneedle\.(\w+)$", API, re.MULTILINE)
SITE = tomllib.loads((ROOT / "zensical.toml").read_text(encoding="utf-8"))["project"]


def entries(nav: object) -> Iterator[str]:
    """The pages of a navigation; a group is a table with its title, a page has none."""
    for item in nav:
        yield from [item] if isinstance(item, str) else entries(*item.values())


@pytest.mark.parametrize(
    "generator", [scenario_reference, rig_reference, recording_reference, case_reference, command_reference]
)
def test_generated_pages_are_up_to_date(generator):
    assert generator.PAGE.read_text(encoding="utf-8") == generator.page(), "make docs"


def test_the_page_on_safety_has_the_present_table_of_states():
    text = rig_states.PAGE.read_text(encoding="utf-8")
    assert rig_states.page(text) == text, "make docs"


def test_every_section_and_every_key_of_a_rig_has_advice():
    tables = list(rig_reference.all_tables())
    assert set(rig_reference.ADVICE["keys"]) | {"name"} == {
        key.name for table in tables for key in table.keys
    }
    assert all(
        text.endswith(".") and "\n" not in text and len(text) < 200
        for text in rig_reference.ADVICE["keys"].values()
    )
    assert set(rig_reference.ADVICE["sections"]) == {table.name for table in tables if table.name}


def test_the_rig_of_the_reference_can_do_what_the_paper_needs(tmp_path):
    (example,) = [block for block in blocks(rig_reference.PAGE.read_text(encoding="utf-8")) if block.title]
    path = tmp_path / example.title
    path.write_text(example.code, encoding="utf-8")
    assert fit_problems(load_rig(path), load_scenario("phantom")) == []


def test_the_examples_of_maps_are_maps_and_every_key_has_a_description():
    page = recording_reference.PAGE.read_text(encoding="utf-8")
    for block in blocks(page):
        if block.title:
            RecordingMap.model_validate(tomllib.loads(block.code))
    shown = list(scenario_reference.tables(RecordingMap.model_json_schema()))
    assert all(key.schema.get("description") for table in shown for key in table.keys)


def test_every_section_has_advice_and_every_key_a_description():
    tables = list(scenario_reference.tables(scenario_reference.schema()))
    schemas = {key.name: key.schema for table in tables for key in table.keys}
    keys = set(schemas)
    own = {name: schema["choose"] for name, schema in schemas.items() if schema.get("choose")}
    advice = scenario_reference.ADVICE["keys"]
    assert set(advice) <= keys - set(own)
    texts = [*advice.values(), *own.values(), *(schema.get("description", "") for schema in schemas.values())]
    assert [text for text in texts if not text.endswith(".") or len(text) > 250] == []
    assert set(scenario_reference.ADVICE["sections"]) <= {table.name for table in tables}
    assert [table.name for table in tables if table.name and not table.about] == []
    written = {re.sub(r"^tissue\.\d\.", "tissue.", key) for key in load_scenario("phantom").flat()}
    assert written <= keys


@pytest.mark.parametrize(
    ("key", "unit"),
    [
        ("needle.youngs_modulus_gpa", "GPa"),
        ("setup.insertion_speed_mm_s", "mm/s"),
        ("phantom.friction_mn_per_mm", "mN/mm"),
        ("tracker.environment.tilt_mrad_per_mm", "mrad/mm"),
        ("control.ce_mpc.curvature_per_m", "1/m"),
        ("monitor.abort_after_s", "s"),
        ("tissue.alpha", ""),
        ("axes.insertion.counts_per_mm", "counts/mm"),
        ("axes.insertion.acceleration_mm_s2", "mm/s²"),
        ("axes.rotation.speed_deg_s", "°/s"),
        ("loop.queue_ms", "ms"),
    ],
)
def test_the_unit_of_a_key_is_its_ending(key, unit):
    assert scenario_reference.unit(key) == unit


def test_every_public_name_is_in_the_python_reference():
    columns = {name for name in flexneedle.__all__ if isinstance(getattr(flexneedle, name), int)}
    assert sorted(LISTED) == sorted(set(flexneedle.__all__) - columns - {"__version__"})
    assert [name for name in columns if f"`{name}`" not in API] == []


def test_every_page_is_in_the_navigation():
    pages = {str(path.relative_to(DOCS)) for path in DOCS.rglob("*.md")}
    assert sorted(entries(SITE["nav"])) == sorted(pages)


@pytest.mark.parametrize("page", tuple(entries(SITE["nav"])))
def test_a_page_begins_with_its_only_heading_of_the_first_level(page):
    """The navigation shows it, with the number of a decision."""
    text = re.sub(
        r"^```.*?^```", "", (DOCS / page).read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE
    )
    (heading,) = re.findall(r"^# (.+)$", text, re.MULTILINE)
    assert text.startswith(f"# {heading}\n")
    number = re.match(r"decisions/(\d+)", page)
    assert number is None or heading.startswith(f"{number[1]} ")


def test_a_formula_is_drawn_with_its_number():
    drawn = math_fence.svg("a < \\frac{1}{2} \\tag{7}\n", "math", "math")
    assert drawn.startswith('<div class="math" role="img" aria-label="a &lt; \\frac{1}{2}"><svg')
    assert drawn.endswith('</svg><span class="number">(7)</span></div>')


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """The built site, from a copy of its sources."""
    root = tmp_path_factory.mktemp("site")
    for name in ("docs", "src", "tools"):
        shutil.copytree(ROOT / name, root / name, ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copy(ROOT / "zensical.toml", root)
    line = [sys.executable, "-m", "zensical", "build", "--strict", "--clean"]
    paths = os.pathsep.join((str(root / "tools/docs"), str(root / "src")))
    environment = {**os.environ, "PYTHONPATH": paths}
    done = subprocess.run(line, cwd=root, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return root / "site"


@pytest.mark.long
def test_the_site_builds_strictly_and_loads_nothing_from_elsewhere(site):
    pages = {path: path.read_text(encoding="utf-8") for path in site.rglob("*.html")}
    loads = re.compile(
        r'<(?:script|img|iframe|source)[^>]*\ssrc="https?:|<link[^>]*\shref="https?:[^>]*stylesheet'
    )
    styles = [path.read_text(encoding="utf-8") for path in site.rglob("*.css")]
    assert len(pages) > 30
    assert [path.name for path, text in pages.items() if loads.search(text)] == []
    assert [text[:80] for text in styles if re.search(r"url\(['\"]?https?:|@import", text)] == []
    assert [path.name for path, text in pages.items() if "```" in text] == [], "a fence is shown as text"


@pytest.mark.long
def test_the_navigation_shows_the_headings(site):
    page = html.unescape((site / "index.html").read_text(encoding="utf-8"))
    links = re.findall(r'class="md-nav__link[^>]*>\s*<span class="md-ellipsis">\s*([^<]*?)\s*<', page)
    for name in entries(SITE["nav"]):
        heading = (DOCS / name).read_text(encoding="utf-8").split("\n", 1)[0].removeprefix("# ")
        assert heading in links


@pytest.mark.long
def test_formulas_and_signatures_are_on_the_pages(site):
    theory = (site / "theory.html").read_text(encoding="utf-8")
    numbers = re.findall(r'<span class="number">\((\d+)\)</span>', theory)
    assert sorted(map(int, numbers)) == list(range(1, 28))
    api = (site / "reference" / "api.html").read_text(encoding="utf-8")
    assert all(f'id="flexneedle.{name}"' in api for name in LISTED)
