"""A rig file is checked once, where it is read: one line for each problem, and no other error."""

import math

import pytest
import tomli_w

from bench_rig import rig, values
from flexneedle.errors import RigError
from flexneedle.lab.rig.rig_file import load_rig


@pytest.fixture
def file(tmp_path):
    """Return a function that writes a rig file with values changed and returns its path."""

    def write(changes=None):
        path = tmp_path / "rig.toml"
        path.write_text(tomli_w.dumps(values(changes)))
        return path

    return write


def problems(path):
    with pytest.raises(RigError) as caught:
        load_rig(path)
    assert all(line.startswith(f"{path}: ") and line.isprintable() for line in caught.value.problems)
    return [line.removeprefix(f"{path}: ") for line in caught.value.problems]


def test_a_rig_has_the_axes_of_its_file(file):
    found = load_rig(file({"driver.port": 23}))
    assert [name for name, _ in found.axes.items()] == ["insertion", "rotation", "guide_y"]
    assert (found.driver.kind, found.driver.settings) == ("bench", {"port": 23})
    assert (found.loop.rate_hz, found.loop.queue) == (40.0, 0.075)


def test_an_axis_is_in_counts_mm_rad_and_s():
    """Degrees and the direction of a motor are converted nowhere else."""
    axes = rig(
        axes__rotation__backlash_deg=0.9,
        axes__rotation__home_deg=45.0,
        axes__guide_y__backlash_mm=0.05,
        axes__guide_y__home_mm=-3.0,
    ).axes
    turned, guide = axes.rotation, axes.guide_y
    quarter = math.pi / 2
    assert turned.scale * quarter == pytest.approx(9000)  # counts of 90°
    assert turned.limits == pytest.approx((-quarter / 9, 190 / 90 * quarter))
    assert (turned.speed, turned.acceleration) == pytest.approx((4 * quarter, 20 * quarter))
    assert (turned.at_home, turned.backlash) == pytest.approx((quarter / 2, quarter / 100))
    assert (turned.max_error, turned.tolerance) == pytest.approx((quarter / 18, quarter / 90))
    assert (guide.scale, guide.limits, guide.speed, guide.acceleration) == (-500.0, (-15.0, 15.0), 5.0, 50.0)
    assert (guide.at_home, guide.backlash, guide.max_error, guide.tolerance) == (-3.0, 0.05, 0.2, 0.02)
    assert (axes.insertion.to_text(12.5), turned.to_text(math.pi)) == ("12.5", "180")
    assert (axes.insertion.unit, turned.unit) == ("mm", "deg")


@pytest.mark.parametrize(
    ("counts", "speed", "tolerance", "error"),
    [
        (2000.0, 10.0, 0.02, 0.2),  # at most that
        (2000.0, 3.0, 0.02, 0.12),  # of 40 ms
        (20_000.0, 1.0, 0.02, 0.08),  # four tolerances
        (50.0, 1.0, 0.06, 0.24),  # three counts, twelve counts
        (0.001, 1.0, 0.1, 0.4),  # a joint in m has no counts
    ],
)
def test_default_tolerances_are_derived_from_speed_and_counts(counts, speed, tolerance, error):
    axis = rig(axes__guide_y__counts_per_mm=counts, axes__guide_y__speed_mm_s=speed).axes.guide_y
    assert (axis.tolerance, axis.max_error) == pytest.approx((tolerance, error))


def test_the_queue_is_three_ticks_between_75_and_100_ms_and_limited_by_its_distance_and_two_tolerances():
    for rate, milliseconds in ((10.0, 100.0), (20.0, 100.0), (40.0, 75.0), (1000.0, 75.0)):
        assert rig(loop__rate_hz=rate).loop.queue == pytest.approx(1e-3 * milliseconds)
    loop, axes = rig(loop__queue_ms=50.0, loop__queue_mm=0.3).loop, rig().axes
    assert loop.queue_of(axes.insertion, 4.0) == pytest.approx(0.2)
    assert loop.queue_of(axes.insertion, 10.0) == 0.3
    assert loop.queue_of(axes.insertion, 0.1) == pytest.approx(0.04)
    assert loop.queue_of(axes.rotation, math.pi) == pytest.approx(math.pi / 20)


