"""Set-up of the sensors of an Aurora: one that fails is left out with its port and reason, and affects no other."""

import pytest

from flexneedle.lab.rig.devices.aurora import link
from flexneedle.lab.rig.devices.aurora.incoming import LinkReceiver
from flexneedle.lab.rig.devices.aurora.readings import NAMES


class FakeDevice:
    """A device with the handle 0B of an unplugged sensor and others of present ones; errors: codes by command.

    places: (port, channel) by handle (default: each at another port).
    """

    def __init__(self, present=(0x0A,), places=None, **errors):
        self.places = places or {}
        self.sent, self.errors = [], {key.replace("_", ":"): code for key, code in errors.items()}
        self.listed = {"PHSR:01": [[0x0B]], "PHSR:02": [[*present], [*present][len(present) :]]}

    def command(self, text):
        self.sent.append(text)
        return self.errors.get(text, 0)

    def port_handles(self):
        return self.listed[self.sent[-1]].pop(0)

    def location(self):
        handle = int(self.sent[-1][6:8], 16)
        if handle == self.errors.get("location"):
            raise ValueError("not a port location: 'x'")
        return self.places.get(handle, (f"{handle - 9:02d}", "00"))

    def explain(self, code):
        return f"error {code:02X}"


@pytest.mark.parametrize(
    ("errors", "failed"),
    [
        ({"PINIT_0C": 0x13}, {"12": (("03", "00"), "port 3 cannot be initialised: error 13")}),
        ({"PENA_0CD": 0x28}, {"12": (("03", "00"), "port 3 cannot be enabled: error 28")}),
        ({"PHINF_0C0020": 0x0E}, {"12": (None, "port handle 0C cannot be described: error 0E")}),
        (
            {"PINIT_0C": 0x1E, "PHINF_0C0020": 0x0E},
            {"12": (None, "port handle 0C cannot be initialised: error 1E")},
        ),
        ({"location": 0x0C}, {"12": (None, "port handle 0C cannot be described: not a port location: 'x'")}),
        ({"PHF_0B": 0x08}, {}),
    ],
)
def test_a_sensor_that_cannot_be_set_up_is_left_out_with_its_port_and_reason(errors, failed):
    found = link.set_up(FakeDevice((0x0A, 0x0C), **errors))
    assert found.failed == failed
    left = {"12": ("03", "00")} if not failed else {}
    assert found.ports == {"10": ("01", "00"), **left}


@pytest.mark.parametrize(
    ("errors", "reason"),
    [
        ({"PINIT_0A": 0x13}, "port 1 cannot be initialised: error 13"),
        ({"PINIT_0A": 0x103}, "PINIT:0A: no reply"),
        ({"PENA_0AD": 0x100}, "PENA:0AD: replies are garbled"),
    ],
)
def test_without_a_sensor_or_a_line_the_connection_ends(errors, reason):
    with pytest.raises(link._End, match=reason):
        link.set_up(FakeDevice(**errors))


def test_handles_of_unplugged_sensors_are_freed_before_set_up():
    device = FakeDevice()
    assert link.set_up(device).ports == {str(0x0A): ("01", "00")}
    assert device.sent[:3] == ["PHSR:01", "PHF:0B", "PHSR:02"]
    assert [text for text in device.sent if "0B" in text] == ["PHF:0B"]


TOOL = {0x0C: ("02", "00"), 0x0D: ("02", "01")}  # two sensors of one tool
ONE = "port 1 is reported by two port handles: its sensors cannot be distinguished"


@pytest.mark.parametrize(
    ("places", "errors", "ports", "failed"),
    [
        (TOOL, {}, {"10", "12", "13"}, []),
        (TOOL, {"PINIT_0D": 0x13}, {"10", "12"}, ["port 2 (sensor 2) cannot be initialised: error 13"]),
        (TOOL, {"PENA_0CD": 0x28}, {"10", "13"}, ["port 2 cannot be enabled: error 28"]),
        ({0x0A: ("01", "00"), 0x0C: ("01", "00")}, {}, {"13"}, [ONE, ONE]),
        ({0x0A: ("01", "00"), 0x0C: ("01", "00")}, {"PINIT_0C": 0x13}, {"10", "13"}, None),
    ],
)
def test_a_tool_of_two_sensors_or_of_an_unclear_port_does_not_affect_the_others(
    places, errors, ports, failed
):
    found = link.set_up(FakeDevice((0x0A, 0x0C, 0x0D), places, **errors))
    assert set(found.ports) == ports
    assert [why for _, why in found.failed.values()] == (
        failed or ["port 1 cannot be initialised: error 13"] * (failed is None)
    )
    received = LinkReceiver(NAMES, 0.0, lambda: 0.0)
    received.take(("ready", found.ports, found.failed))
