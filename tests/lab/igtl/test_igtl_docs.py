"""docs/rig/igtl.md: its table has the devices of the messages, and its tracker valid and complete keys."""

import re
import tomllib
from pathlib import Path

from flexneedle.lab.igtl import composer
from flexneedle.lab.igtl.sensor import IgtlSensorSettings
from flexneedle.lab.igtl.settings import REGISTRATION
from flexneedle.lab.igtl.tracker import IgtlTrackerSettings
from flexneedle.lab.rig.rig_file import check_settings

PAGE = (Path(__file__).parents[3] / "docs" / "rig" / "igtl.md").read_text(encoding="utf-8")


def test_devices_are_those_that_are_sent():
    listed = set(re.findall(r"^\|\w+\|`(\w+)`", PAGE, re.MULTILINE))
    names = ("SHAPE", "POINTS", "PREDICTED", "TIP", "GUIDE", "PATH", "STATUS", "ERROR")
    assert listed == {*(getattr(composer, name) for name in names), REGISTRATION}


def blocks():
    """The examples of the tracker and of a sensor."""
    return re.findall(r"```toml\n(.*?)```", PAGE, re.DOTALL)


def test_the_sensor_is_valid():
    (settings,) = tomllib.loads(blocks()[1])["sensor"]
    assert settings.pop("kind") == "igtl"
    settings.pop("name")
    check_settings(IgtlSensorSettings, settings)
    assert {*settings, "listen", "registration", "late_ms"} == set(IgtlSensorSettings.model_fields)


def test_keys_of_the_tracker_are_valid_and_complete():
    block, _ = blocks()
    settings = tomllib.loads(block)["tracker"]
    assert settings.pop("kind") == "igtl"
    check_settings(IgtlTrackerSettings, settings)
    assert {*settings, "listen"} == set(IgtlTrackerSettings.model_fields)
    defaults = IgtlTrackerSettings(device="a")
    given = dict(re.findall(r"^(\w+) = .*default: ([\w.]+)$", block, re.MULTILINE))
    assert {key: str(getattr(defaults, key)).lower() for key in ("host", "port", "stamps")} == {
        key: given[key] for key in ("host", "port", "stamps")
    }
