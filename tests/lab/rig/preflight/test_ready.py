"""The way to the start of a scenario: back, across, forward in two parts; never with the needle in tissue."""

import math

import pytest

from flexneedle import load_scenario
from flexneedle.errors import InputError, RigError
from flexneedle.lab.rig.preflight.ready import check_advance, plan_way_to_start
from flexneedle.lab.rig.rig_file import load_rig

RIG, PLANE = load_rig("emulated"), load_scenario("phantom")  # the tip starts 28.5 mm before the skin
AT = {"insertion": 40.0, "rotation": 0.0, "guide_y": 0.0, "guide_z": 0.0}


def way(tip, **positions):
    """Return the goals of the motions, in their order."""
    found = plan_way_to_start(RIG, PLANE, {**AT, **positions}, tip)
    return [(move.name, round(move.goal, 9)) for move in found.moves]


@pytest.mark.parametrize(
    ("tip", "positions", "expected"),
    [
        ((-28.5, 0.0, 0.0), {}, []),
        ((-10.0, 0.0, 0.0), {}, [("insertion", 21.5)]),
        ((-38.5, 0.0, 0.0), {}, [("insertion", 45.0), ("insertion", 50.0)]),
        ((-28.5, 1.0, 0.0), {"guide_z": 1.5, "guide_y": -2.0}, [("guide_y", 0.0), ("guide_z", 0.0)]),
        (
            (-20.0, 0.0, 0.0),
            {"rotation": math.pi, "guide_z": 1.5},
            [("insertion", 31.5), ("rotation", 0.0), ("guide_z", 0.0)],
        ),
        (
            (-30.5, 0.0, 0.0),
            {"guide_y": -2.0},
            [("guide_y", 0.0), ("insertion", 41.0), ("insertion", 42.0)],
        ),
        ((-27.0, 0.0, 0.0), {"insertion": 0.0}, []),  # the start is not known better than 3 mm
        ((-27.0, 0.0, 0.0), {"insertion": 1.0}, [("insertion", 0.0)]),
        ((-28.0, 0.0, 0.0), {"insertion": -1.0}, [("insertion", -0.5), ("insertion", 0.0)]),
    ],
)
def test_the_insertion_goes_back_first_and_forward_last(tip, positions, expected):
    assert way(tip, **positions) == expected


@pytest.mark.parametrize(
    ("tip", "line"),
    [
        ((12.3, 0.0, 0.0), r"tip: 12\.3 mm deep: .*flexneedle rig retract emulated"),
        ((-1.0, 0.0, 0.0), r"tip: 1\.0 mm before the skin: must be 3 mm or more"),
        (None, "tip: not measured"),
    ],
)
def test_a_needle_in_tissue_or_not_measured_is_not_moved(tip, line):
    with pytest.raises(RigError, match=line):
        way(tip, guide_y=2.0)


def test_a_start_beyond_the_soft_limits_is_refused():
    with pytest.raises(InputError, match=r"insertion to -17\.5 mm: beyond the soft limits"):
        way((-10.0, 0.0, 0.0), insertion=1.0)


@pytest.mark.parametrize(
    ("moved", "right"), [(4.9, True), (5.9, True), (10.0, False), (-5.0, False), (0.0, False)]
)
def test_an_axis_that_does_not_move_as_far_as_commanded_goes_no_further(moved, right):
    move = plan_way_to_start(RIG, PLANE, AT, (-38.5, 0.0, 0.0)).forward[0]  # by 5 mm
    before, after = (-38.5, 0.0, 0.0), (-38.5 + moved, 0.0, 0.0)
    if right:
        assert check_advance(RIG, PLANE, move, before, after) == after
        return
    with pytest.raises(RigError, match=r"tip: moved .* must be 5\.00 mm .* flexneedle rig test emulated"):
        check_advance(RIG, PLANE, move, before, after)
