"""Evidence of the test of the axes: a folder with its findings, all readings, and a picture."""

import csv
from collections.abc import Sequence
from io import StringIO
from math import ceil
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from flexneedle.errors import InputError
from flexneedle.figures.style import ESTIMATE, MEASURED, QUIET, TARGET, apply_style, new_figure, save
from flexneedle.files import create_folder, replace_file
from flexneedle.lab.rig.preflight.axis_test import AxisRun, MotorHistory
from flexneedle.lab.rig.preflight.rig_check import Finding
from flexneedle.lab.rig.rig_file import RigFile
from flexneedle.record.plain import to_text

RESULT, READINGS, FIGURE = "test.json", "readings.csv", "axes"
_COLORS = (ESTIMATE, MEASURED, TARGET)
_ROW, _COLUMNS = 2.2, 2  # height of a row (inches)


def create_evidence(rig: RigFile, out: Path | None) -> Path:
    """Create and return the folder. Raises InputError if it cannot be created or holds another test."""
    if out is None:
        return create_folder("rig-test", rig.name)
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{out}: cannot be created: {error.strerror}: choose another --out") from None
    if (out / RESULT).exists():
        raise InputError(f"{out}: already contains {RESULT}: choose another folder")
    return out


def write_evidence(
    folder: Path, rig: RigFile, runs: Sequence[AxisRun], motors: MotorHistory, findings: Sequence[Finding]
) -> None:
    """Write findings, rig file, readings and picture."""
    lines = [
        {"part": one.part, "item": one.item, "found": one.found, "problem": one.problem or None}
        for one in findings
    ]
    ok = not any(one.problem for one in findings)
    values = {"ok": ok, "findings": lines, "rig": rig.model_dump(mode="json")}
    replace_file(folder / RESULT, to_text(values).encode())
    replace_file(folder / READINGS, _format_readings(runs, motors).encode())
    save(draw_axes(runs, motors), folder, FIGURE)


def _format_readings(runs: Sequence[AxisRun], motors: MotorHistory) -> str:
    text = StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(("axis", "time_s", "axis_mm_or_deg", "x_mm", "y_mm", "z_mm"))
    for run in runs:
        at = motors.at(run.name, run.times) / run.plan.move.axis.size
        for time, position, tip in zip(run.times, at, run.tips, strict=True):
            table.writerow((run.name, f"{time:.4f}", f"{position:.5f}", *(f"{one:.4f}" for one in tip)))
    return text.getvalue()


def draw_axes(runs: Sequence[AxisRun], motors: MotorHistory) -> Figure:
    """Return the figure: for each axis the motion of the tip over the motion of the axis."""
    with apply_style():
        figure = new_figure(_ROW * ceil(len(runs) / _COLUMNS))
        panels = figure.subplots(ceil(len(runs) / _COLUMNS), _COLUMNS, squeeze=False).ravel()
        for panel, run in zip(panels, runs, strict=False):
            _draw_run(panel, run, motors)
        for panel in panels[len(runs) :]:
            panel.set_axis_off()
    return figure


def _draw_run(panel: Axes, run: AxisRun, motors: MotorHistory) -> None:
    axis, first = run.plan.move.axis, run.rests[0]
    at = (motors.at(run.name, run.times) - first.positions[run.name]) / axis.size
    rests = [(rest.positions[run.name] - first.positions[run.name]) / axis.size for rest in run.rests]
    tips = np.array([rest.tip for rest in run.rests]) - first.tip
    if axis.unit == "mm":
        panel.axline((0.0, 0.0), slope=1.0, color=QUIET, linewidth=0.7)
    for column, color in enumerate(_COLORS):
        panel.plot(at, run.tips[:, column] - first.tip[column], ".", color=color, markersize=1.5, alpha=0.3)
        panel.plot(rests, tips[:, column], "o-", color=color, markersize=4, label="xyz"[column])
    panel.set(title=run.name, xlabel=f"motor ({axis.unit})", ylabel="tip (mm)")
    panel.legend(ncols=3)
