"""Shipped profiles, and refused ones."""

import tomllib
from pathlib import Path

import numpy as np
import pytest
import tomli_w

from flexneedle.errors import RigError
from flexneedle.lab.ros import profile as profiles
from flexneedle.lab.ros.profile import (
    CURVATURES,
    INSERTION_KEYS,
    PROFILES,
    PUBLISHED,
    SHAPE,
    SUBSCRIBED,
    TopicProfile,
    load_profile,
)

TOPIC, NEEDLE = {"topic": "/t", "frame": "skin"}, "/flexneedle/needle/shape"
NAMES = ["neutral", "smartneedle", "smartneedle-fbg"]
SMARTNEEDLE = {
    "publish.shape": ("/needle/state/current_shape", "geometry_msgs/msg/PoseArray", "mm"),
    "publish.predicted_shape": ("/needle/state/predicted_shape", "geometry_msgs/msg/PoseArray", "mm"),
    "publish.skin_entry": ("/needle/state/skin_entry", "geometry_msgs/msg/Point", "mm"),
    "publish.needle_pose": ("/stage/state/needle_pose", "geometry_msgs/msg/PoseStamped", "mm"),
    "publish.guide_pose": ("/stage/state/guide_pose", "geometry_msgs/msg/PointStamped", "mm"),
    "subscribe.tip": ("/sensor/tip", "geometry_msgs/msg/PoseStamped", "mm"),
}


def kind_of(key):
    section, _, name = key.partition(".")
    return {"publish": PUBLISHED, "subscribe": SUBSCRIBED}[section][name]


def without_sensors(topics):
    return {key: topic for key, topic in topics.items() if not key.startswith("sensors.")}


def topics_of(name):
    return dict(load_profile(name).list_topics())


def write(path, **changes):
    """Write the neutral profile with `section__key` changed, or left out."""
    values = PROFILES.read_shipped("neutral")
    for key, value in changes.items():
        section, _, part = key.partition("__")
        values[section] = {**values[section], part: value}
        if value is None:
            del values[section][part]
    path.write_text(tomli_w.dumps(values))
    return path


def test_every_shipped_topic_has_a_type_and_one_owner():
    paths = list((Path(profiles.__file__).parent / "profiles").glob("*.toml"))
    assert sorted(path.stem for path in paths) == PROFILES.names() == NAMES
    for path in paths:
        topics = dict(TopicProfile.model_validate(tomllib.loads(path.read_text())).list_topics())
        assert all(kind_of(key) for key in without_sensors(topics))
        assert len({topic.topic for topic in without_sensors(topics).values()}) == len(
            without_sensors(topics)
        )
    assert set(PUBLISHED) == set(profiles.PublishedTopics.model_fields)
    assert set(SUBSCRIBED) == set(profiles.ReadTopics.model_fields)


def test_neutral_lists_all_topics_but_those_of_smartneedle_alone():
    listed = without_sensors(topics_of("neutral"))
    every = {f"publish.{key}" for key in PUBLISHED} | {f"subscribe.{key}" for key in SUBSCRIBED}
    assert every - set(listed) == {"publish.skin_entry", "publish.needle_pose", "publish.guide_pose"}
    assert all(getattr(topic, "unit", "m") == "m" for topic in listed.values())
    reduced = load_profile("neutral").select(**INSERTION_KEYS)  # measurements and motors have separate nodes
    read = {key for key, _ in reduced.list_topics() if not key.startswith("publish")}
    assert read == {"subscribe.stop", "subscribe.arm", "subscribe.target"}
    assert reduced.publish.joint_targets is None
    assert reduced.publish.shape == load_profile("neutral").publish.shape


def test_smartneedle_has_the_topics_types_and_units_of_that_system():
    topics = topics_of("smartneedle")
    found = {key: (topics[key].topic, kind_of(key), topics[key].unit) for key in SMARTNEEDLE}
    assert found == SMARTNEEDLE
    assert topics["publish.shape"].spacing_mm == topics["publish.predicted_shape"].spacing_mm == 0.5
    listed = {key: topic.topic for key, topic in topics_of("smartneedle-fbg").items()}
    assert (
        listed["subscribe.shape"] == "/needle/state/current_shape"
    )  # a fibre-optic needle measures its shape
    assert listed["publish.predicted_shape"] == "/needle/state/predicted_shape"
    own = {f"publish.{key}" for key in ("shape", "skin_entry", "needle_pose", "guide_pose")}
    assert not own & set(listed)


def test_the_needle_is_turned_into_the_stage_as_in_that_system():
    """Half a turn about z, then a quarter back about x: stage = (−x, z, y) of the needle; z and y are along it."""
    frames = load_profile("smartneedle").frames
    assert frames["needle"].rotation[:, 0].tolist() == [0.0, 0.0, 1.0]
    assert frames["stage"].rotation[:, 0].tolist() == [0.0, 1.0, 0.0]
    about_x, about_z = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]]), np.diag([-1.0, -1.0, 1.0])
    to_stage = frames["stage"].rotation @ frames["needle"].rotation.T
    np.testing.assert_array_equal(to_stage, about_x @ about_z)


@pytest.mark.parametrize(
    ("changes", "key"),
    [
        ({"publish__tip": TOPIC | {"topic": "tip"}}, 'publish.tip.topic = "tip"'),
        ({"publish__tip": TOPIC | {"topic": "/a b"}}, 'publish.tip.topic = "/a b"'),
        ({"publish__tip": TOPIC | {"frame": "nose"}}, 'publish.tip.frame = "nose"'),
        ({"publish__tip": TOPIC | {"unit": "in"}}, 'publish.tip.unit = "in"'),
        ({"publish__tipp": TOPIC}, "publish.tipp = {…}"),
        ({"publish__shape": TOPIC | {"spacing_mm": 0.0}}, "publish.shape.spacing_mm = 0.0"),
        ({"subscribe__shape": TOPIC | {"topic": NEEDLE}}, f'subscribe.shape.topic = "{NEEDLE}"'),
        ({"sensors__a": TOPIC}, "sensors.a.type: missing"),
        ({"sensors__a": TOPIC | {"type": "std_msgs/msg/Bool"}}, 'sensors.a.type = "std_msgs/msg/Bool"'),
        ({"sensors__a": TOPIC | {"type": CURVATURES}}, 'sensors.a.frame = "skin": curvatures have no'),
        ({"sensors__a": TOPIC | {"type": SHAPE, "frame": ""}}, 'sensors.a.frame = ""'),
        ({"sensors__a": TOPIC | {"type": SHAPE, "topic": NEEDLE}}, f'sensors.a.topic = "{NEEDLE}"'),
        ({"frames__skin": {"id": "skin", "x": "z"}}, 'frames.skin = ["z", "y", "z"]'),
        ({"frames__skin": {"id": "skin", "y": "-y"}}, 'frames.skin = ["x", "-y", "z"]'),
        ({"frames__skin": {"id": ""}}, "frames.skin.id"),
        ({"frames__skin": {"id": "skin", "idd": 1}}, "frames.skin.idd = 1"),
        ({"frames__x": {"id": "x", "deep": [[]]}}, "frames.x.deep = [[]]"),
    ],
)
def test_an_invalid_profile_is_refused(tmp_path, changes, key):
    path = write(tmp_path / "own.toml", **changes)
    with pytest.raises(RigError) as caught:
        load_profile(path)
    assert caught.value.problems[0].startswith(f"{path}: {key}")
    with pytest.raises(RigError, match=f"choices: {', '.join(NAMES)}"):
        load_profile("slicer")
