"""Short versions of campaigns/fuzz_aurora.py, and faults that it must notice."""

import re
import sys
from pathlib import Path
from random import Random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flexneedle.lab.emulators import aurora, codec
from flexneedle.lab.rig.devices.aurora.messages import parse
from flexneedle.types import VISIBLE, Frame, SensorReading

sys.path.append(str(Path(__file__).parents[5] / "campaigns"))  # behind the tests: both have an `emulated`
import fuzz_aurora
import fuzz_aurora_line
import fuzzing

SECONDS = 60.0
FINITE = st.floats(allow_nan=True, allow_infinity=True)
JSON = st.recursive(
    st.one_of(st.none(), st.booleans(), st.integers(), FINITE, st.text(max_size=5)),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=3), inner, max_size=3),
    max_leaves=12,
)


@pytest.mark.parametrize("part", [name for name in fuzz_aurora.PARTS if name != "live"])
def test_a_few_thousand_inputs_of_each_part_obey_its_rules(part):
    assert fuzzing.run(fuzz_aurora.PARTS[part], 4000, SECONDS, seed=7)[0] == 4000


@pytest.mark.long
def test_a_line_that_damages_replies_gives_no_frame_that_was_not_sent():
    _, note = fuzzing.run(fuzz_aurora.PARTS["live"], 1000, 6.0, seed=3)
    assert int(re.search(r"(\d+) replies", note)[1]) > 100, note


@settings(max_examples=150)
@given(
    kind=st.integers(0, 255),
    bits=st.integers(0, 0xFFFF),
    frame=st.integers(0, 3),
    pose=st.lists(FINITE, max_size=10) | st.tuples(*[FINITE] * 8),
)
def test_a_sensor_has_a_position_only_if_it_is_finite_and_in_range(kind, bits, frame, pose):
    found = fuzz_aurora.check_reading((kind, bits, frame, tuple(pose)), 2)
    assert (found.position is None) == (found.status != VISIBLE)
    assert all(abs(part) < fuzz_aurora.FARTHEST_MM for part in found.position or ())


@settings(max_examples=100)
@given(
    st.lists(
        st.binary(max_size=60) | JSON.map(lambda value: fuzz_aurora.json.dumps(value).encode()), max_size=5
    )
)
def test_any_line_that_is_no_message_is_refused_and_counted(lines):
    feeding = fuzz_aurora.Feeding()
    for number, line in enumerate(lines):
        fuzz_aurora.feed_message(feeding, line, Random(number))
    assert feeding.incoming.counts.errors.get("crash", 0) == len(lines)
    assert feeding.incoming.read() == ()


@settings(max_examples=80)
@given(st.lists(st.binary(max_size=40), max_size=10))
def test_any_bytes_to_the_emulated_tracker_are_answered(lines):
    device = aurora.power_on()
    for number, line in enumerate(lines):
        checked = codec.parse_command(line).name.encode() + b":"
        for sent in (line, checked + b"%04X" % codec.crc16(checked)):
            frame = fuzz_aurora.random_frame(Random(number))
            _, answer = aurora.reply(device, sent, frame)
            assert answer.endswith(b"\r") or fuzz_aurora.decoded(answer) is not None
            device = fuzz_aurora.check_command(device, sent, frame)


# Faults that it must notice


def test_the_line_notices_a_frame_that_was_not_sent_intact():
    sent = fuzz_aurora_line.Sent()
    pose = aurora.EmulatedPose((1.0, 2.0, 3.0), (1.0, 0.0, 0.0, 0.0), 0.02)
    body = b"\x01\x0a\x01" + codec.encode_pose_binary(pose) + bytes(8) + bytes(2)
    good = codec.encode_binary(body)
    assert not sent.add(good[:-1] + b"\x00", 5.0)
    assert not sent.add(good[:-1], 5.0)
    assert sent.add(good, 5.0)

    def frame(time, *position):
        return Frame(time, 1, {"tip": SensorReading(position, (1.0, 0.0, 0.0, 0.0), 0.02)})

    assert sent.problem(frame(4.9, 1.0, 2.0, 3.0)) == ""
    assert "not sent" in sent.problem(frame(4.9, 1.0, 2.0, 3.1))
    assert "dated" in sent.problem(frame(5.1, 1.0, 2.0, 3.0))


@pytest.mark.parametrize(
    "line",
    [
        b'["ready", {}]',
        b'["ready", {"10": ["01", "00"], "11": ["01"]}]',
        b'["frame", 4294967296, 0.0, {}]',
        b'["frame", 1, NaN, {}]',
        b'["frame", 1, 0.0, {"10": [0, 49, 1, [0, 0, 0]]}]',
        b"",
        b"[" * 100_000,
    ],
)
def test_an_invalid_message_is_refused_in_one_line(line):
    with pytest.raises(ValueError, match="not a message: ") as refusal:
        parse(line)
    assert len(str(refusal.value)) < 320
    assert "\n" not in str(refusal.value)
