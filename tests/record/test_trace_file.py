"""`trace.mcap`: periods are restored exactly, by this package and by others, also after a kill."""

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from mcap.exceptions import EndOfFile
from mcap.reader import NonSeekingReader, make_reader
from mcap.stream_reader import StreamReader
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

from flexneedle.errors import InputError
from flexneedle.record.fields import COLUMNS, from_row, parse_verdict, to_row
from flexneedle.record.messages import joints
from flexneedle.record.reader import read_trace
from flexneedle.record.topics import OPTIONAL, TOPICS, period_messages
from flexneedle.record.writer import TraceWriter
from flexneedle.types import (
    CheckedMeasurement,
    Control,
    Frame,
    Measurement,
    Pose,
    SensorReading,
    Shape,
    Verdict,
    VerdictKind,
)
from synthetic import blind, make_periods, make_plan

PLAN = make_plan()
OFF = np.array([0.0, 0.1, -0.2, 0.01, -0.02])
PERIODS = [
    replace(period, predicted=Shape(period.shape + OFF, period.shape[:, 1:3] ** 2))
    for period in list(make_periods(PLAN))[:12]
]
ABOUT = {"seed": "0", "flexneedle": "0.1.0"}
SCENARIO = {"name": "Größe", "target": {"depth_mm": 40.0}}


def write(path, periods=PERIODS):
    with TraceWriter(path, PLAN, about=ABOUT, scenario=SCENARIO) as writer:
        for period in periods:
            writer.add(period)
    return path


def messages(path):
    """Return all messages except the wall-clock ones, read with mcap."""
    with path.open("rb") as file:
        found = make_reader(file).iter_messages(log_time_order=False)
        return [(c.topic, m.log_time, m.data) for _, c, m in found if c.topic != "/timing"]


def until_the_end(records):
    """Yield the records before the truncated end of the file."""
    try:
        yield from records
    except EndOfFile:
        return
    pytest.fail("the file ends like a complete one")


@pytest.fixture(scope="module")
def trace_file(tmp_path_factory):
    return write(tmp_path_factory.mktemp("trace") / "trace.mcap")


def test_periods_are_restored_to_the_last_bit_of_every_scalar(trace_file):
    trace = read_trace(trace_file)
    assert [to_row(p) for p in trace.periods] == [to_row(p) for p in PERIODS]
    assert [p.durations for p in trace.periods] == [p.durations for p in PERIODS]
    assert (trace.about, trace.scenario, trace.note) == (ABOUT, SCENARIO, "")


def test_shapes_are_restored(trace_file):
    for again, period in zip(read_trace(trace_file).periods, PERIODS, strict=True):
        np.testing.assert_allclose(again.shape, period.shape, rtol=1e-14, atol=1e-14)
        for found, known in zip(again.predicted, period.predicted, strict=True):
            np.testing.assert_allclose(found, known, rtol=1e-14, atol=1e-13)


def test_a_period_in_space_is_restored(tmp_path):
    """Every column out of the plane, a roll to any angle and a spin, to the last bit."""
    out = {
        "command": Control(1.0, 0.1, -0.2, 1e-3, -2e-3, 0.3, -0.4, 0.5, -0.6),
        "applied": Control(0.9, 0.2, -0.3, 2e-3, -3e-3, 0.4, -0.5, 0.6, -0.7),
        "innovation": (1 / 3, 0.1, -0.2), "estimate": Pose(30.0, 1.0, -1 / 3, 0.1, -0.2), "guide": (0.3, -1 / 7),
        "base": Pose(-120.0, 0.2, -0.3, 1e-3, -1 / 3), "path": Pose(30.0, 1.1, -0.4, 0.1, -0.3), "roll": 7.0,
        "tip_load": (0.01, -0.02), "true_tip": Pose(30.1, 1.2, -0.5, 0.2, -0.3), "miss": (0.5, -1 / 7),
        "shape": PERIODS[3].shape + OFF, "true_shape": (PERIODS[3].shape + OFF)[:, :3],
    }  # fmt: skip
    period = replace(PERIODS[3], **out)
    (again,) = read_trace(write(tmp_path / "trace.mcap", [period])).periods
    for name, value in out.items():
        if name.endswith("shape"):
            np.testing.assert_allclose(getattr(again, name), value, rtol=1e-13, atol=1e-13)
        else:
            assert getattr(again, name) == value, name


