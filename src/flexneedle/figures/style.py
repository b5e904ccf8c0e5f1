"""Style and saving of all figures: the same bytes for the same data, whatever the user's settings."""

import os
import sys
import warnings
from base64 import b64encode
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from io import BytesIO
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patheffects import AbstractPathEffect, withStroke
from matplotlib.transforms import Bbox

from flexneedle.errors import InputError, describe_error
from flexneedle.files import replace_file
from flexneedle.types import Z

_WINDOWS = ("macosx", "qtagg", "gtk4agg", "gtk3agg", "tkagg", "wxagg")  # backends, in the order of pyplot
WIDTH = 9.0  # inches; shown 900 pixels wide, a point is 1.4 pixels
COLUMN = 5.5  # inches; a narrower figure is one of a journal's column, with all parts one below another
NARROW = 8.0  # inches; narrower figures have no room for names beside their panels
_widths = [WIDTH]  # the last one is in use

# Okabe and Ito's colours, which the colour-blind can distinguish, each with its own line style or marker.
INK, QUIET = "#222222", "#6b6b6b"
PLAN, ESTIMATE, TRUE, MEASURED, TARGET, BAD = "#222222", "#0072B2", "#D55E00", "#A8437F", "#00734f", "#B03A00"
ZONE = "#6A4C93"
NEEDLE, GUIDE = "#8a8f98", "#4d535c"
BOX = {"facecolor": "white", "alpha": 0.7, "linewidth": 0.0, "pad": 0.6}
"""Light box behind a text, as its `bbox`."""
STRATEGIES = ("#0072B2", "#D55E00", "#009E73", "#CC79A7")

# The colour of z in space, beside the colour of y.
_SECOND = {
    PLAN: "#8a8a8a",
    ESTIMATE: "#56B4E9",
    TRUE: "#E69F00",
    MEASURED: "#CC79A7",
    "#009E73": "#7fcfb4",
    "#CC79A7": "#e3b8d0",
}

_SETTINGS: Any = {
    "font.size": 8.5,
    "axes.titlesize": 8.5,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.titlepad": 4.0,
    "axes.labelsize": 8.5,
    "axes.edgecolor": QUIET,
    "axes.linewidth": 0.7,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.unicode_minus": True,
    "xtick.labelsize": 8,
    "ytick.labelsize": 8,
    "xtick.color": QUIET,
    "ytick.color": QUIET,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "text.color": INK,
    "text.parse_math": False,  # a scenario may be called "$5 phantom"
    "legend.fontsize": 8,
    "legend.frameon": False,
    "lines.linewidth": 1.4,
    "lines.solid_capstyle": "round",
    "figure.facecolor": "white",
    "savefig.facecolor": "white",
    "svg.hashsalt": "flexneedle",
    # Text stays text, and fonts of PDF files are TrueType, as journals require.
    "svg.fonttype": "none",
    "pdf.fonttype": 42,
    "ps.fonttype": 42,
}


# On a journal's page, where figures are not reduced: 7 to 8 points.
_COLUMN_SETTINGS: Any = {
    "font.size": 7.5,
    "axes.titlesize": 7.5,
    "axes.labelsize": 7.5,
    "xtick.labelsize": 7,
    "ytick.labelsize": 7,
    "legend.fontsize": 7,
    "lines.linewidth": 1.1,
}


@contextmanager
def figures_of_width(inches: float) -> Iterator[None]:
    """Make figures of this width inside the block."""
    _widths.append(inches)
    try:
        yield
    finally:
        _widths.pop()


def width() -> float:
    """Return the width (inches) of new figures."""
    return _widths[-1]


def is_column() -> bool:
    """Return whether new figures are for a journal's column."""
    return width() < COLUMN


def is_narrow() -> bool:
    """Return whether new figures have the names of lines above their panels, not beside them."""
    return width() < NARROW


def small() -> float:
    """Return the font size of names inside a panel."""
    return 7.0 if is_narrow() else 8.0


