"""Short versions of campaigns/fuzz_galil.py: any reply to the driver, any line to the emulated controller."""

import re
import sys
from contextlib import suppress
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from emulated import until
from flexneedle.errors import DriverError
from flexneedle.lab.emulators.galil.controller import AXES, ControllerState, advance_controller, reply
from flexneedle.lab.rig.devices.galil.motors import factory
from galil_peer import CLOSE, peer

sys.path.insert(0, str(Path(__file__).parents[4] / "campaigns"))
import fuzz_galil

TIMEOUT_MS = 30.0
NUMBER = st.one_of(
    st.integers(-(2**31), 2**31).map(str), st.sampled_from(["", "?", "nan", "-0", "1e3", "0.5", "x"])
)
COMMAND = st.one_of(
    st.builds("{}{}={}".format, st.sampled_from(fuzz_galil.NAMES), st.sampled_from([*AXES, "E", ""]), NUMBER),
    st.builds("{} {},{}".format, st.sampled_from(fuzz_galil.NAMES), NUMBER, NUMBER),
    st.builds("{}{}".format, st.sampled_from(fuzz_galil.NAMES), st.text(AXES, max_size=4)),
    st.text(max_size=8),
)
LINE = st.lists(COMMAND, min_size=1, max_size=3).map(";".join)


@settings(max_examples=80)
@given(st.lists(st.tuples(LINE, st.integers(0, 20)), max_size=30))
def test_an_axis_moves_only_if_its_motor_is_on_and_it_was_begun(lines):
    device, _ = reply(ControllerState(), "SHAB")
    for line, samples in lines:
        before, device = device, fuzz_galil.check_line(device, line, samples)
        pairs = zip(before.axes, device.axes, strict=True)
        begun = [now for was, now in pairs if now.running and not was.running]
        assert all(axis.servo for axis in begun)
        assert not begun or "BG" in line or "PA" in line


def test_the_fuzz_notices_a_motion_that_nothing_began():
    moving = advance_controller(reply(ControllerState(), "SHA;PRA=5000;BGA")[0], 50)
    with pytest.raises(fuzz_galil.Failure, match="began to move"):
        fuzz_galil.check_line(ControllerState(), "SPA=100", 0, answered=lambda *_: (moving, ":"))


@pytest.fixture(scope="module")
def driven():
    """Motors and their controller, for all examples."""
    with peer() as device:
        given = {"address": f"127.0.0.1:{device.port}", "reply_timeout_ms": TIMEOUT_MS}
        with factory(given, ["A", "B"]) as motors:
            yield motors, device


REPLY = st.one_of(
    st.none(),
    st.just(CLOSE),
    st.binary(max_size=60),
    st.binary(max_size=3).map(lambda data: data * 2000),
    st.text(" -0123456789,.:?\r\n", max_size=60).map(str.encode),
    st.sampled_from(
        [b":", b"::::", b"????", b" 0, 0\r\n:" * 4, b" 1, -2\r\n: 3 4\r\n: 15, 143\r\n: 0, 1\r\n:"]
    ),
)


@settings(max_examples=150, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(answer=REPLY, name=st.sampled_from(sorted(fuzz_galil.ACTIONS)), seed=st.integers(0, 100))
def test_any_reply_is_a_state_that_was_sent_or_an_error(driven, answer, name, seed):
    motors, device = driven
    device.damage = lambda _line, _true: answer
    found = None
    with suppress(DriverError):
        found = fuzz_galil.ACTIONS[name](motors, fuzz_galil.Random(seed))
    if name == "read" and found is not None:
        sent = [float(number) for number in re.findall(rb"-?[0-9.]+", answer)[:4]]
        states = found.values()
        assert sent == [state.position for state in states] + [state.commanded for state in states]
    device.damage = None
    until(lambda: reads_truly(motors, device))


def reads_truly(motors, device):
    """Return whether a new connection has the positions of the controller, which moves between two readings."""
    try:
        motors.reconnect()
        found = [state.position for state in motors.read().values()]
    except DriverError:
        return False
    assert found == pytest.approx([axis.encoder for axis in device.device.axes[:2]], abs=1)
    return True
