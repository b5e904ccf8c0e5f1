"""Rows of studies made up by hand, as `flexneedle study` writes them: plausible to look at, quick to make."""

import json
from itertools import product

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from flexneedle.control.controllers import DEFAULT, check_tables
from flexneedle.scenario.files import load_scenario

TARGETS = tuple((depth, lateral) for depth in (25.0, 30.0, 35.0, 40.0, 45.0) for lateral in (-5.0, 0.0, 5.0))
OURS = DEFAULT
CONTROLLERS = {  # median error in mm
    OURS: 0.06,
    "open-loop": 0.7,
    "bevel-only": 0.55,
    "resolved-rate": 0.11,
    "broyden-mpc": 0.28,
    "ce-mpc": 0.24,
}
BASE = check_tables(load_scenario("phantom")).flat()
VERSIONS = {"flexneedle": "0.3.0", "python": "3.11.9", "numpy": "2.4.0", "numba": "0.68.0"}


def make_rows(controllers=(OURS,), cases=None, axes=None, targets=TARGETS, repeats=10, grow=None, seed=0):
    """Return rows (dicts): cases vary slowest, then controllers, axes, targets, repeats, as in a study.

    cases: {name: {dotted key: value}}; axes: {dotted key, or several joined by "+": values};
    grow(settings): factor of the errors. Every target and repeat has a separate seed, the same elsewhere.
    """
    cases, axes = cases or {"": {}}, axes or {}
    grid = product(cases, controllers, product(*axes.values()))
    rows = []
    for case, controller, chosen in grid:
        settings = dict(cases[case])
        for keys, value in zip(axes, chosen, strict=True):
            settings |= zip(keys.split("+"), value if "+" in keys else (value,), strict=True)
        factor = grow(settings | {"case": case, "controller": controller}) if grow else 1.0
        for number, target in enumerate(targets):
            for repeat in range(repeats):
                own = number * repeats + repeat
                rows.append(one_row(len(rows), case, controller, settings, target, own, repeat, factor, seed))
    return rows


def one_row(index, case, controller, settings, target, own, repeat, factor, seed):
    """Return one row; what is random depends on its seed and its controller, part of it on the seed alone."""
    shared = np.random.default_rng((seed, own))
    rng = np.random.default_rng((seed, own, *controller.encode()))
    depth, lateral = target
    error = CONTROLLERS.get(controller, 0.1) * factor * np.exp(0.35 * shared.normal() + 0.3 * rng.normal())
    error *= 0.7 + 0.3 * (depth - 20.0) / 15.0
    angle = rng.uniform(0.0, 2 * np.pi)
    planned = 0.4 + 0.03 * depth + 0.1 * abs(lateral)
    energy = planned * np.exp(0.25 * rng.normal() + 0.15 * np.log1p(error))
    periods = round(depth + 28.5)
    values = BASE | {"target.depth_mm": depth, "target.lateral_mm": lateral} | settings
    return {
        "index": index,
        "case": case,
        **{key: value for key, value in values.items() if key != "name"},
        "controller": controller,
        "plant": values.get("plant", "exact"),
        "strategy": "manipulation",
        "target_depth_mm": depth,
        "target_lateral_mm": lateral,
        "seed": own,
        "plan_seed": 0,
        "repeat": repeat,
        "plan": f"plan-{depth:g}-{lateral:g}",
        "true_error_mm": float(error),
        "residual_mm": float(error * 0.8 + 0.03),
        "tip_x_mm": depth + float(0.3 * error * np.cos(angle)),
        "tip_y_mm": lateral + float(error * np.sin(angle)),
        "flips": int(rng.integers(0, 4)),
        "planned_flips": int(shared.integers(0, 2)),
        "strain_energy_mj": float(energy),
        "planned_strain_energy_mj": float(planned),
        "planned_error_mm": 0.01,
        **{
            f"{of}_energy_uj": 1e3 * float(energy) * part
            for of, part in (("peak", 1.5), ("mean", 0.5), ("end", 1.0))
        },
        "planned_peak_energy_uj": 1e3 * float(planned),
        "planned_mean_energy_uj": 0.5e3 * float(planned),
        "energy_scale_uj": 4e3,
        "guide_travel_mm": float(3 + rng.random()),
        "planned_guide_travel_mm": 2.0,
        "least_stretch": 0.8,
        "periods": periods + int(rng.integers(0, 3)),
        "planned_periods": periods,
        "unconverged_periods": 0,
        "outcome": "done",
        "reason": "",
        **{f"version_{name}": text for name, text in VERSIONS.items()},
    }


def unfinished(row, outcome="held", reason="held for 1.03 s (limit 1.00 s): missing: no reading"):
    """Return the row as one of an insertion that did not finish."""
    nothing = ("true_error_mm", "residual_mm", "tip_x_mm", "tip_y_mm", "flips", "strain_energy_mj", "periods")
    unknown = dict.fromkeys(nothing) if outcome in ("refused", "error") else {}
    return row | unknown | {"outcome": outcome, "reason": reason}


def columns_of(rows):
    """Return rows as columns; a key that a row lacks is null."""
    return {key: [row.get(key) for row in rows] for key in dict.fromkeys(key for row in rows for key in row)}


def asked(rows, **more):
    """Return the study of `study.json` for rows of any controllers, cases and targets; `more`: such as its axes."""
    targets = dict.fromkeys((row["target_depth_mm"], row["target_lateral_mm"]) for row in rows)
    axes = {"controller": list(dict.fromkeys(row["controller"] for row in rows)), "target": list(targets)}
    cases = {row["case"]: {} for row in rows if row["case"]}
    study = {"name": "mine", "title": "Mine", "cases": cases, "axes": axes, "insertions": len(rows)}
    return study | more | {"axes": axes | more.get("axes", {})}


def write_study(folder, rows, about=None, **more):
    """Write the folder of a study, and return it. about: `study.json`; without it the one of `asked(rows, **more)`."""
    folder.mkdir(parents=True, exist_ok=True)
    pq.write_table(pa.table(columns_of(rows)), folder / "runs.parquet")
    (folder / "study.json").write_text(json.dumps(about or {"study": asked(rows, **more)}))
    return folder
