"""The images of an emulated rig without processes: messages of points, and the rig file of their driver."""

import math
from types import SimpleNamespace

import numpy as np
import pytest

from flexneedle.errors import InputError, RigError
from flexneedle.geometry.rigid import identity
from flexneedle.lab.emulators.emulated_rig.emulated_rig import rig_values
from flexneedle.lab.emulators.emulated_rig.images_part import address_of_images, to_message
from flexneedle.lab.emulators.emulated_rig.job import EmulationJob, make_job
from flexneedle.lab.igtl.sensor import IgtlSensorSettings, PointsReader
from flexneedle.lab.images.frames import ImageRegistration
from flexneedle.lab.rig.rig_file import RigFile, check_settings, load_rig
from flexneedle.scenario.files import load_scenario

RIG = load_rig("emulated")
SLICE = {"kind": "slice", "name": "lower", "plane_mm": 12.0}
POINTS = {"kind": "points", "to_mm": 20.0}
VIEW = {"kind": "view", "to_mm": 20.0, "projection": [[9.0, 0, 0, 0], [0, 9.0, 0, 0], [0, 0, 0, 1.0]]}
HALF_TURN = ImageRegistration((0.0, 0.0, 0.0, 1.0), (5.0, 6.0, 7.0))


def job_of(*sensors, rig=RIG):
    return EmulationJob(rig, load_scenario("phantom3d").with_values({"sensor": list(sensors)}))


def saved():
    """The rig file of two images, at port 9."""
    return rig_values(job_of(SLICE, POINTS), {"galil": "a:1", "aurora": "b", "igtl": "127.0.0.1:9"})


@pytest.mark.parametrize("registration", [None, HALF_TURN])
def test_the_driver_reads_the_points_that_are_measured_in_the_frame_of_the_insertion(registration):
    (_, points), (_, section) = job_of(SLICE, POINTS).images, saved()["sensor"]
    settings = check_settings(
        IgtlSensorSettings, {key: section[key] for key in section.keys() - {"name", "kind"}}
    )
    reader = PointsReader(settings, points, registration)
    to_image = identity() if registration is None else registration.inverse()
    sent = to_message("points", ((1.0, 2.0, 3.0), (2.0, math.nan, math.nan), (3.0, 4.0, 5.0)), to_image)
    found = reader.read(sent, "peer", 8.2, connected=False)
    np.testing.assert_allclose(found.rows, ((1.0, 2.0, 3.0), (3.0, 4.0, 5.0)), atol=1e-12)
    assert found.time == pytest.approx(8.2 - points.delay_s)
    assert reader.read(to_message("points", (), to_image), "peer", 8.7, connected=True).rows == ()


def test_the_saved_rig_file_can_be_emulated_again():
    assert address_of_images(job_of(SLICE, POINTS)) == ("127.0.0.1", 0)
    rig = RigFile.model_validate(saved())
    assert [one.name for one in rig.sensor] == ["lower", "points"]
    assert address_of_images(job_of(SLICE, POINTS, rig=rig)) == ("127.0.0.1", 9)


@pytest.mark.parametrize("key", [{"port": 8}, {"device": "other"}, {"stamps": True}, {"kind": "own:NAME"}])
def test_a_sensor_of_the_rig_file_that_does_not_read_what_is_sent_is_refused(key):
    values = saved()
    values["sensor"][1] |= key
    with pytest.raises(RigError, match='sensor points: must have kind = "igtl", device = "points"'):
        address_of_images(job_of(SLICE, POINTS, rig=RigFile.model_validate(values)))


def test_a_view_has_the_pixels_of_its_points():
    (view,) = job_of(VIEW).images
    reader = PointsReader(IgtlSensorSettings(device="view", stamps=False), view, HALF_TURN)
    sent = to_message("view", ((100.0, 20.0), (math.nan, math.nan), (140.0, 21.5)), HALF_TURN.inverse())
    assert reader.read(sent, "peer", 1.0, connected=False).rows == ((100.0, 20.0), (140.0, 21.5))
    assert make_job(RIG, job_of(SLICE, VIEW).scenario, None, 0, None, ()).images[1].title == "view"


def test_a_kind_without_an_emulated_device_is_refused():
    own = SimpleNamespace(title="own", kind="own:Own")
    scenario = job_of(SLICE).scenario.model_copy(update={"sensor": (own,)})
    with pytest.raises(InputError, match='sensor own: kind = "own:Own": must be fbg, slice, points or view'):
        make_job(RIG, scenario, None, 0, None, ())
