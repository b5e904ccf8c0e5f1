"""Received registrations, targets and entries in scenarios with a vessel whose place in RAS is known."""

from dataclasses import replace

import numpy as np
import pytest

import flexneedle
from flexneedle.errors import InputError, ScenarioError
from flexneedle.geometry.quaternion import from_vector, to_matrix
from flexneedle.lab.igtl.placement import Placement, Placer, distance_between
from flexneedle.lab.igtl.records import PeerGeometry
from flexneedle.lab.images.case_import import import_case
from flexneedle.lab.images.frames import ImageRegistration, registration_of
from flexneedle.lab.images.markups import read_markups
from flexneedle.lab.images.slicer_scene import write_scene
from flexneedle.scenario.files import load_scenario
from flexneedle.simulator.zones import zones_of
from igtl_messages import MATRIX
from lab.images.image_cases import ORIGIN, TURN, VESSEL, to_ras, write_case

EXACT = 1e-6
IMAGE = ImageRegistration.of_matrix(MATRIX)
VOXEL_DIAGONAL_MM = 3.0**0.5
SMALL = {"plan.samples": 32, "plan.iterations": 3, "plan.max_iterations": 3}


@pytest.fixture(scope="module")
def case(tmp_path_factory):
    """The scenario of a case, with a vessel in a file."""
    return import_case(write_case(tmp_path_factory.mktemp("case"))).scenario.with_values(SMALL)


@pytest.fixture(scope="module")
def unplaced(case):
    """The same scenario without [image]."""
    values = case.values()
    del values["image"]
    return type(case).from_values(values)


def place(scenario, received, entry_radius=np.inf):
    return Placer(entry_radius).place(scenario, received)


def sent_path(registration=None):
    """Target and entry of 32 bits, in RAS, as a peer sends them."""
    target, entry = (
        tuple(np.float32(to_ras(at)).astype(float).tolist()) for at in ((44.0, 2.0, 1.0), (0.5, 1.0, -2.0))
    )
    return PeerGeometry("peer", registration, target, entry)


def turned_frame(shift):
    """Map of RAS to the layers' frame, turned about the axis and shifted across."""
    about = to_matrix(from_vector(np.array([0.7, 0.0, 0.0])))
    matrix = np.eye(4)
    matrix[:3, :3] = about @ TURN.T
    matrix[:3, 3] = matrix[:3, :3] @ -ORIGIN + [0.0, shift, 0.0]
    return ImageRegistration.of_matrix(np.float32(matrix).astype(float))


def exported(scenario, folder):
    """Entry and target of a plan, in RAS, as 3D Slicer gets them."""
    plan = flexneedle.plan(scenario, threads=1)
    write_scene({"manipulation": plan}, folder)
    (points,) = read_markups(folder / "entry-and-target.mrk.json")
    return plan, points.positions


@pytest.mark.parametrize("shift", [0.0, 9.0])
def test_a_received_registration_places_zones_plan_and_files_as_the_points(unplaced, tmp_path, shift):
    sent = sent_path(turned_frame(shift))
    free = unplaced.with_values({"entry.free_radius_mm": 0.0})
    placed = place(free, sent)
    assert placed.lines[:2] == (
        "[image] of the scenario: the received registration, with sd 0, so nothing is added to margins",
        "zones in files are placed by it: vessel",
    )
    scenario = free.with_values(placed.values)
    plan, (entry, target) = exported(scenario, tmp_path)
    np.testing.assert_allclose(target, sent.target, atol=EXACT)
    depth = (np.array(sent.entry) - ORIGIN) @ TURN[:, 0]
    np.testing.assert_allclose(entry, sent.entry - depth * TURN[:, 0], atol=2e-5)  # the matrix has 32 bits
    around = to_ras(VESSEL[0]) + np.random.default_rng(1).normal(0.0, 3.0, (500, 3))
    true = np.linalg.norm(around - to_ras(VESSEL[0]), axis=1) - VESSEL[1]
    (found,) = zones_of(scenario).distances(registration_of(scenario).apply(around))
    assert np.abs(found - true)[np.abs(true) < 3.0].max() < VOXEL_DIAGONAL_MM
    bodies = plan.shapes[plan.shapes[..., 0] > 0.0][:, :3]
    body = registration_of(scenario).inverse().apply(bodies)
    clearance = np.linalg.norm(body - to_ras(VESSEL[0]), axis=1).min() - VESSEL[1]
    assert (
        0.0
        < clearance - 0.5 * scenario.needle.outer_diameter - plan.least_clearance_mm
        < 2.0 * VOXEL_DIAGONAL_MM
    )


def test_another_registration_than_the_scenarios_is_refused_and_points_are_placed_by_the_scenarios(
    case, tmp_path
):
    other = turned_frame(9.0)
    with pytest.raises(
        InputError, match=r"differs from \[image\] of the scenario by up to .* \[image\] is kept"
    ):
        place(case, PeerGeometry("peer", other))
    sent = sent_path(other)
    placed = place(case, sent)
    assert not any(key.startswith("image") for key in placed.values)
    scenario = case.with_values(placed.values)
    assert scenario.image == case.image
    _, (_, target) = exported(scenario, tmp_path)
    np.testing.assert_allclose(target, sent.target, atol=EXACT)


def test_a_registration_with_32_bits_of_the_scenarios_is_the_scenarios(case):
    own = registration_of(case)
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = own.rigid.rotation, own.rigid.translation
    rounded = ImageRegistration.of_matrix(matrix.astype(np.float32).astype(float))
    assert place(case, PeerGeometry("peer", rounded)).values == {}


