"""Messages of an insertion: positions against matrices written out here, ages, and what a STATUS reports."""

from dataclasses import replace

import numpy as np
import pytest

import flexneedle
from flexneedle.lab.igtl.codec import pack
from flexneedle.lab.igtl.composer import IgtlComposer, turn_from_x
from flexneedle.lab.igtl.records import InsertionResult
from flexneedle.lab.images.frames import ImageRegistration
from flexneedle.lab.link.records import LinkState
from flexneedle.types import Pose, Verdict, VerdictKind
from igtl_messages import MATRIX
from synthetic import make_periods, make_plan

PLAN = make_plan()
PERIOD = next(iter(make_periods(PLAN)))
IMAGE = ImageRegistration.of_matrix(MATRIX)


def composed(*records, registration=None, now=0.0):
    made, found = IgtlComposer(1000.0, registration), {}
    for record in records:
        found |= {message.name: message for message in made.compose(record, now)}
    for message in found.values():
        pack(message)  # fits its fields
    return made, found


def homogeneous(points):
    return np.column_stack([points, np.ones(len(points))])


@pytest.mark.parametrize("registration", [None, IMAGE])
def test_geometry_is_in_the_image_if_it_is_registered(registration):
    to_peer = np.eye(4) if registration is None else np.linalg.inv(MATRIX)
    _, found = composed(PLAN, PERIOD, registration=registration)
    shape = homogeneous(PERIOD.shape[:, :3]) @ to_peer.T
    np.testing.assert_allclose(found["Needle"].points, shape[:, :3], atol=1e-9)
    np.testing.assert_allclose(
        [one.position for one in found["NeedlePoints"].points], shape[:, :3], atol=1e-9
    )
    (path,) = found["NeedlePath"].trajectories
    ends = homogeneous(np.array([(0.0, 0.0, 0.0), PLAN.target])) @ to_peer.T
    np.testing.assert_allclose([path.entry, path.target], ends[:, :3], atol=1e-9)
    tip = np.array(found["NeedleTip"].matrix)
    np.testing.assert_allclose(tip[:3, 3], (to_peer @ [*PERIOD.estimate.point, 1.0])[:3], atol=1e-9)
    np.testing.assert_allclose(tip[:3, 0], to_peer[:3, :3] @ PERIOD.estimate.axis, atol=1e-9)
    np.testing.assert_allclose(tip[:3, :3].T @ tip[:3, :3], np.eye(3), atol=1e-9)
    assert found["NeedleTip"].time == 1000.0 + PERIOD.time


def test_the_guide_is_at_its_place_if_there_is_one():
    scenario = flexneedle.load_scenario("phantom")
    guided = replace(PERIOD, guide=(1.5, 0.0))
    _, found = composed(replace(PLAN, scenario=scenario), guided)
    np.testing.assert_allclose(
        np.array(found["NeedleGuide"].matrix)[:3, 3], (scenario.setup.guide_x, 1.5, 0.0)
    )
    _, found = composed(replace(PLAN, scenario=None), guided)
    assert "NeedleGuide" not in found


def test_an_entry_to_the_side_is_the_entry_of_the_path():
    values = {"entry.lateral_mm": 2.0, "entry.slope_mrad": 50.0}
    plan = replace(PLAN, scenario=flexneedle.load_scenario("phantom").with_values(values))
    _, found = composed(plan)
    assert found["NeedlePath"].trajectories[0].entry == (0.0, 2.0, 0.0)


def test_the_age_of_the_newest_accepted_reading_grows_while_nothing_is_published():
    at = PERIOD.time - 0.05
    good = replace(PERIOD, measurement=replace(PERIOD.measurement, time=at), verdict=Verdict())
    made, found = composed(LinkState(0.0, "planning"), now=7.0)
    assert (found["NeedleStatus"].subcode, found["NeedleStatus"].error) == (-1, "planning")
    assert list(made.compose(good, 10.0))[-1].subcode == 50
    assert made.make_status(12.0).subcode == 2050
    later = replace(PERIOD, time=PERIOD.time + 0.2, verdict=Verdict(VerdictKind.STALE, "old"))
    assert list(made.compose(later, 12.0))[-1].subcode == 250  # its reading was rejected
    made.begin(None)
    assert made.make_status(13.0).subcode == -1


def test_a_status_has_state_reason_and_frame():
    state = LinkState(3.0, "holding", "reading rejected", good=False)
    made, found = composed(state, now=7.0)
    status = found["NeedleStatus"]
    assert (status.code, status.error, status.time) == (2, "holding", 1003.0)
    assert status.text == "holding: reading rejected; no reading yet; in the needle's frame: no registration"
    assert made.make_status(9.0).time == 1005.0
    made.registration = IMAGE
    assert made.make_status(9.0).text.endswith("; in the image, RAS")


def test_the_error_is_the_distance_to_the_target_and_at_the_end_the_result():
    near = replace(
        PERIOD, estimate=Pose(PLAN.target[0] - 3.0, PLAN.target[1] + 4.0, 0.0, 0.0, 0.0), miss=(0.3, 0.4)
    )
    _, found = composed(PLAN, near)
    assert found["NeedleError"].text == "5.00 mm to the target, predicted miss 0.50 mm"
    _, found = composed(PLAN, near, InsertionResult(9.0, "reached"))
    assert found["NeedleError"].text == "reached"


def test_the_registration_of_an_insertion_moves_what_is_shown():
    made, before = composed(PLAN, PERIOD)
    made.begin(IMAGE)
    after = {message.name: message for record in (PLAN, PERIOD) for message in made.compose(record, 0.0)}
    assert {"NeedlePath", "Needle", "NeedlePoints", "NeedleTip"} <= set(after)
    np.testing.assert_allclose(
        homogeneous(np.array(after["Needle"].points)) @ np.array(MATRIX).T,
        homogeneous(np.array(before["Needle"].points)),
        atol=1e-9,
    )


def test_the_turn_from_x_is_the_smallest():
    axis = np.array(Pose(0.0, 0.0, 0.0, 0.3, -0.2).axis)
    turn = turn_from_x(axis)
    np.testing.assert_allclose(turn[:, 0], axis, atol=1e-12)
    np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(turn @ np.cross([1, 0, 0], axis), np.cross([1, 0, 0], axis), atol=1e-12)
