"""campaigns/fuzz_igtl.py, for a moment: random and damaged messages crash neither the decoder nor a server."""

import sys
from pathlib import Path

import pytest

from flexneedle.lab.igtl.codec import Query, Skipped
from flexneedle.lab.igtl.messages import StringMessage, TransformMessage

sys.path.insert(0, str(Path(__file__).resolve().parents[3] / "campaigns"))
import fuzz_igtl
import fuzzing

NAN_ROWS = ((float("nan"),) * 4,) * 3 + ((0.0, 0.0, 0.0, 1.0),)


def test_any_bytes_may_be_decoded():
    done, note = fuzzing.run(fuzz_igtl.decoder, 3000, 20.0, seed=7)
    assert done == 3000
    kinds = ("Transform", "Position", "Point", "Trajectory", "Polyline", "Status", "String")
    assert all(f"{kind}Message" in note for kind in kinds)
    assert all(kind in note for kind in ("Skipped", "Query", "refused"))


def test_a_server_survives_any_bytes_and_still_serves():
    assert fuzzing.run(fuzz_igtl.live, 500, 20.0, seed=7)[0] == 500


@pytest.mark.parametrize(
    ("one", "found"),
    [
        (TransformMessage(name="a", matrix=NAN_ROWS), "finite"),
        (Skipped("A", "a", "two\nlines"), "reason"),
        (Skipped("A", "a", ""), "reason"),
        (Query("RTS_A", "a"), "query"),
        (StringMessage(name="a", text="x"), ""),
    ],
)
def test_wrong_results_are_found(one, found):
    assert found in fuzz_igtl.problem(one)
    assert bool(fuzz_igtl.problem(one)) is bool(found)
