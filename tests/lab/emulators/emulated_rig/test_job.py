"""Rigs that can be emulated, and the records and orders of their processes."""

import socket
from dataclasses import replace

import numpy as np
import pytest

from flexneedle.cli.main import main
from flexneedle.errors import InputError, RigError, RunError
from flexneedle.lab.emulators.emulated_rig.child import Parent
from flexneedle.lab.emulators.emulated_rig.driven_needle import DrivenNeedle
from flexneedle.lab.emulators.emulated_rig.emulated_rig import split_fault
from flexneedle.lab.emulators.emulated_rig.job import EmulationJob, make_job
from flexneedle.lab.emulators.emulated_rig.motors_part import address_of, make_controller
from flexneedle.lab.emulators.emulated_rig.phantom import draw_phantom, make_sensor
from flexneedle.lab.emulators.emulated_rig.stream import ChannelEnded, Record, receive_records, send_record
from flexneedle.lab.emulators.emulated_rig.tracker_part import noise_of, port_of
from flexneedle.lab.process import MessageChannel
from flexneedle.lab.rig.rig_file import RIGS, RigFile, load_rig
from flexneedle.loop.virtual import Seeds, registration_error, virtual_rig
from flexneedle.scenario.files import load_scenario
from flexneedle.scenario.sections.registration import Registration

RIG = load_rig("emulated")
PHANTOM = load_scenario("phantom")


def rig_with(**parts):
    """The emulated rig of the package with other tables."""
    return RigFile.model_validate(RIGS.read_shipped("emulated") | parts)


def test_the_rig_of_the_package_fits_both_presets():
    assert RIGS.names() == ["emulated"]
    for name in ("phantom", "phantom3d"):
        setup, axes = load_scenario(name).setup, RIG.axes
        make_job(RIG, load_scenario(name), None, 0, None, ())
        assert axes.insertion.limits == (0.0, setup.stroke_mm)
        assert axes.insertion.speed >= setup.insertion_speed_mm_s
        step = setup.max_advance_mm / setup.insertion_speed_mm_s
        for guide in (axes.guide_y, axes.guide_z):
            assert guide.limits == (-setup.max_guide_travel_mm, setup.max_guide_travel_mm)
            assert guide.speed >= setup.max_guide_step_mm / step
    assert (address_of(RIG), port_of(RIG)) == (("127.0.0.1", 2323), "/tmp/aurora")


@pytest.mark.parametrize(
    ("parts", "key"),
    [
        ({"driver": {"kind": "own:NAME"}}, "driver.kind = 'own:NAME'"),
        ({"tracker": {"kind": "replay"}}, "tracker.kind = 'replay'"),
        *(
            ({"driver": {"kind": "galil"} | given}, f"driver.address = {given.get('address')!r}")
            for given in (
                {},
                *({"address": bad} for bad in (2323, ":23", "host:x", "host:65536")),
            )
        ),
        *(
            ({"tracker": {"kind": "aurora"} | given}, f"tracker.port = {given.get('port')!r}")
            for given in ({}, {"port": 5}, {"port": ""})
        ),
    ],
)
def test_a_rig_that_cannot_be_emulated_is_refused_in_one_line(parts, key):
    rig = rig_with(**parts)
    with pytest.raises(RigError) as refusal:  # noqa: PT012  whichever of them checks the key
        make_job(rig, PHANTOM, None, 0, None, ())
        address_of(rig)
        port_of(rig)
    (line,) = refusal.value.problems
    assert line.startswith(f"{key}: must be ")


def test_a_tracker_in_an_environment_is_refused():
    with pytest.raises(InputError, match="white noise only"):
        make_job(RIG, PHANTOM.with_values({"tracker.environment": "noisy"}), None, 0, None, ())


def test_a_free_entry_needs_the_plan(quick_plan):
    free = PHANTOM.with_values({"entry.free_slope_mrad": 50.0})
    with pytest.raises(InputError, match="give the plan with --plan"):
        make_job(RIG, free, None, 0, None, ())
    plan = replace(quick_plan, scenario=PHANTOM.with_values({"entry.slope_mrad": 12.0}))
    assert make_job(RIG, free, plan, 0, None, ()).scenario.entry.slope_mrad == 12.0


def test_a_plan_of_another_scenario_is_refused(quick_plan):
    with pytest.raises(InputError, match="the plan was made with"):
        make_job(RIG, PHANTOM.with_values({"needle.length_mm": 149.0}), quick_plan, 0, None, ())
    with pytest.raises(InputError, match="several plans"):
        make_job(RIG, PHANTOM, {"manipulation": quick_plan}, 0, None, ())


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ("stall=A@5", "must be DEVICE:KIND"),
        ("motor:stall=A@5", "must be DEVICE:KIND"),
        ("galil:missing@5", "unknown kind; kinds: stall"),
        ("aurora:missing", "must be KIND"),
    ],
)
def test_an_invalid_fault_is_refused_in_one_line(given, message):
    with pytest.raises(InputError, match=message):
        split_fault(given)
    assert split_fault("galil:stall=A@5:1") == ("galil", "stall=A@5:1")


