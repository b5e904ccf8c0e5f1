"""The Python interface makes the same figures, tables and run folders as the commands."""

import builtins
import json
from dataclasses import fields, replace
from io import StringIO

import numpy as np
import pytest
from matplotlib.text import Text

import flexneedle
from flexneedle.cli import main as cli
from flexneedle.errors import InputError, RunError
from flexneedle.figures.insertion import insertion_figure
from flexneedle.record.fields import COLUMNS
from flexneedle.record.figures import draw_run
from flexneedle.record.folder import TRACE_FILE
from flexneedle.record.results import insertion_result
from synthetic import blind, make_insertion, make_plan

PHANTOM = flexneedle.load_scenario("phantom")
PLAN = replace(make_plan(), scenario=PHANTOM)
INSERTION = replace(make_insertion(PLAN), scenario=PHANTOM, controller="ce-mpc", phantom="exact")

SHALLOW = {"target.depth_mm": 15.0, "target.lateral_mm": 2.0}


def same(one, other):
    """Compare two records, except for wall-clock times and versions."""
    for field in fields(one):
        a, b = getattr(one, field.name), getattr(other, field.name)
        if field.name in ("durations", "seconds", "versions"):
            continue
        if field.name in ("shape", "true_shape"):  # in a trace lengths are in m, angles are quaternions
            np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-12)
        elif field.name == "predicted" and a is not None:
            for mine, theirs in zip(a, b, strict=True):
                np.testing.assert_allclose(mine, theirs, rtol=1e-12, atol=1e-12)
        elif isinstance(a, np.ndarray):
            np.testing.assert_array_equal(a, b, err_msg=field.name)
        elif field.name == "periods":
            assert len(a) == len(b)
            all(same(mine, theirs) for mine, theirs in zip(a, b, strict=True))
        elif field.name == "plan":
            same(a, b)
        elif field.name == "history":
            np.testing.assert_equal([dict(each) for each in a], [dict(each) for each in b])
        else:
            np.testing.assert_equal(a, b, err_msg=field.name)
    return True


@pytest.fixture
def pd():
    """Pandas, which no other test needs."""
    return pytest.importorskip("pandas")


@pytest.mark.parametrize(
    ("record", "kind", "shown"),
    [
        (PLAN, "plan", [PLAN]),
        (INSERTION, "insertion", INSERTION),
        (UNNAMED := replace(INSERTION, scenario=None), "insertion", UNNAMED),
        (replace(INSERTION, periods=()), "plan", [PLAN]),
    ],
    ids=["plan", "insertion", "its plan's scenario", "no period"],
)
def test_plot_returns_the_figure_that_the_commands_draw(record, kind, shown, monkeypatch):
    for name in ("plan", "insertion"):
        monkeypatch.setattr(
            f"flexneedle.record.figures.{name}_figure", lambda *given, name=name: (name, *given)
        )
    assert flexneedle.plot(record) == (kind, PHANTOM, shown)


@pytest.mark.usefixtures("empty_figures")
def test_a_dataframe_has_the_rows_and_columns_of_the_exported_table(pd, tmp_path, capsys):
    half = replace(INSERTION, periods=(*INSERTION.periods[:-1], blind(INSERTION.periods[-1])))
    flexneedle.save(half, tmp_path / "run")
    assert cli.main(["export", str(tmp_path / "run"), "--csv", str(tmp_path / "periods.csv")]) == 0
    capsys.readouterr()
    frame = flexneedle.to_dataframe(half)
    assert tuple(frame.columns) == COLUMNS
    assert len(frame) == len(half.periods)
    texts = {"verdict": str, "action": str, "decision": str, "warning": str}
    missing = {name: ["", "nan"] for name in COLUMNS if name not in texts}
    exported = pd.read_csv(tmp_path / "periods.csv", dtype=texts, keep_default_na=False, na_values=missing)
    pd.testing.assert_frame_equal(frame, exported, check_dtype=False, rtol=1e-13, atol=0.0)
    assert np.isnan(frame["true_x_mm"].iloc[-1])
    assert frame["true_x_mm"].dtype == frame["measured_z_mm"].dtype == float
    assert frame["converged"].dtype == bool


