"""Code of a study: which custom parts are recorded, and where their files are compared."""

import importlib.machinery
import json
import pickle
import sys
from pathlib import Path

import pytest

import flexneedle
from flexneedle.errors import InputError, RunError, ScenarioWarning
from flexneedle.lab.study import pools
from flexneedle.lab.study.grid import load_study
from flexneedle.lab.study.provenance import StudyCode, compare_modules, find_difference, run_checked
from flexneedle.lab.study.runner import run_study
from flexneedle.record.folder import versions

EXAMPLES = Path(__file__).parents[3] / "docs" / "examples"
STUDY = """
name = "mine"
[values]
plan.samples = 16
plan.iterations = 2
target = [8, 0.5]
setup.tip_to_skin_mm = 4.0
phantom = { step_mm = 1.0, contact_spacing_mm = 2.0, element_mm = 2.0 }
"""
RUNS = f'{STUDY}controller = "mine_pid:MINE"\n'
PID = """
from dataclasses import replace
from flexneedle.control.controllers import CONTROLLERS
import mine_gains
MINE = replace(CONTROLLERS["open-loop"], name="mine")
"""


@pytest.fixture
def here(tmp_path, monkeypatch):
    """The current directory, with a controller that imports a module, and the examples of the documentation."""
    monkeypatch.setattr(sys, "path", [*sys.path, str(EXAMPLES)])
    monkeypatch.chdir(tmp_path)
    before = set(sys.modules)
    (tmp_path / "mine_pid.py").write_text(PID)
    (tmp_path / "mine_gains.py").write_text("GAIN = 1.0\n")
    yield tmp_path
    for name in set(sys.modules) - before:
        if name.startswith("mine_"):
            del sys.modules[name]


def load(text):
    Path("mine.toml").write_text(text)
    return load_study("mine.toml")


LAW = 'without = ["tissue.0.alpha"]\n'
LAW_VALUES = "{ tissue.0.law = 'fung:Fung', tissue.0.exponent = 6.0 }"
TERMS = 'scenario = "terms.toml"\n'
NAMED = [  # settings of a study, modules that it names
    ('[values]\ncontroller = "open-loop"', []),
    ('[values]\ncontroller = "follow_path:CONTROLLER"', ["follow_path"]),
    ('[values]\nplant = "unicycle:Unicycle"\ntracker = "camera:Camera"', ["camera", "unicycle"]),
    ('[[cases]]\nname = "a"\nvalues = { tracker = "camera:Camera" }', ["camera"]),
    ('[[axes]]\nkey = "controller"\nvalues = ["open-loop", "mine_pid:MINE"]', ["mine_pid"]),
    (f"{LAW}values = {LAW_VALUES}", ["fung"]),
    (f'{LAW}[[cases]]\nname = "a"\nvalues = {LAW_VALUES}', ["fung"]),
    ('scenario = "own.toml"', ["fung"]),
    (TERMS, ["tilt"]),
    (
        'scenario = "terms.toml"\nvalues = { plan.terms.0.term = "mine_costs:cost" }',
        ["mine_costs", "tilt"],
    ),
    (
        'scenario = "terms.toml"\n[[axes]]\nkey = "plan.terms.0.term"\nvalues = ["mine_costs:cost"]',
        ["mine_costs", "tilt"],
    ),
    ('scenario = "terms_of_control.toml"', ["tilt"]),
]


@pytest.mark.parametrize(("settings", "modules"), NAMED)
def test_the_modules_of_all_custom_parts_are_recorded(here, settings, modules):
    preset = (Path(flexneedle.__file__).parent / "scenario" / "presets" / "phantom.toml").read_text()
    (here / "own.toml").write_text(preset.replace("alpha = ", 'law = "fung:Fung"\nexponent = ', 1))
    term = 'term = "tilt:largest_slope"\nweight = 1.0'
    (here / "terms.toml").write_text(f"{preset}\n[[plan.terms]]\n{term}")
    (here / "terms_of_control.toml").write_text(f"{preset}\n[[control.adaptive_mpc.terms]]\n{term}")
    (here / "mine_costs.py").write_text("from tilt import largest_slope as cost")
    study = load(f'name = "mine"\n{settings}')
    assert list(study.definition["own"]) == modules
    assert all(f"{name}.py" in files for name, files in study.definition["own"].items())


