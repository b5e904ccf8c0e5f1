"""The closed loop while references tell for a moment that the field is bent: too short to hold, no time to learn."""

from dataclasses import replace

import numpy as np
import pytest

from flexneedle.types import Frame, SensorReading
from insertions import PHANTOM, READING, RESTING, Stage, run

UNNAMED = PHANTOM.with_values({"monitor.references": 0})
"""No reference is needed to move; what they tell is judged all the same."""


def framed(batch, indicator):
    """Readings with what the tracker told: the tip, and a reference with this indicator."""

    def frame(sample):
        reference = SensorReading((0.0, 50.0, 0.0), indicator=indicator)
        tip = SensorReading((sample.x, sample.y, 0.0))
        return Frame(sample.time, round(sample.time / READING), {"tip": tip, "ref1": reference})

    return tuple(replace(sample, frame=frame(sample)) for sample in batch)


@pytest.fixture
def tape(real):
    return [framed(batch, 0.02) for batch in real[1].tape]


def test_a_period_in_doubt_corrects_nothing_and_moves_on(plan, real, tape):
    tape[30] = framed(real[1].tape[30], 0.2)
    seen = run(plan, Stage(tape, real[1].applied).rig(), UNNAMED).periods
    told = {str(reading.verdict) for reading in seen[30].readings}
    assert told == {"field in doubt: ref1 0.2000, limit 0.0547 (median over 0.2 s)"}
    assert (str(seen[30].verdict), seen[30].innovation) == ("ok", (0.0, 0.0))
    assert np.abs(seen[31].innovation).max() > 0.0
    assert {str(period.verdict) for period in seen} == {"ok"}


def test_an_arrival_in_doubt_is_looked_at_until_the_field_is_clean(plan, real, tape):
    """Of eight readings in 0.2 s five have to be clean again."""
    done, tank = real
    last = framed(tank.tape[-1], 0.2)
    rests = [framed([replace(last[-1], time=last[-1].time + k * READING)], 0.02) for k in range(1, 9)]
    held = run(plan, Stage([*tape[:-1], last, *rests], tank.applied).rig(), UNNAMED)
    assert held.outcome == "done"
    assert len(held.periods) == len(done.periods) + 5
    assert [period.decision for period in held.periods[-5:]] == [RESTING] * 5
    assert held.periods[-6].decision != RESTING
