"""Names of air, skin and layers, each where nothing is drawn; the legend names layers without such a place."""

from collections.abc import Iterator, Sequence
from textwrap import wrap
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.path import Path
from matplotlib.quiver import Quiver
from matplotlib.transforms import Affine2D, Bbox

from flexneedle.figures.layout import MOVABLE, TALLEST, fit, legend_of, short
from flexneedle.figures.scene import SKIN, Strip, strips
from flexneedle.figures.style import QUIET, is_column, small
from flexneedle.scenario.model import Scenario

_NAME = "#6d4526"
_GID = "tissue"
_TISSUE = 2  # zorder from which artists are no tissue
_ROOM = 2.0  # points around a name
_MOST_LAYERS, _LONGEST, _LINE = 10, 40, 120  # layers at the foot; characters of a name, of a line
_BOTTOM, _TOP = (4, 0.0, "bottom"), (-3, 1.0, "top")  # distance (points), height in the axes, alignment
Place = tuple[int, float, str]


def name_parts(
    figure: Figure,
    scenes: Sequence[Axes],
    shown: Sequence[Axes],
    scenario: Scenario,
    facts: Sequence[str] = (),
) -> None:
    """Arrange a figure and name its parts.

    The legend at the foot names what the axes `shown` have, below lines of facts and the layers without room in the
    scenes.
    """
    legend_of(figure, shown, facts)
    figure.draw_without_rendering()
    for ax in scenes:
        _move_texts(ax)
    left_out: set[Strip] = set()
    while not (found := {strip for ax in scenes for strip in _name_scene(ax, scenario)}) <= left_out:
        left_out |= found
        _name_below(figure, shown, facts, sorted(left_out, key=lambda strip: strip.top))
        figure.draw_without_rendering()


def _move_texts(ax: Axes) -> None:
    """Move texts that may be moved to a place in the axes over no other text, if there is one."""
    for text in [text for text in ax.texts if text.get_gid() == MOVABLE]:
        taken = [other.get_window_extent() for other in ax.texts if other is not text]
        _, up = first = text.get_position()
        for place in (first, (0, -up), (30, up), (-30, up), (30, -up), (-30, -up)):
            text.set_position(place)
            box = text.get_window_extent()
            within = ax.bbox.y0 <= box.y0 and box.y1 <= ax.bbox.y1
            if within and not any(box.overlaps(other) for other in taken):
                break
        else:
            text.set_position(first)


def _name_below(figure: Figure, shown: Sequence[Axes], facts: Sequence[str], layers: Sequence[Strip]) -> None:
    """Name layers in the legend, in a figure that is higher by their lines."""
    (before,) = figure.legends
    legend_of(figure, shown, [*facts, *_list_layers(layers)])
    added = figure.legends[1].get_window_extent().height - before.get_window_extent().height
    before.remove()
    height = figure.get_figheight() + added / figure.dpi
    figure.set_figheight(min(height, TALLEST) if is_column() else height)


def _name_scene(ax: Axes, scenario: Scenario) -> Iterator[Strip]:
    """Write the names of air, skin and layers; yield the layers whose name has no room."""
    for text in [text for text in ax.texts if text.get_gid() == _GID]:
        text.remove()
    drawn = list(_obstacles(ax))
    left = ax.get_xlim()[0]
    _write(ax, ["skin"], 0.0, "right", SKIN, (_TOP, _BOTTOM), drawn)
    _write(ax, ["air"], left, "left", QUIET, (_BOTTOM, _TOP), drawn)
    for strip in strips(ax, scenario):
        texts = [
            f"{strip.name}, {strip.modulus}",
            *([] if is_column() else [f"{strip.name}\n{strip.modulus}"]),
        ]
        if not _write(ax, texts, strip.top, "left", _NAME, (_BOTTOM, _TOP), drawn, strip.bottom):
            yield strip


def _write(
    ax: Axes,
    texts: Sequence[str],
    x: float,
    side: str,
    color: str,
    places: Sequence[Place],
    drawn: list[Path],
    end: float | None = None,
) -> bool:
    """Write the first text that fits beside x (mm), before `end` and over nothing drawn; return whether one does."""
    right = ax.bbox.x1 if end is None else ax.transData.transform((end, 0.0))[0]
    for text in texts:
        for up, y, edge in places:
            beside = 4 if side == "left" else -4
            how: dict[str, Any] = {"ha": side, "va": edge, "color": color, "fontsize": small(), "gid": _GID}
            made = ax.annotate(
                text, (x, y), (beside, up), ax.get_xaxis_transform(), textcoords="offset points", **how
            )
            box = made.get_window_extent().padded(_ROOM)
            inside = ax.bbox.x0 <= box.x0 and box.x1 <= right + _ROOM
            if inside and not any(path.intersects_bbox(box, filled=False) for path in drawn):
                drawn.append(_rectangle(box))
                return True
            made.remove()
    return False


def _obstacles(ax: Axes) -> Iterator[Path]:
    """Yield the paths (pixels) of all that is drawn over the tissue."""
    drawn: tuple[Line2D | Patch, ...] = (*ax.lines, *ax.patches)
    for artist in drawn:
        if artist.get_zorder() >= _TISSUE:
            yield artist.get_transform().transform_path(artist.get_path())
    for group in ax.collections:
        places = (
            group.get_offset_transform().transform(group.get_offsets())
            if isinstance(group, Quiver)
            else [(0, 0)]
        )
        transform = group.get_transform()
        for path, place in zip(group.get_paths(), places, strict=False):
            yield Affine2D().translate(*place).transform_path(transform.transform_path(path))
    yield from (_rectangle(text.get_window_extent()) for text in ax.texts)


def _rectangle(box: Bbox) -> Path:
    return Path([(box.x0, box.y0), (box.x1, box.y0), (box.x1, box.y1), (box.x0, box.y1), (box.x0, box.y0)])


def _list_layers(layers: Sequence[Strip]) -> list[str]:
    """Return lines of the layers' names, in order of depth."""
    named = [f"{each.depths} {short(each.name, _LONGEST)}, {each.modulus}" for each in layers[:_MOST_LAYERS]]
    more = [f"{len(layers) - _MOST_LAYERS} more layers"] if len(layers) > _MOST_LAYERS else []
    return wrap("; ".join([*named, *more]), fit(_LINE))