def test_a_period_has_neither_shapes_nor_readings_of_the_previous_one(tmp_path):
    shape, reading = PERIODS[3].shape, CheckedMeasurement(Measurement(0.1, 1.0, 2.0), Verdict())
    full = replace(PERIODS[3], true_shape=shape[:, :3], readings=(reading,))
    without = replace(PERIODS[4], predicted=None, true_shape=None)
    first, second = read_trace(write(tmp_path / "trace.mcap", [full, without])).periods
    assert first.predicted is not None
    assert (first.true_shape.shape, len(first.readings)) == ((len(shape), 3), 1)
    assert (second.predicted, second.true_shape, second.readings) == (None, None, ())


def test_a_period_without_a_tip_is_restored(tmp_path):
    period = blind(PERIODS[3])
    (again,) = read_trace(write(tmp_path / "trace.mcap", [period])).periods
    assert to_row(again) == to_row(period)
    assert (again.measurement.x, again.true_tip, again.true_strain_energy) == (None, None, None)
    assert again.true_stretch is None
    assert (str(again.verdict), again.measurement.time) == ("missing", period.measurement.time)


@pytest.mark.parametrize(
    "measurement",
    [
        Measurement(0.1, 30.1, 1 / 3),
        Measurement(0.1, None, None, None),
        Measurement(
            0.1,
            30.1,
            1 / 3,
            -0.7,
            Frame(
                0.1,
                4711,
                {
                    "tip": SensorReading((1 / 7, 2.0, 3.0), (0.5, 0.5, -0.5, 0.5)),
                    "ref1": SensorReading((4.0, 5.0, 6.0), (1.0, 0.0, 0.0, 0.0), 0.0547),
                    "ref 2": SensorReading(None, status="out of volume"),
                },
            ),
        ),
    ],
)
def test_readings_are_restored_to_the_last_bit_with_their_verdicts(tmp_path, measurement):
    frozen = Verdict(VerdictKind.FROZEN, "4 identical readings")
    checked = (CheckedMeasurement(measurement, Verdict()), CheckedMeasurement(measurement, frozen))
    period = replace(PERIODS[3], readings=checked, measurement=measurement)
    (again,) = read_trace(write(tmp_path / "trace.mcap", [period])).periods
    assert again.readings == checked
    assert (again.measurement.x, again.measurement.z) == (measurement.x, measurement.z)


@pytest.mark.parametrize("reason", ["", "2.91 mm, limit 2.40 mm", "ref1: 0.09", ": "])
def test_a_verdict_is_restored_from_its_text(reason):
    verdicts = [Verdict(kind, reason) for kind in VerdictKind]
    assert [parse_verdict(str(verdict)) for verdict in verdicts] == verdicts


@pytest.mark.parametrize("text", ["fine", "", "okay", "missing the tip", "field"])
def test_a_text_that_is_not_a_verdict_is_rejected(text):
    with pytest.raises(ValueError, match=f"'{text}' is not a valid VerdictKind"):
        parse_verdict(text)


def test_columns_that_a_row_of_an_earlier_version_lacks_are_restored_as_unknown():
    row = to_row(PERIODS[0])
    del row["stretch"], row["energy_scale_mj"], row["clearance_mm"], row["true_clearance_mm"]
    restored = from_row(row, PERIODS[0].shape, {})
    assert (restored.clearance, restored.true_clearance) == (np.inf, None)
    assert np.isnan([restored.stretch, restored.energy_scale]).all()
    assert restored.strain_energy == PERIODS[0].strain_energy


def test_columns_carry_units():
    bare = {
        "index",
        "verdict",
        "cost",
        "action",
        "decision",
        "converged",
        "warning",
        "late",
        "stretch",
        "true_stretch",
    }
    units = {"mm", "rad", "s", "mj", "n"}
    assert {name for name in COLUMNS if name.rsplit("_", 1)[-1] not in units} == bare


def test_a_period_without_zones_has_an_infinite_clearance_and_no_message_of_it(tmp_path):
    period = replace(PERIODS[3], clearance=np.inf, true_clearance=np.inf)
    (again,) = read_trace(write(tmp_path / "trace.mcap", [period])).periods
    assert (again.clearance, again.true_clearance) == (np.inf, np.inf)
    assert not any(one.topic.endswith("clearance") for one in period_messages(period))


def test_every_topic_has_a_message_each_period(trace_file):
    with trace_file.open("rb") as file:
        found = Counter(channel.topic for _, channel, _ in make_reader(file).iter_messages())
    assert found == {
        topic: 1 if topic == "/plan/path" else len(PERIODS) for topic in TOPICS if topic not in OPTIONAL
    }


