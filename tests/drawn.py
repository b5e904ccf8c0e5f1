"""Contents of a figure: its texts, lines and axes, and the texts that overlap."""

from contextlib import contextmanager
from itertools import combinations
from unittest.mock import patch

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.text import Text


@contextmanager
def unarranged():
    """Make figures without arranging their parts, which takes most of the time: for tests of artists alone."""
    with patch.object(Figure, "draw_without_rendering"):
        yield


def texts(figure):
    found = (text.get_text().strip() for text in figure.findobj(Text) if text.get_visible())
    return [text for text in found if text]


def lines(ax, label):
    return [line for line in ax.get_lines() if line.get_label() == label]


def axes(figure, *names):
    """Return the axes with these names."""
    named = {ax.get_label(): ax for ax in figure.axes}
    return [named[name] for name in names]


def names(legend):
    return [text.get_text() for text in legend.get_texts()]


def invisible_ticks(figure):
    """Return the labels of ticks beyond the ends of their axes, which are not drawn."""
    sides = [axis for ax in figure.findobj(Axes) for axis in (ax.xaxis, ax.yaxis)]
    ticks = [(tick, sorted(axis.get_view_interval())) for axis in sides for tick in axis.get_major_ticks()]
    return {tick.label1 for tick, (low, high) in ticks if not low <= tick.get_loc() <= high}


def overlapping(figure):
    """Return pairs of visible texts whose boxes overlap, and texts that leave the figure."""
    renderer = figure.canvas.get_renderer()
    figure.draw_without_rendering()
    unmeasured = invisible_ticks(figure)
    shown = [
        t for t in figure.findobj(Text) if t.get_visible() and t.get_text().strip() and t not in unmeasured
    ]
    boxes = [(text.get_text(), Text.get_window_extent(text, renderer)) for text in shown]  # without arrows
    cut = [name for name, box in boxes if not (figure.bbox.x0 <= box.x0 and box.x1 <= figure.bbox.x1)]
    cut += [name for name, box in boxes if not (figure.bbox.y0 <= box.y0 and box.y1 <= figure.bbox.y1)]
    return cut + [(a, b) for (a, one), (b, two) in combinations(boxes, 2) if one.overlaps(two)]
