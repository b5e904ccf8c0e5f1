"""Case file: how a label map and markups become a scenario. A path in it is from the folder of the file."""

from pathlib import Path
from typing import Annotated, Any

from pydantic import AfterValidator, ConfigDict, Field

from flexneedle.arguments import expand_home
from flexneedle.scenario.library import Library
from flexneedle.scenario.sections.apparatus import STEEPEST_MRAD
from flexneedle.scenario.sections.fields import NonNegative, Positive, Section, Title, one_line

CASES = Library("a case file")
"""Case files; none comes with the package."""

PathText = Annotated[str, Field(max_length=1000), AfterValidator(one_line)]
Names = Annotated[tuple[Title, ...], Field(strict=False, min_length=1, max_length=1_000)]


class LayerChoice(Section):
    """One `[[layer]]`: segments that are one layer of tissue, with any other key of a `[[tissue]]`.

    Where segments of several layers overlap, the first `[[layer]]` counts.
    """

    model_config = ConfigDict(extra="allow")

    segments: Names
    """Names of its segments, such as `["skin", "fat"]`."""
    tissue: Title | None = None
    """Name of the `[[tissue]]` of `scenario` whose values it has, except those given here. Not set: the one that
    is named as a segment, if there is one."""

    @property
    def values(self) -> dict[str, Any]:
        """Values of the `[[tissue]]` by key."""
        return dict(self.model_extra or {})


class ZoneChoice(Section):
    """One `[[zone]]`: a segment that the needle must not touch."""

    segment: Title
    """Name of the segment."""
    margin_mm: NonNegative | None = None
    """Margin of this zone. Not set: `zones.margin_mm` of `scenario`."""


class ImageCase(Section):
    """An insertion by an image."""

    name: Title | None = None
    """Title in tables and figures. Not set: the name of the file."""
    scenario: PathText
    """Preset name or path of a scenario, from which all that is not set here is taken."""
    labels: PathText
    """Path of the label map (.seg.nrrd, .nrrd, .nii, .nii.gz)."""
    markups: Annotated[tuple[PathText, ...], Field(strict=False, min_length=1, max_length=100)]
    """Paths of the files with markups (.mrk.json, .fcsv)."""
    target: Title
    """Name of the point of the target: the label of a control point, or the name of a markup with one point; if
    several have one name, `MARKUP/POINT`."""
    entry: Title
    """Name of the point where the needle enters, at most 5 mm from the skin."""
    direction: Title | None = None
    """Name of a line markup, from its first to its second point, along which the needle is inserted. Not set: from
    entry to target."""
    skin: Names
    """Names of the segments whose outer surface is the skin."""
    skin_radius_mm: Annotated[float, Field(ge=5, le=100)] = 15.0
    """Radius around the entry in which a plane is fitted to the skin, and layers are checked."""
    registration_sd_mm: NonNegative
    """Standard deviation, on each axis, of a point of the image in the needle frame. 2.33 times this value is added to
    the margin of each zone."""
    free_radius_mm: NonNegative | None = None
    """`entry.free_radius_mm`. Not set: as in `scenario`."""
    free_slope_mrad: Annotated[float, Field(ge=0, le=STEEPEST_MRAD)] | None = None
    """`entry.free_slope_mrad`. Not set: as in `scenario`."""
    zone_margin_mm: Positive | None = None
    """`zones.margin_mm`. Not set: as in `scenario`."""
    layer: Annotated[tuple[LayerChoice, ...], Field(strict=False, max_length=100)] = ()
    """Layers of tissue. None: the `[[tissue]]` of `scenario`."""
    zone: Annotated[tuple[ZoneChoice, ...], Field(strict=False, max_length=100)] = ()
    """Zones to avoid, besides the zones of `scenario`."""


def load_case(path: str | Path) -> ImageCase:
    """Return the case of a file, its paths absolute. Raises FileError with one line for each problem."""
    case = CASES.load(path, ImageCase)
    folder = expand_home(path).absolute().parent
    changes: dict[str, Any] = {
        "labels": str(folder / expand_home(case.labels)),
        "markups": tuple(str(folder / expand_home(each)) for each in case.markups),
    }
    if case.scenario.endswith(".toml"):
        changes["scenario"] = str(folder / expand_home(case.scenario))
    return case.model_copy(update=changes)
