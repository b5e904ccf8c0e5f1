"""`em register`: rigid transform and errors from pairs of points; invalid pairs are refused in one line."""

import json
import tomllib

import numpy as np
import pytest

from flexneedle import load_scenario
from flexneedle.cli.main import main
from flexneedle.errors import InputError
from flexneedle.geometry.quaternion import from_vector, to_matrix
from flexneedle.geometry.rigid import Rigid
from flexneedle.lab.tracker_evaluation.register import read_pairs, register
from flexneedle.loop.virtual import Seeds, to_stage, virtual_rig
from flexneedle.scenario.files import load_registration

PHANTOM = load_scenario("phantom")
STAGE = np.array([[x, y, z] for x in (0.0, 80.0) for y in (-40.0, 40.0) for z in (0.0, 50.0)])
TRUE = Rigid(to_matrix(from_vector(np.array([[0.4, -1.0, 0.7]]))[0]), np.array([10.0, 20.0, -500.0]))
HEAD = "point_id,true_x_mm,true_y_mm,true_z_mm,x_mm,y_mm,z_mm,sensor"


def table(tmp_path, rows, head=HEAD, name="pairs.csv"):
    path = tmp_path / name
    path.write_text("\n".join([head, *(",".join(map(str, row)) for row in rows)]) + "\n")
    return path


def rows(error=0.0, repeats=1, seed=0, sensor="ref1"):
    rng = np.random.default_rng(seed)
    measured = TRUE.inverse().apply(STAGE) + rng.normal(0.0, error / np.sqrt(3.0), STAGE.shape)
    return [
        (f"p{k}", *STAGE[k], *measured[k], sensor)
        for _ in range(repeats)
        for k in rng.permutation(len(STAGE)).tolist()
    ]


def test_exact_pairs_give_the_exact_transform(tmp_path):
    found = register(read_pairs(table(tmp_path, rows(repeats=3))))
    np.testing.assert_allclose(found.rigid.rotation, TRUE.rotation, atol=1e-12)
    np.testing.assert_allclose(found.rigid.translation, TRUE.translation, atol=1e-9)
    assert found.fre < 1e-9
    assert found.pairs.samples.tolist() == [3] * 8
    in_metres = [(row[0], *(1e-3 * value for value in row[1:7]), row[7]) for row in rows(0.3)]
    other = register(read_pairs(table(tmp_path, in_metres), unit="m"))
    np.testing.assert_allclose(other.fre, register(read_pairs(table(tmp_path, rows(0.3)))).fre)
    assert (other.leave_one_out > other.residuals).all()
    without_ids = table(tmp_path, [row[1:7] for row in rows()], HEAD[9:-7])
    assert register(read_pairs(without_ids)).values()["points"] == 8
    again = to_stage(found.registration)
    np.testing.assert_allclose(again.apply(STAGE), TRUE.apply(STAGE), atol=1e-9)


@pytest.mark.long
def test_the_estimated_errors_are_the_planted_ones(tmp_path):
    """The RMS localisation error of 50 registrations is the planted one; leave-one-out errors exceed the residuals."""
    found = [register(read_pairs(table(tmp_path, rows(0.3, seed=seed)))) for seed in range(50)]
    assert np.sqrt(np.mean([one.fle**2 for one in found])) == pytest.approx(0.3, rel=0.1)
    assert all(np.all(one.leave_one_out >= one.residuals) for one in found)


def test_rows_of_a_point_are_averaged_and_missing_ones_ignored(tmp_path):
    data = rows(repeats=2)
    data += [(*row[:4], "", "", "", "ref1") for row in data[:3]]
    data = [
        (*row[:4], row[4] + (0.1 if k < 8 else -0.1), *row[5:]) if k < 16 else row
        for k, row in enumerate(data)
    ]
    found = register(read_pairs(table(tmp_path, data)))
    assert found.fre < 1e-9
    assert found.pairs.missing == 3


def test_ndis_code_is_a_missing_reading_and_zeros_are_noted(tmp_path):
    first, *others = rows()
    found = register(read_pairs(table(tmp_path, [(*first[:4], *[-3.697314e28] * 3, "ref1"), *others])))
    assert (found.pairs.missing, len(found.pairs.names), found.fre < 1e-9) == (1, 7, True)
    for code, problem in ((0, "the fit has a residual of"), (9999, "both must be in mm")):
        coded = [(*row[:4], code, code, code, "ref1") for row in rows()[:1]]
        found = read_pairs(table(tmp_path, [*rows(), *coded]))
        assert (found.coded, found.codes) == (1, (code,))
        position = rf"\({code}, {code}, {code}\)"
        with pytest.raises(InputError, match=rf"^1 of \d+ positions are exactly {position}.*; .*{problem}"):
            register(found)


