"""A study of insertions that take tens of milliseconds, run in this process."""

from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager

import pytest

from flexneedle.lab.study import pools
from flexneedle.lab.study.runner import run_study

STUDY = """\
name = "mine"
title = "Mine"
repeats = 2
[values]
controller = "open-loop"
plan = { samples = 16, iterations = 2 }
setup.tip_to_skin_mm = 4.0
phantom = { step_mm = 1.0, contact_spacing_mm = 2.0, element_mm = 2.0 }
[[cases]]
name = "base"
targets = [[8, 0.5], [7, 0]]
[[axes]]
key = "phantom.tracker_bias_mm"
values = [0.0, 0.3]
"""


def run(folder):
    """Run it; the folder of its 8 rows."""
    (folder / "mine.toml").write_text(STUDY)
    with in_threads():
        return run_study(folder / "mine.toml", folder / "study")


@contextmanager
def in_threads():
    """Run studies in threads of this process, so that tests can monkeypatch their functions."""

    @contextmanager
    def open_threads(workers=None):
        with ThreadPoolExecutor(workers or 1) as pool:
            yield pool

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pools, "open_processes", open_threads)
        yield
