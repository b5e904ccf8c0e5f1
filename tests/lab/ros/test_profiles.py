"""Profiles: what ships, and what is refused."""

import tomllib
from pathlib import Path

import numpy as np
import pytest
import tomli_w

from flexneedle.errors import RigError
from flexneedle.lab.ros import profile as profiles
from flexneedle.lab.ros.profile import OF_THE_LOOP, PROFILES, PUBLISHED, SUBSCRIBED, Profile, load_profile

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


def with_changes(name="neutral", **changes):
    values = PROFILES.shipped(name)
    for key, value in changes.items():
        section, _, part = key.partition("__")
        if value is None:
            del values[section][part]
        else:
            values[section][part] = value
    return values


def test_those_that_ship():
    assert PROFILES.names() == ["neutral", "smartneedle", "smartneedle-fbg"]


@pytest.mark.parametrize("name", ["neutral", "smartneedle", "smartneedle-fbg"])
def test_every_topic_has_a_type_and_one_owner(name):
    topics = dict(load_profile(name).topics())
    assert all(kind_of(key) for key in topics)
    names = [topic.topic for topic in topics.values()]
    assert len(set(names)) == len(names)


def test_neutral_lists_all_but_what_smartneedle_alone_has():
    listed = {key for key, _ in load_profile("neutral").topics()}
    every = {f"publish.{key}" for key in PUBLISHED} | {f"subscribe.{key}" for key in SUBSCRIBED}
    assert every - listed == {"publish.skin_entry", "publish.needle_pose", "publish.guide_pose"}
    assert all(getattr(topic, "unit", "m") == "m" for _, topic in load_profile("neutral").topics())


def test_smartneedle_has_the_topics_types_and_units_of_that_system():
    topics = dict(load_profile("smartneedle").topics())
    found = {key: (topics[key].topic, kind_of(key), topics[key].unit) for key in SMARTNEEDLE}
    assert found == SMARTNEEDLE
    assert topics["publish.shape"].spacing_mm == topics["publish.predicted_shape"].spacing_mm == 0.5


def test_insertion_is_along_z_of_the_needle_and_y_of_the_stage():
    frames = load_profile("smartneedle").frames
    assert frames["needle"].rotation[:, 0].tolist() == [0.0, 0.0, 1.0]
    assert frames["stage"].rotation[:, 0].tolist() == [0.0, 1.0, 0.0]


def test_the_needle_is_turned_into_the_stage_as_in_that_system():
    """Half a turn about z, then a quarter back about x: stage = (−x, z, y) of the needle."""
    frames = load_profile("smartneedle").frames
    cos, sin = 0.0, -1.0
    about_x = np.array([[1, 0, 0], [0, cos, -sin], [0, sin, cos]])
    about_z = np.diag([-1.0, -1.0, 1.0])
    to_stage = frames["stage"].rotation @ frames["needle"].rotation.T
    np.testing.assert_array_equal(to_stage, about_x @ about_z)


def test_the_fibre_optic_needle_publishes_its_own_shape():
    listed = {key: topic.topic for key, topic in load_profile("smartneedle-fbg").topics()}
    assert listed["subscribe.shape"] == "/needle/state/current_shape"
    assert listed["publish.predicted_shape"] == "/needle/state/predicted_shape"
    assert not {"publish.shape", "publish.skin_entry", "publish.needle_pose", "publish.guide_pose"} & set(
        listed
    )


@pytest.mark.parametrize(
    ("changes", "line"),
    [
        (
            {"publish__tip": {"topic": "tip", "frame": "skin"}},
            'publish.tip.topic = "tip": must be a full topic name',
        ),
        (
            {"publish__tip": {"topic": "/a b", "frame": "skin"}},
            'publish.tip.topic = "/a b": must be a full topic name',
        ),
        (
            {"publish__tip": {"topic": "/tip", "frame": "nose"}},
            'publish.tip.frame = "nose": must be one of frames: skin',
        ),
        (
            {"publish__tip": {"topic": "/tip", "frame": "skin", "unit": "in"}},
            'publish.tip.unit = "in": must be one of',
        ),
        (
            {"publish__tipp": {"topic": "/tip", "frame": "skin"}},
            "publish.tipp = {…}: unknown key; did you mean tip?",
        ),
        (
            {"publish__shape": {"topic": "/s", "frame": "skin", "spacing_mm": 0.0}},
            "publish.shape.spacing_mm = 0.0: must",
        ),
        (
            {"subscribe__shape": {"topic": "/flexneedle/needle/shape", "frame": "skin"}},
            'subscribe.shape.topic = "/flexneedle/needle/shape": is that of publish.shape, too',
        ),
        (
            {"frames__skin": {"id": "skin", "x": "z"}},
            'frames.skin = ["z", "y", "z"]: must be three different axes',
        ),
        (
            {"frames__skin": {"id": "skin", "y": "-y"}},
            'frames.skin = ["x", "-y", "z"]: must be three different axes',
        ),
        ({"frames__skin": {"id": ""}}, "frames.skin.id"),
        ({"frames__skin": {"id": "skin", "idd": 1}}, "frames.skin.idd = 1: unknown key; did you mean id?"),
        (
            {"frames__x": {"id": "x", "deep": [[]]}},
            "frames.x.deep = [[]]: unknown key; valid keys: x, y, z, id",
        ),
    ],
)
def test_what_is_refused(tmp_path, changes, line):
    path = tmp_path / "own.toml"
    path.write_text(tomli_w.dumps(with_changes(**changes)))
    with pytest.raises(RigError) as caught:
        load_profile(path)
    assert caught.value.problems[0].startswith(f"{path}: {line}")


def test_a_profile_by_path(tmp_path):
    path = tmp_path / "own.toml"
    path.write_text(tomli_w.dumps(with_changes(publish__tip=None)))
    assert load_profile(path).publish.tip is None


def test_an_unknown_name_has_the_choices():
    with pytest.raises(RigError, match=r"no such profile \(choices: neutral, smartneedle, smartneedle-fbg\)"):
        load_profile("slicer")


def test_the_node_of_an_insertion_leaves_measurements_and_motors_to_nodes_of_their_own():
    publish, subscribe = OF_THE_LOOP
    reduced = load_profile("neutral").only(publish, subscribe)
    read = {key for key, _ in reduced.topics() if key.startswith("subscribe")}
    assert read == {"subscribe.stop", "subscribe.arm", "subscribe.target"}
    assert reduced.publish.joint_targets is None
    assert reduced.publish.shape == load_profile("neutral").publish.shape


def test_every_key_has_a_type():
    assert set(PUBLISHED) == set(profiles.Publish.model_fields)
    assert set(SUBSCRIBED) == set(profiles.Subscribe.model_fields)


def test_files_are_listed_with_the_package():
    paths = sorted((Path(profiles.__file__).parent / "profiles").glob("*.toml"))
    assert {path.stem for path in paths} == {"neutral", "smartneedle", "smartneedle-fbg"}
    for path in paths:
        assert Profile.model_validate(tomllib.loads(path.read_text())).name