@pytest.mark.parametrize(
    ("home", "direction", "at_mm", "towards"),
    [
        ("reverse-limit", 1, 0.0, -1),
        ("reverse-limit", 1, -2.5, -1),  # beyond the soft limit
        ("reverse-limit", -1, 120.0, 1),
        ("forward-limit", 1, 120.0, 1),
        ("forward-limit", -1, 0.0, -1),
        ("here", -1, 3.0, 0),
        ("absolute", 1, 500.0, 0),
    ],
)
def test_a_limit_switch_of_the_controller_is_at_an_end_of_the_axis(home, direction, at_mm, towards):
    changes = {"home": home, "direction": direction, "home_mm": at_mm}
    axis = rig(**{f"axes__insertion__{key}": value for key, value in changes.items()}).axes.insertion
    assert (axis.to_home, axis.at_home) == (towards, at_mm)


RULES = [
    ("axes.insertion.channel", "x" * 41, "must have at most 40 characters"),
    ("axes.insertion.direction", 2, "must be one of -1, 1"),
    ("axes.insertion.counts_per_mm", 0, "must be above 0"),
    ("axes.insertion.speed_mm_s", math.inf, "must be a finite number"),
    ("axes.insertion.home", "limit", "must be one of here, reverse-limit, forward-limit, absolute"),
    ("axes.insertion.range_mm", [110, 0], "must be [lowest, highest]"),
    ("axes.insertion.range_mm", [0], "missing"),
    ("axes.insertion.backlash_mm", -0.1, "must be at least 0"),
    ("axes.insertion.backlash_mm", 120, "must be below 120, the width of range_mm"),
    ("axes.insertion.tolerance_mm", 0.2, "must be below max_error_mm (0.2)"),
    ("axes.insertion.home_mm", 1.0, "must be at most 0: the reverse-limit switch is at the low end"),
    ("axes.insertion.home", "forward-limit", "must be at least 120: the forward-limit switch is at the high"),
    ("axes.rotation.home_deg", 191, "must be within range_deg, -10 to 190"),
    ("axes.rotation.backlash_deg", 200, "must be below 200, the width of range_deg"),
    ("axes.rotation.tolerance_deg", 5.0, "must be below max_error_deg (5)"),
    ("axes.guide_y.channel", "A", "is also the channel of insertion"),
    ("loop.queue_ms", 101, "must be at most 100"),
    ("loop.queue_ms", 24, "must be at least 25, the time of a tick at rate_hz (40)"),
    ("loop.queue_mm", 0.03, "must be at least 0.04, twice tolerance_mm of axes.insertion"),
    ("loop.rate_hz", 9.9, "must be at least 10"),
    ("loop.decision_limit_s", 0.2, "must be above decision_ms (200 ms)"),
    ("driver.kind", None, "missing"),
    ("axes.insertion", None, "missing"),
    ("axes.guide_x", {}, "unknown key; did you mean guide_"),
    ("registration", {"fiducials_mm": [[0, 0, 0]]}, "must have at least 3 entries"),
]


@pytest.mark.parametrize(("key", "value", "rule"), RULES, ids=lambda part: str(part)[:30])
def test_a_broken_rule_is_reported_in_one_line(file, key, value, rule):
    (line,) = problems(file({key: value}))
    named, message = line.split(": ", maxsplit=1)
    assert named.split(" = ")[0].startswith(key)
    assert message.startswith(rule)


def test_several_problems_have_a_line_each(file):
    assert len(problems(file({"axes.insertion.range_mm": [0, math.inf], "loop.rate_hz": 0, "x": 1}))) == 3