@pytest.mark.usefixtures("empty_figures")
def test_each_record_of_a_dry_run_is_marked_as_one(pd, tmp_path, capsys):
    dry, folder = replace(INSERTION, phantom="", rig="Bench", dry_run=True), tmp_path / "run"
    assert dry.summary == f"dry run: {INSERTION.summary}"
    flexneedle.save(dry, folder)
    stored = json.loads((folder / "run.json").read_text())
    assert (stored["dry_run"], stored["result"]["dry_run"]) == (True, True)
    loaded = flexneedle.load(folder)
    assert loaded.dry_run
    assert dry.summary in {
        text.get_text() for text in insertion_figure(loaded.scenario, loaded).findobj(Text)
    }
    assert cli.main(["export", str(folder), "--csv", "-"]) == 0
    table = pd.read_csv(StringIO(capsys.readouterr().out))
    assert table["dry_run"].all()
    pd.testing.assert_series_equal(flexneedle.to_dataframe(loaded)["dry_run"], table["dry_run"])


def test_an_insertion_that_moved_a_needle_has_no_mark_of_a_dry_run():
    assert tuple(flexneedle.to_dataframe(replace(INSERTION, periods=())).columns) == COLUMNS
    assert "dry_run" not in flexneedle.to_dataframe(INSERTION)
    assert insertion_result(INSERTION)["dry_run"] is False


def test_without_pandas_the_error_names_the_remedy(monkeypatch):
    imported = builtins.__import__

    def failing_import(name, *more, **options):
        if name == "pandas":
            raise ModuleNotFoundError("No module named 'pandas'", name="pandas")
        return imported(name, *more, **options)

    monkeypatch.setattr(builtins, "__import__", failing_import)
    with pytest.raises(InputError, match="pip install pandas"):
        flexneedle.to_dataframe(INSERTION)


@pytest.mark.usefixtures("empty_figures")
def test_a_saved_record_loads_unchanged(tmp_path):
    """The loaded scenario of the plan includes the settings of the controllers."""
    scenario = PHANTOM.with_values({**SHALLOW, "plan.iterations": 1, "plan.max_iterations": 1})
    plan = flexneedle.plan(scenario)
    done = flexneedle.insert(scenario, plan, seed=3, controller="resolved-rate", force=True)
    plan = replace(plan, scenario=done.scenario)
    insertion = replace(done, plan=plan)
    assert same(flexneedle.load(flexneedle.save(insertion, tmp_path / "insertion")), insertion)
    assert same(flexneedle.load(str(flexneedle.save(done.plan, str(tmp_path / "plan")))), plan)


@pytest.mark.long
def test_save_writes_the_same_folder_as_the_command(tmp_path, monkeypatch, capsys):
    """The same seeds give the same files, except for wall-clock times."""
    scenario = PHANTOM.with_values(SHALLOW)
    plan = flexneedle.plan(scenario, seed=0)
    insertion = flexneedle.insert(scenario, plan, seed=3)
    monkeypatch.chdir(tmp_path)
    target = ("--target", *map(str, SHALLOW.values()))
    assert cli.main(["insert", *target, "--seed", "3", "--plan-seed", "0", "--out", "insert"]) == 0
    assert cli.main(["plan", *target, "--out", "plan"]) == 0
    capsys.readouterr()
    for command, record in (("insert", insertion), ("plan", plan)):
        ours, theirs = flexneedle.save(record, f"our-{command}"), tmp_path / command
        assert sorted(p.name for p in ours.iterdir()) == sorted(p.name for p in theirs.iterdir())
        mine, other = (json.loads((folder / "run.json").read_text()) for folder in (ours, theirs))
        assert mine.pop("timing").keys() == other.pop("timing").keys()
        assert json.dumps(mine) == json.dumps(other)
        for picture in ours.glob("*.png"):
            assert picture.read_bytes() == (theirs / picture.name).read_bytes()


