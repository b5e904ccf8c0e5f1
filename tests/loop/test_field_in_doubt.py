"""The closed loop with a field that is distorted for one period: no hold, and no correction of the estimate."""

from dataclasses import replace

import numpy as np
import pytest

from flexneedle.types import Frame, SensorReading
from insertions import PHANTOM, READING, RESTING, Stage, run

UNNAMED = PHANTOM.with_values({"monitor.references": 0})
"""No reference is required; those that are measured are checked nevertheless."""


def framed(batch, indicator):
    """Readings with frames: the tip, and a reference with this indicator."""

    def frame(sample):
        reference = SensorReading((0.0, 50.0, 0.0), indicator=indicator)
        tip = SensorReading((sample.x, sample.y, 0.0))
        return Frame(sample.time, round(sample.time / READING), {"tip": tip, "ref1": reference})

    return tuple(replace(sample, frame=frame(sample)) for sample in batch)


@pytest.fixture
def tape(quick):
    return [framed(batch, 0.02) for batch in quick[1].tape]


def test_a_period_with_the_field_in_doubt_moves_without_a_correction(plan, quick, tape):
    tape[30] = framed(quick[1].tape[30], 0.2)
    periods = run(plan, Stage(tape, quick[1].applied).rig(), UNNAMED).periods
    verdicts = {str(reading.verdict) for reading in periods[30].readings}
    assert verdicts == {"field in doubt: ref1 0.2000, limit 0.0547 (median over 0.2 s)"}
    assert (str(periods[30].verdict), periods[30].innovation) == ("ok", (0.0, 0.0, 0.0))
    assert np.abs(periods[31].innovation).max() > 0.0
    assert {str(period.verdict) for period in periods} == {"ok"}


def test_after_an_arrival_in_doubt_the_needle_rests_until_the_field_is_clean(plan, quick, tape):
    """Five of eight readings in 0.2 s must be clean."""
    done, recorded = quick
    last = framed(recorded.tape[-1], 0.2)
    rests = [framed([replace(last[-1], time=last[-1].time + k * READING)], 0.02) for k in range(1, 9)]
    held = run(plan, Stage([*tape[:-1], last, *rests], recorded.applied).rig(), UNNAMED)
    assert held.outcome == "done"
    assert len(held.periods) == len(done.periods) + 5
    assert [period.decision for period in held.periods[-5:]] == [RESTING] * 5
    assert held.periods[-6].decision != RESTING