def test_points_in_a_plane_get_a_note_and_a_mirrored_plate_is_refused(tmp_path, capsys):
    rng = np.random.default_rng(0)
    stage = np.column_stack([rng.uniform(-50, 50, (8, 2)), np.tile([-1.0, 1.0], 4)])
    for thick, mirrored, expected in (
        (1, True, "a mirrored frame fits far better (residual 0.08"),
        (
            0,
            False,
            "the side of the plane is unknown. If one frame is left-handed, the error is twice the distance",
        ),
    ):
        plate = stage * (1, 1, thick)
        measured = TRUE.inverse().apply(plate + rng.normal(0, 0.08, (8, 3))) * (1, 1, -1 if mirrored else 1)
        data = table(tmp_path, [(k, *plate[k], *measured[k], "ref1") for k in range(8)], name=f"{thick}.csv")
        out = tmp_path / f"{thick}.toml"
        assert (
            main(["em", "register", str(data), "--target", "0", "0", "20", "--out", str(out)]) == 2 * mirrored
        )
        assert expected in " ".join("".join(capsys.readouterr()).split())
        assert out.exists() is not mirrored


def test_rows_of_other_sensors_and_missing_samples_are_not_checked(tmp_path):
    code = 1e30
    others = [("p0", 1, 2, 3, code, code, code, "tip"), ("p1", "", 2, 3, 4, 5, 6, "tip")]
    data = [*others, *rows(0.3), ("p2", "", "", "", "", "", "", "ref1")]
    found = read_pairs(table(tmp_path, data), sensor="ref1")
    alone = read_pairs(table(tmp_path, rows(0.3), name="alone.csv"))
    np.testing.assert_array_equal(found.tracker, alone.tracker)
    np.testing.assert_array_equal(found.stage, alone.stage)
    assert (found.names, found.missing) == (alone.names, 1)


