"""Lines that `insert` prints while the needle moves."""

import flexneedle
from flexneedle.cli.insert import _InsertProgress
from flexneedle.cli.progress import Progress
from flexneedle.loop.events import PeriodEnded
from synthetic_sensors import EXCLUDED_FROM, FROZEN, with_sensors


def test_an_excluded_sensor_has_one_line_at_its_depth(capsys):
    insertion = with_sensors()
    with Progress() as progress:
        show = _InsertProgress(progress, flexneedle.load_scenario("phantom"))
        for period in insertion.periods:
            show(PeriodEnded(period))
    lines = [line for line in capsys.readouterr().err.splitlines() if "excluded" in line]
    depth = insertion.periods[EXCLUDED_FROM].estimate.x
    assert lines == [f"flexneedle: sensor fbg excluded at {depth:.1f} mm: {FROZEN}"]
