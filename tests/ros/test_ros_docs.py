"""docs/rig/ros.md: its tables are those of the profiles, and its rig file is one."""

import re
import tomllib
from pathlib import Path

import pytest

from flexneedle.ros.profile import LATCHED, PUBLISHED, SUBSCRIBED, load_profile
from flexneedle.ros.settings import DriverSettings, TrackerSettings, checked
from flexneedle.scenario.rig import RigFile

PAGE = (Path(__file__).parents[2] / "docs" / "rig" / "ros.md").read_text(encoding="utf-8")


def row(key, topic, frames):
    section, _, name = key.partition(".")
    kind = {"publish": PUBLISHED, "subscribe": SUBSCRIBED}[section][name]
    verb = {"publish": "publishes", "subscribe": "reads"}[section]
    latched = ", latched" if section == "publish" and name in LATCHED else ""
    placed = f"{frames[topic.frame].id} | {topic.unit}" if hasattr(topic, "unit") else "| "
    return f"| {verb} `{name}`{latched} | `{topic.topic}` | {kind} | {placed} |".replace("|  |", "| |")


@pytest.mark.parametrize("name", ["neutral", "smartneedle"])
def test_tables_are_those_of_the_profiles(name):
    profile = load_profile(name)
    expected = [row(key, topic, profile.frames) for key, topic in profile.topics()]
    table = re.search(rf"<!-- table: {name} -->\n\n(.*?)\n\n", PAGE, re.DOTALL).group(1)
    assert table.splitlines()[2:] == expected


def test_the_rig_file_is_one():
    (text,) = [code for code in re.findall(r"```toml\n(.*?)```", PAGE, re.DOTALL) if "[driver]" in code]
    rig = RigFile.model_validate(tomllib.loads(text))
    assert (rig.driver.kind, rig.tracker.kind) == ("ros", "ros")
    checked(rig.driver.settings, DriverSettings)
    checked(rig.tracker.settings, TrackerSettings)
    assert rig.axes.insertion.scale == 0.001
    assert rig.axes.rotation.scale == pytest.approx(1.0)
