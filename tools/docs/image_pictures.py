"""Draw the picture of docs/how-to/slicer.md: docs/images/slicer.png.

    python tools/docs/image_pictures.py [--out docs/images] [--seed N]

Makes the synthetic abdomen of a seed, plans and inserts by its case, and draws two sections of the label map along the
planned path in the needle frame, with margins of zones, the straight line, and both paths.
"""

import argparse
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure

import flexneedle
from flexneedle.figures.style import ESTIMATE, INK, PLAN, TARGET, TRUE
from flexneedle.lab.images.abdomen import SEGMENTS
from flexneedle.lab.images.case_import import import_case
from flexneedle.lab.images.example import LABELS, write_example
from flexneedle.lab.images.sampling import Sampler
from flexneedle.lab.images.slicer_scene import image_frame
from flexneedle.lab.images.volumes import read_label_map
from flexneedle.simulator.zones import zones_of

_COLOURS = (
    "#ffffff",
    "#8a6a52",
    "#f1dfa5",
    "#d79a8d",
    "#b9785f",
    "#e4d5cd",
    "#f7f3e8",
    "#4f6fb0",
    "#6da36d",
    "#6da36d",
)
_BESIDE, _DEEPEST = 32.0, 75.0


def section(sampler, axis, path):
    """Return labels and points (depths, lateral) of the section along a path (n, 3), across one lateral axis."""
    depths, lateral = np.arange(-8.0, _DEEPEST, 0.25), np.arange(-_BESIDE, _BESIDE, 0.25)
    points = np.zeros((len(depths), len(lateral), 3))
    points[..., 0], points[..., 1 + axis] = depths[:, None], lateral
    points[..., 2 - axis] = np.interp(depths, path[:, 0], path[:, 2 - axis])[:, None]
    over = [each for each in SEGMENTS if each.layer == 1]
    under = [each for each in SEGMENTS if each.layer == 0]
    found = sampler.which([[each] for each in (*over, *under)], points)
    order = np.array([*(len(under) + 1 + k for k in range(len(over))), *range(1, len(under) + 1), 0])
    return order[found], points


def draw(axes, axis, sampler, insertion):
    """Draw one section."""
    plan, scenario = insertion.plan, insertion.scenario
    labels, points = section(sampler, axis, plan.tips)
    extent = (-8.0, _DEEPEST, -_BESIDE, _BESIDE)
    axes.imshow(
        labels.T, origin="lower", extent=extent, cmap=ListedColormap(_COLOURS), vmin=-0.5, vmax=9.5, alpha=0.8
    )
    zones = zones_of(scenario)
    clear = zones.clearances(points.reshape(-1, 3)).min(axis=0).reshape(points.shape[:2])
    clear[~np.isfinite(clear)] = 50.0
    radius = zones.radius
    axes.contour(
        points[:, 0, 0],
        points[0, :, 1 + axis],
        clear.T + radius,
        [zones.margin + radius],
        colors=[TRUE],
        linewidths=1.0,
    )
    axes.plot(
        [0.0, plan.target[0]], [0.0, plan.target[1 + axis]], ":", color=INK, lw=1.2, label="straight line"
    )
    axes.plot(plan.tips[:, 0], plan.tips[:, 1 + axis], "--", color=PLAN, lw=1.5, label="planned path")
    shape = np.asarray(insertion.periods[-1].shape)
    axes.plot(shape[:, 0], shape[:, 1 + axis], "-", color=ESTIMATE, lw=1.8, label="needle at the end")
    axes.plot(*np.array(plan.target)[[0, 1 + axis]], "x", color=TARGET, ms=8, mew=2, label="target")
    axes.plot([], [], "-", color=TRUE, lw=1.0, label="ribs and vessels with their margins")
    axes.set(xlim=extent[:2], ylim=extent[2:], xlabel="depth (mm)", ylabel=f"{'yz'[axis]} (mm)")
    if axis == 0:
        for x, name in ((5.0, "fat"), (14.0, "muscle"), (45.0, "liver")):
            axes.text(x, -26.0, name, rotation=90 if x < 20 else 0, ha="center", va="center", fontsize=8)


def main(argv=None):
    """Draw the picture."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("docs/images"))
    parser.add_argument("--seed", type=int, default=1)
    args = parser.parse_args(argv)
    with TemporaryDirectory() as folder:
        case = write_example(Path(folder), args.seed, (1.0, 1.0, 1.0))[2]
        scenario = import_case(case).scenario
        plan = flexneedle.plan(scenario)
        insertion = flexneedle.insert(plan.scenario, plan, force=True)
        sampler = Sampler(read_label_map(Path(folder) / LABELS), image_frame(scenario).inverse())
        figure = Figure(figsize=(9.0, 4.4), layout="constrained")
        both = figure.subplots(1, 2)
        for axis, axes in enumerate(both):
            draw(axes, axis, sampler, insertion)
        figure.legend(
            *both[0].get_legend_handles_labels(), loc="outside lower center", ncols=3, frameon=False
        )
        figure.savefig(args.out / "slicer.png", dpi=100)


if __name__ == "__main__":
    main()
