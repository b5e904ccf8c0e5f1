"""Settings of the driver in a rig file."""

import pytest

from flexneedle.errors import RigError
from flexneedle.lab.rig.devices.galil.motors import factory
from flexneedle.lab.rig.devices.galil.settings import check_galil_settings

GOOD = {"address": "192.168.1.10"}


@pytest.mark.parametrize(
    ("address", "host", "port"),
    [
        ("192.168.1.10", "192.168.1.10", 23),
        ("galil.lab:2323", "galil.lab", 2323),
        ("[fe80::1%eth0]:23", "fe80::1%eth0", 23),
        ("[::1]", "::1", 23),
    ],
)
def test_an_address_has_a_host_and_perhaps_a_port(address, host, port):
    found = check_galil_settings({"address": address}, ["A", "B"])
    assert (found.host, found.port) == (host, port)
    assert (found.mode, found.reply_timeout_ms) == ("tracking", 100.0)


@pytest.mark.parametrize(
    ("settings", "line"),
    [
        ({}, "address: missing"),
        *(
            ({"address": bad}, f'address = "{bad}": must be HOST or HOST:PORT, such as 192.168.1.10:23')
            for bad in ("a b", "a:0", "a:65536")
        ),
        ({**GOOD, "mode": "jog"}, 'mode = "jog": must be one of tracking, moves'),
        ({**GOOD, "reply_timeout_ms": 0}, "reply_timeout_ms = 0: must be at least 1"),
        ({**GOOD, "adress": "a"}, 'adress = "a": unknown key; did you mean address? '),
    ],
)
def test_an_invalid_setting_is_refused_in_one_line(settings, line):
    with pytest.raises(RigError) as error:
        factory(settings, ["A"])
    (found,) = error.value.problems
    assert found.startswith(line)


@pytest.mark.parametrize(
    ("channels", "line"),
    [
        (["A", "Q"], 'channel = "Q": must be an axis of the controller, one of A, B, C, D, E, F, G, H'),
        (["AB"], 'channel = "AB": must be an axis of the controller, one of A, B, C, D, E, F, G, H'),
    ],
)
def test_channels_are_axes_of_the_controller(channels, line):
    with pytest.raises(RigError) as error:
        factory(GOOD, channels)
    assert line in error.value.problems