@pytest.mark.parametrize(("off", "same"), [(0.099, True), (0.101, False)])
def test_registrations_are_compared_in_millimetres(case, off, same):
    own = registration_of(case)
    x, y, z = own.translation
    moved = replace(own, translation=(x, y + off, z))
    assert distance_between(own, moved) == pytest.approx(off, abs=1e-9)
    if same:
        place(case, PeerGeometry("peer", moved))
    else:
        with pytest.raises(InputError):
            place(case, PeerGeometry("peer", moved))


def test_a_turn_is_measured_at_the_farthest_corner():
    turned = ImageRegistration((np.cos(5e-4), np.sin(5e-4), 0.0, 0.0), (0.0, 0.0, 0.0))  # 1 mrad about x
    assert distance_between(ImageRegistration(), turned) == pytest.approx(0.1 * 2.0**0.5, rel=1e-5)


def test_what_an_import_checks_is_named_with_its_size_and_an_entry_beyond_its_skin_is_refused(case):
    own = registration_of(case)
    entry, target = own.inverse().apply(np.array([[-1.25, 3.0, 4.0], [40.0, 3.0, 11.0]])).tolist()
    *_, depth, doubt = place(case, PeerGeometry("peer", None, tuple(target), tuple(entry)), 16.0).lines
    assert depth == "entry: 1.2 mm above the skin, taken on it"
    assert "5.0 mm from this entry, at 9.9 degrees to the line" in doubt  # atan 7/40
    with pytest.raises(InputError, match=r"5\.0 mm from the entry of the case: .*free_radius_mm \(4\.9 mm\)"):
        place(case, PeerGeometry("peer", None, tuple(target), tuple(entry)), 14.9)


def test_points_that_cannot_be_are_refused():
    scenario = load_scenario("phantom")
    with pytest.raises(InputError, match="farther than 10 m"):
        place(scenario, PeerGeometry("peer", None, (2e4, 0.0, 0.0)))
    with pytest.raises(InputError, match="within 5 mm of the skin"):
        place(scenario, PeerGeometry("peer", None, (30.0, 0.0, 0.0), (5.1, 0.0, 0.0)))
    with pytest.raises(ScenarioError):
        scenario.with_values(place(scenario, PeerGeometry("peer", IMAGE, (30.0, 0.0, 0.0))).values)


def test_an_entry_is_judged_when_it_arrives_and_counts_for_the_targets_after_it(case):
    """A refused entry, or one by an earlier registration, does not count."""
    placer, space = Placer(), load_scenario("phantom3d")
    entry, target = {"entry": (0.0, 2.0, 1.0)}, {"target": (30.0, 1.0, 0.0)}

    def sent(registration=None, to=space, **points):
        return placer.place(to, PeerGeometry("peer", registration, **points))

    assert sent(**entry) == Placement({}, ("entry 0, 2, 1 mm, for the next target",))
    assert sent(**entry) == Placement({}, ())
    for _ in range(2):
        placed = sent(**target)
        assert placed.values["entry.lateral_mm"] == 2.0
        assert placed.lines == ("target 30, 1, 0 mm, entry received before 0, 2, 1 mm",)
    assert "entry received before: dropped" in sent(IMAGE).lines[0]
    assert "entry.lateral_mm" not in sent(IMAGE, **target).values
    assert sent(**entry, **target) == sent(**entry, **target)
    with pytest.raises(InputError, match="within 5 mm of the skin"):
        sent(entry=(9.0, 0.0, 0.0))
    assert "entry.lateral_mm" not in sent(**target).values
    with pytest.raises(InputError, match="z must be 0"):
        sent(to=load_scenario("phantom"), **entry)
    skin = tuple(registration_of(case).inverse().apply(np.array([0.0, 1.0, 0.0])).tolist())
    sent(to=case, entry=skin)  # points are by the scenario's registration
    with pytest.raises(InputError):
        sent(turned_frame(9.0), to=case)
    assert sent(IMAGE, to=case, target=tuple(to_ras((44.0, 2.0, 1.0)))).values[
        "entry.lateral_mm"
    ] == pytest.approx(1.0)


def test_layers_are_said_not_to_be_fitted_again_only_with_a_case(case):
    aimed = PeerGeometry("peer", None, tuple(to_ras((44.0, 2.0, 1.0))))
    assert [
        "fitted around the axis" in " ".join(place(case, aimed, radius).lines) for radius in (np.inf, 15.0)
    ] == [
        False,
        True,
    ]


def test_rounding_of_32_bits_leaves_a_point_in_the_plane():
    c, s = np.cos(0.3), np.sin(0.3)
    turned = np.array([[c, -s, 0, 1], [s, c, 0, 2], [0, 0, 1, 300], [0, 0, 0, 1]])
    registration = ImageRegistration.of_matrix(turned.astype(np.float32).astype(float))
    point = (np.linalg.inv(turned) @ [40.0, 5.0, 0.0, 1.0])[:3]
    sent = PeerGeometry("peer", registration, tuple(point.astype(np.float32).astype(float).tolist()))
    scenario = load_scenario("phantom")
    placed = scenario.with_values(place(scenario, sent).values)
    assert placed.target.lateral_z_mm == 0.0
    np.testing.assert_allclose(placed.target.position, (40.0, 5.0, 0.0), atol=1e-4)