@pytest.mark.usefixtures("in_threads", "here")
def test_the_record_has_all_files_and_resume_names_the_one_that_has_changed():
    out = run_study(load(RUNS), "out", workers=1)
    recorded = json.loads((out / "study.json").read_text())["study"]["own"]
    assert list(recorded["mine_pid"]) == ["mine_gains.py", "mine_pid.py"]
    Path("mine_gains.py").write_text("GAIN = 2.0\n")
    with pytest.raises(
        InputError, match=r"mine_gains\.py is [0-9a-f]{12} as loaded, [0-9a-f]{12} now: restart"
    ):
        run_study(load(RUNS), "new")
    forget()
    message = (
        r"out: cannot resume: a module has changed since the start of the study: module mine_pid: mine_gains"
    )
    with pytest.raises(InputError, match=message + r"\.py is [0-9a-f]{12} in the folder, [0-9a-f]{12} now$"):
        run_study(load(RUNS), out, resume=True)
    Path("mine_gains.py").write_text("GAIN = 1.0\r\n")
    forget()
    run_study(load(RUNS), out, resume=True)


def forget():
    for name in ("mine_pid", "mine_gains"):
        sys.modules.pop(name, None)


@pytest.mark.usefixtures("in_threads")
def test_a_module_without_source_is_a_note_here_and_refused_on_a_cluster(here):
    suffix = importlib.machinery.EXTENSION_SUFFIXES[0]
    (here / f"mine_fast{suffix}").touch()
    (here / "mine_gains.py").write_text("def later():\n    import mine_fast\n")
    study = load(RUNS)
    with pytest.warns(
        ScenarioWarning, match=r"^module mine_pid: mine_fast\.so has no source; its changes are not"
    ):
        run_study(study, "out")
    with pytest.raises(
        InputError, match=r"mine_fast\.so has no source to compare with the workers': run the study"
    ):
        run_study(study, "other", scheduler="tcp://127.0.0.1:9")


FILES = {"pid.py": "aa", "gains.py": "bb"}
COMPARED = [  # files of a module there and here, difference
    (FILES, FILES, ""),
    ({**FILES, "gains.py": "cc"}, FILES, "module pid: gains.py is cc there, bb here"),
    ({"pid.py": "aa"}, FILES, "module pid: gains.py is missing there, bb here"),
    ({**FILES, "more.py": "dd"}, FILES, "module pid: more.py is dd there, missing here"),
    ({**FILES, "gains.py": ""}, FILES, "module pid: gains.py is without source there, bb here"),
    ({}, FILES, "module pid: pid.py is missing there, aa here"),
]


@pytest.mark.parametrize(("there", "here", "difference"), COMPARED)
def test_the_first_file_that_differs_is_named(there, here, difference):
    assert compare_modules({"pid": there}, {"pid": here}, "there", "here") == difference


def test_a_process_without_the_module_differs():
    code = StudyCode(versions(), {"mine_none": {"mine_none.py": "aa"}})
    assert find_difference(code).startswith("module mine_none: mine_none.py is missing there, aa here: give")
    assert find_difference(StudyCode(versions(), {})) == ""


class Cluster:
    """Answers of workers, by address."""

    def __init__(self, answers):
        self.answers = answers

    def run(self, _function, _code, on_error):
        assert on_error == "return"
        return self.answers


@pytest.mark.parametrize(
    ("answers", "message"),
    [
        ({"tcp://a:1": "", "tcp://b:2": "x"}, "^worker tcp://b:2: x$"),
        ({"tcp://a:1": "x", "tcp://b:2": "", "tcp://c:3": "y"}, r"^worker tcp://a:1: x \(2 of 3 workers\)$"),
        (
            {"tcp://a:1": ImportError("no flexneedle")},
            r"^worker tcp://a:1: its flexneedle cannot be compared \(ImportError: no flexneedle\): give the worker",
        ),
    ],
)
def test_the_first_worker_that_differs_is_refused(answers, message):
    with pytest.raises(InputError, match=message):
        pools._check_workers(Cluster(answers), StudyCode({}, {}))
    assert pools._check_workers(Cluster({"tcp://a:1": ""}), StudyCode({}, {})) is None


@pytest.mark.usefixtures("here")
def test_an_argument_is_not_unpickled_in_a_process_with_other_code():
    """Unpickling would load the module."""
    code = StudyCode(versions(), {"mine_pid": {"mine_pid.py": "aa"}})
    with pytest.raises(RunError, match=r"^worker process [0-9]+: module mine_pid: mine_gains\.py is "):
        run_checked(code, str, b"not a pickle")
    assert "mine_pid" not in sys.modules
    assert run_checked(StudyCode(versions(), {}), str, pickle.dumps(3)) == "3"