CODE = 1e30  # of a tracker, for a missing position
REFUSED = {
    "empty": ([], "has no rows"),
    "two": (rows()[:2], "2 pairs of points"),
    "incomplete": ([*rows()[:5], ("p9", 1, 2, 3, 4, "", 6, "ref1")], "line 7: x_mm, y_mm, z_mm: must all"),
    "two positions": ([*rows(), ("p0", 1, 2, 3, 4, 5, 6, "ref1")], "point p0 has several positions"),
    "two sensors": ([*rows(), *rows(sensor="tip")], "choose one with --sensor: ref1, tip"),
    "missing": ([(*row[:4], "", "", "", "ref1") for row in rows()], "no reading has a position"),
    "metres": ([(*row[:4], *(1e-3 * v for v in row[4:7]), "ref1") for row in rows()], "both must be in mm"),
    "both in metres": (
        [(row[0], *(1e-3 * v for v in row[1:7]), "ref1") for row in rows()],
        "is the unit right (--unit mm or m)?",
    ),
    "mirrored": ([(*row[:4], -row[4], *row[5:]) for row in rows()], "one of the two frames is left-handed"),
    "swapped": (
        [(*a[:4], *b[4:]) for a, b in zip(rows(), rows()[1:] + rows()[:1], strict=True)],
        "the list shifted by one (the first point of the stage is the tracker's p1)",
    ),
    "not moved": (
        [(*r[:4], 1.0 + 1e-3 * k, 2.0, 3.0 + 1e-6 * k**2, "ref1") for k, r in enumerate(rows())],
        "have moved",
    ),
    "code": (
        [*rows()[1:], (*rows()[0][:4], CODE, CODE, CODE, "ref1")],
        "line 9: x_mm, y_mm, z_mm: must be at most",
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_cannot_be_registered_is_refused(tmp_path, name, capsys):
    data, message = REFUSED[name]
    assert main(["em", "register", str(table(tmp_path, data)), "--out", str(tmp_path / "r.toml")]) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "r.toml").exists()


def test_the_command_writes_a_scenario_table_and_a_figure_and_reports_errors(tmp_path, capsys):
    data, out = table(tmp_path, [*rows(0.3), *rows(sensor="tip")]), tmp_path / "rig.toml"
    command = ["em", "register", str(data), "--sensor", "ref1", "--target", "40", "5", "0", "--out", str(out)]
    assert main([*command, "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    found = register(read_pairs(data, sensor="ref1"), [(40.0, 5.0, 0.0)])
    assert printed["fre_mm"] == found.fre
    assert printed["tre"] == [{"target_mm": [40.0, 5.0, 0.0], "tre_mm": found.tre[0]}]
    assert {path.name for path in tmp_path.glob("rig.*")} == {"rig.toml", "rig.png", "rig.svg"}
    assert tomllib.loads(out.read_text())["result"]["points"] == 8
    scenario = load_registration(out, PHANTOM)
    assert scenario.tracker.registration == found.registration
    assert main(command) == 2
    assert capsys.readouterr().err == f"flexneedle: {out}: already exists: choose another file with --out\n"


def test_a_leave_one_out_of_three_points_is_unknown_with_what_it_needs(tmp_path, capsys):
    data, out = (
        table(tmp_path, [row for row in rows() if row[0] in ("p0", "p1", "p2")]),
        tmp_path / "rig.toml",
    )
    assert main(["em", "register", str(data), "--out", str(out)]) == 0
    assert "unknown: needs four points, no three of them on a line" in capsys.readouterr().out
    assert "nan" not in out.read_text()
    assert register(read_pairs(data)).values()["left_out_rms_mm"] is None


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a = [", "not TOML"),
        ("a = 1", r"has no table \[tracker.registration\]"),
        ("tracker = 5", r"has no table \[tracker.registration\]"),
        ("[tracker.registration]\nrotation = [1, 1, 0, 0]\n", "must be a unit quaternion"),
    ],
)
def test_a_file_without_a_registration_is_refused(tmp_path, text, message):
    path = tmp_path / "r.toml"
    path.write_text(text)
    with pytest.raises(InputError, match=message):
        load_registration(path, PHANTOM)
    with pytest.raises(InputError, match="no such file"):
        load_registration(tmp_path / "none.toml", PHANTOM)


@pytest.mark.parametrize(
    ("points", "rule"),
    [
        ([[0.0, 0.0, 0.0]], "must have at least 3 entries"),
        ([[float(k), 2.0 * k, 0.0] for k in range(4)], "must not be on one line"),
        ([[1.0, 1.0, 1.0]] * 3, "must not be on one line"),
    ],
)
def test_a_scenario_refuses_degenerate_fiducials(points, rule):
    with pytest.raises(InputError, match=rule):
        PHANTOM.with_values({"tracker.registration.fiducials_mm": points})


# ---- in insertions


def rig_of(seed, **values):
    quiet = {"tracker.jitter_mm": 0.0, "phantom.missing_fraction": 0.0, "phantom.delay_periods": 0.0}
    scenario = PHANTOM.with_values({**quiet, **values})
    return virtual_rig(scenario, 1, Seeds(*map(np.random.SeedSequence, (4, 5, seed))))


def off(rig):
    """In-plane error (mm) of the tracker at rest."""
    rig.clock.wait(0.5)
    sample = rig.tracker.read()[-1]
    return np.array([sample.x, sample.y]) - rig.truth().tip[:2]


def test_an_insertion_has_the_error_of_its_registration(tmp_path):
    """Exact pairs change nothing; others add the expected error, drawn for each insertion."""
    found = register(read_pairs(table(tmp_path, rows(3.0))), [(-28.5, 0.0, 0.0)])
    registration = found.registration.model_dump(mode="json")
    world = {"tracker.environment": "ideal", "tracker.field_seed": 1}
    exact = {**registration, "localisation_mm": 0.0}
    unchanged = off(rig_of(6, **world, **{"tracker.registration": exact}))
    np.testing.assert_allclose(unchanged, off(rig_of(6, **world)), atol=0.3)
    rigs = (rig_of(seed, **world, **{"tracker.registration": registration}) for seed in range(30))
    errors = np.array([off(rig) - unchanged for rig in rigs])
    expected = found.tre[0] * np.sqrt(2.0 / 3.0)  # two of three coordinates, with about equal errors
    assert np.sqrt(np.mean(np.sum(errors**2, axis=1))) == pytest.approx(expected, rel=0.35)
