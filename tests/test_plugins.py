"""Parts of your own: an unsuitable one is rejected with one line."""

import sys
from dataclasses import replace

import pytest

import flexneedle
from flexneedle.cli import main as cli
from flexneedle.control.controllers import CONTROLLERS, find_controller
from flexneedle.errors import InputError
from flexneedle.loop.virtual import Seeds, find_tracker, virtual_rig
from flexneedle.phantom.draw import Truth
from flexneedle.phantom.phantom import Phantom
from flexneedle.phantom.plants import PLANTS, find_plant
from flexneedle.types import STILL
from synthetic import make_plan

PHANTOM = flexneedle.load_scenario("phantom")

LAB = """
from flexneedle import Control, Decision, Controller
from flexneedle.phantom.phantom import Phantom

def decide(task, memory, estimate, rng):
    return Decision(Control(db_x=1.0), "on"), memory

def one(truth):
    return None

def nothing(truth, roll):
    return {}

def blind(scenario, phantom, rng):
    return object()

class Half:
    name = "half"
    decide = staticmethod(decide)

FINE = Controller("fine", "inserts straight", decide=decide)
SAME = Controller("ce-mpc", "has the name of another", decide=decide)
NUMBER = 3
"""


@pytest.fixture
def lab(tmp_path, monkeypatch):
    """The current directory, with modules that define parts."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    before = set(sys.modules)
    texts = {
        "lab_parts": LAB,
        "lab_syntax": "def decide(:\n",
        "lab_needs": "import no_such_thing\n",
        "lab_exits": "raise SystemExit(3)\n",
        "lab_wrong": 'from flexneedle import Controller\nMETHOD = Controller("My PID", "", decide=print)\n',
    }
    for name, text in texts.items():
        (tmp_path / f"{name}.py").write_text(text)
    yield tmp_path
    for name in set(sys.modules) - before:
        if name.startswith("lab_"):
            del sys.modules[name]


@pytest.mark.usefixtures("lab")
def test_parts_are_found_by_name_module_and_object():
    for name, method in CONTROLLERS.items():
        assert find_controller(name) == find_controller(method) == (name, method)
    for name, factory in PLANTS.items():
        assert find_plant(name) == (name, factory)
    assert find_tracker("scenario") == ("scenario", None)
    name, own = find_controller("lab_parts:FINE")
    assert (name, own.name) == ("lab_parts:FINE", "fine")
    assert find_controller(own) == ("fine", own)


@pytest.mark.parametrize(
    ("option", "given", "message"),
    [
        ("controller", "lab_parts", "must be one of adaptive-mpc, "),
        ("controller", "lab_parts:", "must be module:NAME, such as mymodule:MINE"),
        ("controller", ":FINE", "must be module:NAME"),
        ("controller", "lab-parts:FINE", "must be module:NAME"),
        ("controller", "lab_there:FINE", "no module lab_there in "),
        ("controller", "lab_parts.sub:FINE", "no module lab_parts.sub in "),
        ("controller", "lab_parts:FIEN", "lab_parts has no FIEN; public names: decide, "),
        ("controller", "lab_parts:NUMBER", "is an int, not a flexneedle.Controller, missing: "),
        ("controller", "lab_parts:Half", "is the class Half, not a flexneedle.Controller, missing: "),
        ("controller", "lab_syntax:CONTROLLER", "lab_syntax cannot be imported: SyntaxError: "),
        ("controller", "lab_needs:CONTROLLER", "lab_needs cannot be imported: it needs the module "),
        ("controller", "lab_exits:CONTROLLER", "lab_exits cannot be imported: SystemExit: 3"),
        ("controller", "lab_wrong:CONTROLLER", "name = 'My PID': a controller's name must be like"),
        ("controller", "lab_parts:SAME", "two controllers are called ce-mpc"),
        ("phantom", "jelly", "must be one of exact, model, or module:NAME of your own"),
        ("phantom", "lab_parts:NUMBER", "is an int, not a function of (truth, roll)"),
        ("phantom", "lab_parts:one", "must be a function of (truth, roll): too many positional arguments"),
        ("tracker", "eye", "must be one of scenario, or module:NAME of your own"),
        ("tracker", "lab_parts:one", "must be a function of (scenario, phantom, rng): too many"),
    ],
)
def test_an_unsuitable_part_is_an_error_of_one_line(lab, capsys, option, given, message):
    assert cli.main(["insert", f"--{option}", given]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("flexneedle: ")
    assert message in line
    assert not (lab / "runs").exists()


class Flat:
    step = roll = strain_energy = least_stretch = converged = 0

    def __init__(self, _truth, _roll):
        self.tip = (0.0, 0.0)


@pytest.mark.parametrize(
    ("factory", "rule"),
    [
        (lambda *_: {}, "<lambda>: dict is not a plant, missing: step,"),
        (Flat, "Flat: tip must be five numbers"),
    ],
)
def test_a_factory_that_returns_no_plant_is_rejected(factory, rule):
    with pytest.raises(InputError, match=f"phantom = {rule}"):
        Phantom(Truth(PHANTOM), 0.0, factory)


def test_a_factory_that_returns_no_tracker_is_rejected():
    with pytest.raises(InputError, match=r"^tracker = <object .*>: must be an object with read, status"):
        virtual_rig(PHANTOM, 0.0, Seeds.of(0), "model", tracker=lambda *_: object())


@pytest.mark.parametrize("answer", [None, (1, 2), STILL])
def test_a_return_value_that_is_not_a_decision_is_rejected(answer):
    own = replace(CONTROLLERS["open-loop"], name="odd", decide=lambda *_: answer)
    rig = flexneedle.VirtualRig("model")
    with pytest.raises(InputError, match="controller odd: decide must return a Decision and the memory"):
        flexneedle.insert(PHANTOM, make_plan(), controller=own, rig=rig, force=True)
