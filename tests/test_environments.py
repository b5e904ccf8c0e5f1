"""studies/environments.py: the shipped environments agree with the paper's Tables I and II; hand values."""

import numpy as np
import pytest

import environments

CASES = [(name, figure) for name, figures in environments.PAPER.items() for figure in figures]


@pytest.fixture(scope="module")
def found():
    """Two measurements with seeds that were not used for tuning."""
    return environments.measure_environments(("ideal", "noisy"), (910_001, 910_002), other_rooms=False)


@pytest.mark.parametrize(("name", "figure"), CASES)
def test_the_shipped_environments_agree_with_the_paper(found, name, figure):
    """In every measurement, not only the median: within 10 %, maxima and minima within 25 %."""
    paper = environments.PAPER[name][figure]
    share = 0.25 if figure.endswith(("max", "min")) else 0.10
    np.testing.assert_allclose(found[name][figure], paper, rtol=share)


def test_in_noisy_no_indicator_is_below_the_threshold(found):
    """As stated in the paper for Table II."""
    assert found["noisy"]["𝓘 min"].min() > 0.0547


def by_hand(sensor, indicator):
    """Two points: error (3, 4, 0) mm with ±0.1 mm; error (0, 0, 2) mm without jitter and with a missing sample."""
    nan = np.nan
    x, y, z = [3.1, 2.9, 10.0, 10.0, nan], [4.0, 4.0, 0.0, 0.0, nan], [0.0, 0.0, 2.0, 2.0, nan]
    columns = {"true_x_mm": [0.0, 0.0, 10.0, 10.0, 10.0], "true_y_mm": [0.0] * 5, "true_z_mm": [0.0] * 5}
    columns |= {"point_id": [0, 0, 1, 1, 1], "x_mm": x, "y_mm": y, "z_mm": z, "indicator": indicator}
    columns |= {"sensor": [sensor] * 5, "environment": ["noisy"] * 5}
    return {name: np.array(values) for name, values in columns.items()}


def test_the_figures_of_two_points_by_hand():
    tip, reference = by_hand("tip", [np.nan] * 5), by_hand("reference", [0.1, 0.3, 0.05, 0.05, np.nan])
    table = {name: np.concatenate([tip[name], reference[name]]) for name in tip}
    found = environments.summarize(table, "noisy")
    assert found["reference RMSE"] == pytest.approx(np.sqrt((25 + 4) / 2))
    assert found["reference max"] == pytest.approx(5.0)
    assert found["reference 95 %"] == pytest.approx(2.0 + 0.95 * 3.0)
    assert found["reference jitter"] == pytest.approx(np.sqrt(2 * 0.1**2 / 4))
    assert (found["𝓘 mean"], found["𝓘 max"], found["𝓘 min"]) == pytest.approx((0.125, 0.2, 0.05))
    assert found["𝓘 sd"] == pytest.approx(0.15 / np.sqrt(2))
    assert found["slope"] == pytest.approx(3.0 / 0.15)
    assert found["intercept"] == pytest.approx(2.0 - 20 * 0.05)