def test_the_phantom_equals_the_virtual_rig_of_the_same_seed():
    """Also its start: the tip before the first motion."""
    for seed in (0, 5):
        needle = DrivenNeedle(draw_phantom(EmulationJob(RIG, PHANTOM, seed)), np.zeros(6))
        virtual = virtual_rig(PHANTOM, 0.0, Seeds.of(seed))
        np.testing.assert_array_equal(needle.tip, virtual.truth().tip)


def test_the_sensor_has_the_errors_of_the_draw():
    """Bias, and the error of the rig's registration in place of the scenario's."""
    registration = RIG.registration.model_copy(update={"localisation_mm": 0.5})
    scenario = PHANTOM.with_values({"phantom.tracker_bias_mm": 0.4, "tracker.tip_offset_mm": 9.0})
    job = EmulationJob(rig_with(registration=registration.model_dump()), scenario, 3)
    sensor = make_sensor(job, truth := draw_phantom(job))
    assert np.linalg.norm(sensor.bias) == pytest.approx(0.4)
    assert (sensor.bias, sensor.offset) == (truth.bias, 9.0)
    error = registration_error(registration, Seeds.of(3).room)
    point = np.array([30.0, 1.0, -2.0])
    mapped = sensor.to_tracker.apply(point)
    registered = np.array([mapped[2] + 220.0, mapped[0], mapped[1]])
    np.testing.assert_allclose(registered, error.apply(point))
    assert 0.05 < np.linalg.norm(registered - point) < 2.0


def test_without_a_registration_the_frames_are_the_same():
    values = {key: value for key, value in RIGS.read_shipped("emulated").items() if key != "registration"}
    job = EmulationJob(RigFile.model_validate(values), PHANTOM)
    x, y, z, *axis = make_sensor(job, draw_phantom(job)).at(np.array([1.0, 2.0, 3.0, 0.0, 0.0]))
    assert ((x, y, z), axis) == ((1.0, 2.0, 3.0), [1.0, 0.0, 0.0])
    own = Registration.model_validate(RIGS.read_shipped("emulated")["registration"])
    of_scenario = PHANTOM.with_values({"tracker.registration": own.model_dump(mode="json")})
    mapped = make_sensor(replace(job, scenario=of_scenario), draw_phantom(job)).at(
        np.array([20.0, 2.0, 3.0, 0.0, 0.0])
    )
    np.testing.assert_allclose(mapped[:3], (2.0, 3.0, -200.0))


def test_noise_and_missing_frames_are_those_of_the_scenario():
    values = {
        "tracker.jitter_mm": 0.2,
        "tracker.direction_jitter_mrad": 5.0,
        "phantom.missing_fraction": 0.05,
    }
    noise = noise_of(PHANTOM.with_values(values))
    assert (noise.position, noise.direction, noise.missing) == (0.2, 0.005, 0.05)


def test_the_controller_has_the_switches_of_its_axes():
    device = make_controller(EmulationJob(rig_with(), PHANTOM))
    assert device.axes[0].switches == (-2000.0, 222_000.0)
    assert device.axes[2].switches == (-32_000.0, 32_000.0)


def channels():
    return map(MessageChannel, socket.socketpair())


def test_records_arrive_in_order_and_the_end_after_the_last():
    reading, writing = channels()
    assert receive_records(reading) == []
    records = [Record(k, (k + 0.5, -k), k == 1) for k in range(3)]
    for record in records:
        send_record(writing, record, "reader")
    writing.close()
    assert receive_records(reading) == records
    with pytest.raises(ChannelEnded):
        receive_records(reading)
    reading.close()


def test_a_reader_that_does_not_keep_up_is_an_error_and_one_that_has_ended_the_end():
    reading, writing = channels()
    record = Record(0.0, (0.0,) * 4, True)

    def fill():
        for _ in range(100_000):
            send_record(writing, record, "phantom")

    with pytest.raises(RunError, match="phantom"):
        fill()
    reading.close()
    with pytest.raises(ChannelEnded):
        send_record(writing, record, "phantom")
    writing.close()


def test_a_child_ends_with_its_parent():
    ours, theirs = channels()
    parent = Parent(ours)
    theirs.send("clear")
    assert parent.read(parent.sources) == ["clear"]
    assert parent.read([]) == []
    theirs.close()
    with pytest.raises(ChannelEnded):
        parent.read(parent.sources)
    ours.close()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["none.toml", "phantom"], "none.toml: no such file, and no such rig (choices: emulated)"),
        (["emulated", "none"], "none: no such file"),
        (["emulated", "phantom", "--plan", "none"], "none"),
    ],
)
def test_the_command_refuses_in_one_line(arguments, message, capsys):
    assert main(["emulate", "rig", *arguments]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert message in err
    assert err.count("\n") == 1
