"""Values of the paper and the manufacturer, copied again from Tables I and II and the text; names of their sensors."""

from em_tables import random_rows, write_csv
from flexneedle import load_scenario
from flexneedle.lab.tracker_evaluation.evaluation import published
from flexneedle.lab.tracker_evaluation.evaluation.evaluate import EvaluationOptions, evaluate_table


def errors(*values):
    return dict(zip(("rmse_mm", "p95_mm", "max_mm", "jitter_mm"), values, strict=False))


def levels(*values):
    return dict(zip(("mean", "sd", "max", "min"), values, strict=True))


def test_the_manufacturers_and_the_papers_errors_are_those_of_table_1():
    official = {"tip": errors(0.70, 1.40), "reference": errors(0.48, 0.88)}
    measured = {
        ("tip", "ideal"): errors(0.65, 1.10, 1.40, 0.07),
        ("reference", "ideal"): errors(0.61, 0.91, 1.16, 0.08),
        ("tip", "noisy"): errors(1.53, 3.20, 4.36, 0.04),
        ("reference", "noisy"): errors(2.70, 5.27, 8.16, 0.07),
    }
    assert (official, measured) == (published.OFFICIAL, published.MEASURED)


def test_the_papers_indicator_is_that_of_table_2_and_of_its_text():
    ideal, noisy = levels(0.0239, 0.0138, 0.0779, 0.0061), levels(0.1944, 0.1049, 0.4784, 0.0684)
    assert {"ideal": {**ideal, "p95": 0.0547}, "noisy": noisy} == published.INDICATOR
    fits = {"mean_mm": 0.575, "sd_mm": 0.211, "slope_mm": 9.591, "intercept_mm": 0.051}
    assert (fits, 0.0547) == (published.FITS, published.THRESHOLD)


def test_the_monitor_uses_the_papers_threshold():
    assert load_scenario("phantom").monitor.indicator_limit == published.THRESHOLD


def test_names_of_the_papers_sensors():
    for name in ("ref", "ref1", "Ref12", "reference", "reference2", " REFERENCE "):
        assert published.find_paper_sensor(name) == "reference", name
    for name in ("1", "0", "", "reflector", "ref1b", "xref", "tip2", "coil 7"):
        assert published.find_paper_sensor(name) is None, name
    assert published.find_paper_sensor("Tip") == "tip"


def test_a_sensor_named_1_is_not_compared_with_the_paper(tmp_path):
    evaluation = evaluate_table(
        write_csv(tmp_path / "t.csv", random_rows(0, sensor="1")), EvaluationOptions()
    )
    (result,), (found,) = (evaluation.values()[key] for key in ("results", "indicator"))
    assert (result["official"], result["paper"], found["paper"]) == (None, None, None)
