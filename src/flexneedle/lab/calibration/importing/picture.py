"""The picture of a session: paths of the tip and positions of the guide over depth, on each lateral axis."""

from io import BytesIO
from pathlib import Path

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from flexneedle.figures.layout import legend_of, short
from flexneedle.figures.style import QUIET, apply_style, new_figure, settle
from flexneedle.files import replace_file
from flexneedle.lab.calibration.importing.summary import count_insertions
from flexneedle.lab.calibration.session import Session

PICTURE_FILE = "session.png"
GUIDE_STYLES = {"before": "steps-pre", "with": "default", "after": "steps-post"}
"""Style of the guide's line over depth by `Session.guide_order`."""
_HEIGHTS = (2.6, 1.5)  # inches: tip, guide
_MARGINS = 1.2
_MOST_STEPS = 200  # that are drawn of a path
_LABEL = 40  # characters
_NAMED = 8  # insertions that the legend names: all, or as many evenly from the first to the last
_LIGHTEST = 0.9  # of the map of colours


def draw_session(session: Session) -> Figure:
    """Return the figure: rows for tip and guide, columns for the lateral axes, a colour for each insertion."""
    with apply_style():
        figure = new_figure(sum(_HEIGHTS) + _MARGINS)
        panels = figure.subplots(
            2, session.axes, squeeze=False, sharex=True, sharey="row", height_ratios=_HEIGHTS
        )
        for axis, (tip, guide) in enumerate(panels.T):
            _draw(tip, session, "position", axis)
            _draw(guide, session, "guide", axis)
            name = "yz"[axis]
            tip.set_title(f"Tip along {name}")
            guide.set_title(f"Guide along {name}")
            guide.set_xlabel("depth of the tip (mm)")
        for row in panels:
            row[0].set_ylabel("lateral offset (mm)")
        figure.suptitle(
            f"Recorded: {count_insertions(session)}", x=0.01, ha="left", fontsize=11, weight="bold"
        )
        legend_of(figure, [panels[0, 0]])
        for handle in filter(None, figure.legends[0].legend_handles):
            handle.set_alpha(1.0)
    return figure


def _draw(ax: Axes, session: Session, quantity: str, axis: int) -> None:
    ax.axvline(0.0, color="#8c5a36", linewidth=1.0, zorder=1)
    ax.axhline(0.0, color=QUIET, linewidth=0.6, zorder=1)
    alpha = float(np.clip(20.0 / len(session.recordings), 0.35, 0.9))
    last = len(session.recordings) - 1
    named = np.linspace(0, last, min(_NAMED, last + 1)).astype(int)
    steps = GUIDE_STYLES[session.guide_order] if quantity == "guide" else "default"
    for number, one in enumerate(session.recordings):
        kept = np.unique(np.linspace(0, len(one.depth) - 1, _MOST_STEPS).astype(int))
        (line,) = ax.plot(one.depth[kept], getattr(one, quantity)[kept, axis], drawstyle=steps, zorder=3)
        line.set(linewidth=1.0, alpha=alpha, color=colormaps["viridis"](_LIGHTEST * number / max(1, last)))
        if number in named:
            line.set_label(short(f"{one.session}/{one.name}", _LABEL))
    ax.margins(x=0.01)
    low, high = ax.get_ylim()
    if high - low < 1.0:
        ax.set_ylim(0.5 * (low + high) - 0.5, 0.5 * (low + high) + 0.5)


def save_picture(figure: Figure, folder: Path) -> None:
    """Write `session.png` into the folder of a session."""
    sink = BytesIO()
    with apply_style():
        settle(figure)
        figure.savefig(sink, format="png", dpi=200, metadata={"Software": None})
    replace_file(folder / PICTURE_FILE, sink.getvalue())