@pytest.mark.usefixtures("in_tmp", "empty_figures")
def test_a_folder_of_both_strategies_loads_as_plans_by_name(engine, capsys):
    engine()
    cli.main(["plan", "--strategy", "both", "--out", "both"])
    capsys.readouterr()
    plans = flexneedle.load("both")
    assert list(plans) == ["manipulation", "steering"]
    assert all(plan.strategy == name and plan.scenario is not None for name, plan in plans.items())


def test_a_record_without_a_scenario_is_rejected_with_the_remedy(tmp_path):
    bare = replace(PLAN, scenario=None)
    for use in (flexneedle.plot, lambda record: flexneedle.save(record, tmp_path / "a")):
        with pytest.raises(
            InputError, match=r"give one with dataclasses\.replace\(record, scenario=scenario\)$"
        ):
            use(bare)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "use", [flexneedle.to_dataframe, lambda record: flexneedle.save(record, "a"), flexneedle.plot]
)
def test_another_type_is_rejected_in_one_line(use, in_tmp):
    with pytest.raises(InputError, match=r"^(record|insertion) = \[1, 2\]: must be a") as caught:
        use([1, 2])
    assert str(caught.value).isprintable()
    assert list(in_tmp.iterdir()) == []


@pytest.mark.usefixtures("empty_figures")
def test_a_folder_without_a_run_is_rejected(tmp_path):
    with pytest.raises(InputError, match=r"contains no run: run\.json is missing"):
        flexneedle.load(tmp_path)
    with pytest.raises(InputError, match="already contains a run"):
        flexneedle.save(PLAN, flexneedle.save(PLAN, tmp_path / "a"))


@pytest.mark.usefixtures("empty_figures")
def test_a_run_without_a_plan_is_rejected(tmp_path):
    path = flexneedle.save(PLAN, tmp_path / "a") / "run.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"plans": {}}))
    with pytest.raises(RunError, match="the run ended before planning finished"):
        flexneedle.load(tmp_path / "a")


@pytest.mark.usefixtures("empty_figures")
def test_an_insertion_killed_before_its_trace_is_drawn_as_its_plan(tmp_path):
    folder = flexneedle.save(INSERTION, tmp_path / "run")
    (folder / TRACE_FILE).unlink()
    assert [path.name for path in draw_run(folder)] == ["plan.png", "plan.svg"]


@pytest.mark.usefixtures("empty_figures")
def test_without_the_file_of_a_zone_a_figure_is_kept_or_drawn_without_it_and_with_a_line_about_it(tmp_path):
    zone = {"shape": "file", "name": "artery", "file": str(tmp_path / "gone.stl")}
    scenario = PHANTOM.with_values({"zone": [zone]})
    folder = flexneedle.save(replace(INSERTION, scenario=scenario), tmp_path / "run")
    notes, kept = [], folder / "insertion.png"
    kept.write_bytes(b"with the artery")
    assert draw_run(folder, notes.append) == []
    assert kept.read_bytes() == b"with the artery"
    for path in folder.glob("insertion.*g"):
        path.unlink()
    assert [path.name for path in draw_run(folder, notes.append)] == ["insertion.png", "insertion.svg"]
    assert len(notes) == 2
    assert all(f"zone artery: {zone['file']}: " in note for note in notes)


@pytest.mark.parametrize("record", [PLAN, INSERTION], ids=["plan", "insertion"])
def test_a_loaded_record_keeps_the_versions_that_made_it(tmp_path, record):
    path = flexneedle.save(record, tmp_path / "old") / "run.json"
    path.write_text(path.read_text().replace(f'"numpy": "{np.__version__}"', '"numpy": "1.0"'))
    again = flexneedle.save(flexneedle.load(path.parent), tmp_path / "new")
    assert json.loads((again / "run.json").read_text())["versions"]["numpy"] == "1.0"
    if record is INSERTION:
        assert b"numpy" in (content := (again / TRACE_FILE).read_bytes())
        assert np.__version__.encode() not in content