def halo(width: float) -> list[AbstractPathEffect]:
    """Return the path effects of a mark on a white rim of this width (points)."""
    return [withStroke(linewidth=width, foreground="white")]


def tone(color: str, axis: int) -> str:
    """Return the colour of a line along y, or its lighter variant for a line along z."""
    return _SECOND[color] if axis == Z else color


def format_signed(value: float, form: str = "g") -> str:
    """Return a number as text with a true minus sign."""
    return f"{value:{form}}".replace("-", "−")


@contextmanager
def apply_style() -> Iterator[None]:
    """Use this module's style inside the block, not the user's matplotlibrc."""
    with matplotlib.rc_context(), warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Glyph")  # a name in a script that the font lacks
        matplotlib.rcdefaults()
        matplotlib.rcParams.update(_SETTINGS | (_COLUMN_SETTINGS if is_narrow() else {}))
        yield


class StyledFigure(Figure):
    """A figure without pyplot, which is saved in this module's style and shown by notebooks."""

    def savefig(self, *given: Any, **options: Any) -> None:
        """Save the figure as matplotlib does, with this module's fonts."""
        with apply_style():
            super().savefig(*given, **options)

    def _repr_png_(self) -> bytes:
        """Return the picture for a notebook."""
        sink = BytesIO()
        self.savefig(sink, format="png")
        return sink.getvalue()

    def show(self, warn: bool = True) -> None:  # noqa: ARG002  as matplotlib's
        """Show the figure in the notebook, or in a window until it is closed.

        Raises InputError where no window can be opened.
        """
        if (shell := _notebook()) is not None:
            shell.display_pub.publish({"image/png": b64encode(self._repr_png_()).decode()})
            return
        why = "neither Qt, GTK, Tk nor wx is installed" if _has_display() else "no display"
        for name in _WINDOWS if _has_display() else ():
            try:
                canvas: Any = import_module(f"matplotlib.backends.backend_{name}").FigureCanvas
                canvas.new_manager(self, 1).show()
            except ImportError:
                continue
            except Exception as error:  # noqa: BLE001  whatever a toolkit raises without a display
                why = describe_error(error)
                continue
            canvas.manager_class.start_main_loop()
            FigureCanvasAgg(self)
            return
        raise InputError(f'no window can be opened ({why}): save the figure, as figure.savefig("needle.png")')


def _notebook() -> Any:
    """Return the shell of the notebook in which this process runs, or None."""
    shell = sys.modules["IPython"].get_ipython() if "IPython" in sys.modules else None
    return shell if hasattr(shell, "kernel") else None


def _has_display() -> bool:
    return sys.platform == "darwin" or any(map(os.environ.get, ("DISPLAY", "WAYLAND_DISPLAY")))


def new_figure(height: float) -> StyledFigure:
    """Return an empty figure of this height (inches), with automatic layout."""
    figure = StyledFigure(figsize=(width(), height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def settle(figure: Figure) -> None:
    """Arrange the parts of a figure and fix them, rounded: the solver's last digits differ between runs."""
    engine = figure.get_layout_engine()
    if engine is not None and figure.axes:
        engine.execute(figure)
    figure.set_layout_engine(None)  # "none" would lay out again before each file
    for part in figure.subfigs:
        part.bbox_relative.p0, part.bbox_relative.p1 = np.round(part.bbox_relative.get_points(), 6)
    for ax in figure.axes:
        ax.set_position(Bbox(np.round(ax.get_position(original=True).get_points(), 6)))


def save(figure: Figure, folder: Path, name: str) -> list[Path]:
    """Write `name`.png and `name`.svg into the folder, without date or version; return the paths."""
    paths = [folder / f"{name}.png", folder / f"{name}.svg"]
    plain: tuple[dict[str, Any], ...] = ({"Software": None}, {"Date": None, "Creator": "flexneedle"})
    with apply_style():
        settle(figure)
        for path, metadata in zip(paths, plain, strict=True):
            sink = BytesIO()
            figure.savefig(sink, format=path.suffix[1:], dpi=200, metadata=metadata)
            replace_file(path, sink.getvalue())
    return paths
