"""The picture of a session: paths of the tip and positions of the guide over depth, on each lateral axis."""

from collections.abc import Sequence
from io import BytesIO
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from flexneedle.figures.layout import legend_of, look, short
from flexneedle.figures.style import QUIET, apply_style, new_figure, settle
from flexneedle.files import replace_file
from flexneedle.lab.calibration.session import Recording, Session

PICTURE_FILE = "session.png"
_HEIGHTS = (2.6, 1.5)  # inches: tip, guide
_MARGINS = 1.2
_MOST_STEPS = 200  # that are drawn of a path
_LABEL = 40  # characters
_COLORS, _STYLES = 7, ("-", "--", ":")  # colours after which the style of the line changes


def draw_session(session: Session) -> Figure:
    """Return the figure: rows for tip and guide, columns for the lateral axes, a colour for each session."""
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
        counts = (len(session.recordings), "insertion"), (len(session.names), "session")
        shown = " in ".join(f"{count} {noun}{'s' * (count > 1)}" for count, noun in counts)
        figure.suptitle(f"Recorded: {shown}", x=0.01, ha="left", fontsize=11, weight="bold")
        legend_of(figure, [panels[0, 0]])
        for handle in filter(None, figure.legends[0].legend_handles):
            handle.set_alpha(1.0)
    return figure


def _draw(ax: Axes, session: Session, quantity: str, axis: int) -> None:
    ax.axvline(0.0, color="#8c5a36", linewidth=1.0, zorder=1)
    ax.axhline(0.0, color=QUIET, linewidth=0.6, zorder=1)
    alpha = float(np.clip(8.0 / len(session.recordings), 0.35, 0.9))
    for number, name in enumerate(session.names):
        shown = [one for one in session.recordings if one.session == name]
        depth, across = _lines(shown, quantity, axis)
        label = f"{short(name, _LABEL)} ({len(shown)})"
        style = _STYLES[number // _COLORS % len(_STYLES)]
        ax.plot(
            depth, across, style, color=look(number).color, linewidth=1.0, alpha=alpha, label=label, zorder=3
        )
    ax.margins(x=0.01)
    low, high = ax.get_ylim()
    if high - low < 1.0:
        ax.set_ylim(0.5 * (low + high) - 0.5, 0.5 * (low + high) + 0.5)


def _lines(recordings: Sequence[Recording], quantity: str, axis: int) -> tuple[list[float], list[float]]:
    """Return one line through all paths, with gaps between them, of at most `_MOST_STEPS` steps each."""
    depth, across = list[float](), list[float]()
    for one in recordings:
        kept = np.unique(np.linspace(0, len(one.depth) - 1, _MOST_STEPS).astype(int))
        depth += [*one.depth[kept].tolist(), np.nan]
        across += [*getattr(one, quantity)[kept, axis].tolist(), np.nan]
    return depth, across


def save_picture(figure: Figure, folder: Path) -> None:
    """Write `session.png` into the folder of a session."""
    sink = BytesIO()
    with apply_style():
        settle(figure)
        figure.savefig(sink, format="png", dpi=200, metadata={"Software": None})
    replace_file(folder / PICTURE_FILE, sink.getvalue())