def test_rosbags_reads_types_units_and_frame(trace_file):
    with AnyReader([trace_file], default_typestore=get_typestore(Stores.ROS2_JAZZY)) as reader:
        found = {
            c.topic: (time, reader.deserialize(raw, c.msgtype)) for c, time, raw in reader.messages()
        }  # the last one of each topic
    last = PERIODS[-1]
    time, estimate = found["/tip/estimate"]
    assert time == round(last.time * 1e9)
    assert estimate.header.frame_id == "skin"
    assert estimate.pose.position.y == pytest.approx(last.estimate.y * 1e-3, rel=1e-15)
    assert 2 * estimate.pose.orientation.z == pytest.approx(last.estimate.theta, rel=1e-3)
    assert found["/tissue/true_strain_energy"][1].data == last.true_strain_energy * 1e-3
    assert found["/tissue/relative_energy"][1].data == last.strain_energy / 0.04
    assert found["/tissue/true_relative_energy"][1].data == last.true_strain_energy / 0.04
    command = found["/command"][1]
    assert dict(zip(command.name, command.position, strict=True))["base_x"] == last.command.db_x * 1e-3
    assert len(found["/needle/shape"][1].poses) == len(last.shape)
    measured = found["/tip/measured"][1].header.stamp
    assert measured.sec + measured.nanosec * 1e-9 == pytest.approx(last.measurement.time)


def test_the_plan_is_latched(trace_file):
    with trace_file.open("rb") as file:
        channels = make_reader(file).get_summary().channels.values()
    latched = {c.topic for c in channels if "durability: 1" in c.metadata.get("offered_qos_profiles", "")}
    assert latched == {"/plan/path"}


def test_content_except_for_timing_is_the_same_for_the_same_run(trace_file, tmp_path):
    slower = [p.__class__(**{**vars(p), "durations": {"total": 1.0}}) for p in PERIODS]
    assert messages(trace_file) == messages(write(tmp_path / "again.mcap", slower))


def test_a_killed_writer_leaves_all_its_periods_also_for_other_readers(tmp_path):
    """After the 12th period the file ends with a complete record, although nobody has closed it."""
    path = tmp_path / "trace.mcap"
    with TraceWriter(tmp_path / "writing.mcap", PLAN, about=ABOUT, scenario=SCENARIO) as writer:
        for period in PERIODS:
            writer.add(period)
        path.write_bytes((tmp_path / "writing.mcap").read_bytes())
    trace = read_trace(path)
    assert [to_row(p) for p in trace.periods] == [to_row(p) for p in PERIODS]
    assert "incomplete: 12 complete periods read" in trace.note
    with path.open("rb") as file:
        found = NonSeekingReader(file).iter_messages(log_time_order=False)
        topics = [channel.topic for _, channel, _ in until_the_end(found)]
    assert topics.count("/control/status") == 12
    with path.open("rb") as file:
        positions = [file.tell() for _ in until_the_end(StreamReader(file, emit_chunks=True).records)]
    assert positions[-1] == path.stat().st_size


def test_a_truncated_file_loses_only_the_truncated_periods(trace_file, tmp_path):
    torn = tmp_path / "torn.mcap"
    data = trace_file.read_bytes()
    counts = []
    for length in range(len(data) // 2, len(data), 3989):
        torn.write_bytes(data[:length])
        trace = read_trace(torn)
        counts.append(len(trace.periods))
        assert trace.note
    assert counts == sorted(counts)
    assert counts[-1] == len(PERIODS)


@pytest.mark.parametrize("content", [None, b"", b"no trace at all", b"\x89MCAP0\r\n"])
def test_a_file_that_is_not_a_trace_is_rejected(content, tmp_path):
    path = tmp_path / "trace.mcap"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(InputError, match=r"trace\.mcap: (not a trace of flexneedle|cannot be read)"):
        read_trace(path)


def test_a_trace_is_never_overwritten(trace_file):
    before = trace_file.read_bytes()
    with pytest.raises(FileExistsError):
        TraceWriter(trace_file, PLAN, about=ABOUT, scenario=SCENARIO)
    assert trace_file.read_bytes() == before


def test_joints_are_in_metres_and_radians():
    message = joints(1.5, (-170.0, 0.25, -0.5, 2e-3, -1e-3, -1.5, 2.5, np.pi))
    assert message.name == [
        "base_x", "base_y", "base_z", "base_theta", "base_psi", "guide_y", "guide_z", "roll",
    ]  # fmt: skip
    np.testing.assert_allclose(
        message.position, [-0.170, 2.5e-4, -5e-4, 2e-3, -1e-3, -1.5e-3, 2.5e-3, np.pi], rtol=1e-12
    )
