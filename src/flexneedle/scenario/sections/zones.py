"""Zones that the needle must not touch, in the insertion frame, and the registration of the image they come from.

A zone is a table `[[zone]]` of the scenario. A new shape is a class here and its distance in `mechanics.zones`.
"""

from typing import TYPE_CHECKING, Annotated, Any, Literal, Union, get_args

from pydantic import AfterValidator, Field, SerializeAsAny, ValidatorFunctionWrapHandler, WrapValidator

from flexneedle.scenario.kind_tables import read_table
from flexneedle.scenario.problems import Problem, refuse
from flexneedle.scenario.sections.environment import Direction, Vector
from flexneedle.scenario.sections.fields import NonNegative, Positive, Section, Title, one_line
from flexneedle.scenario.sections.registration import UnitQuaternion

REGISTRATION_SDS = 2.33
"""Standard deviations of the image's registration that are added to each margin: 99 % of errors in a direction."""


class ImageSettings(Section):
    """Section `image`: rigid map from the frame of an image (RAS) to the insertion frame.

    `flexneedle plan --image` writes it. Zones in files, and files that are written for 3D Slicer, are mapped by it.
    """

    rotation: UnitQuaternion = (1.0, 0.0, 0.0, 0.0)
    """Unit quaternion w, x, y, z from the image's to the insertion frame."""
    translation_mm: Vector = (0.0, 0.0, 0.0)
    """Position x, y, z of the image's origin in the insertion frame."""
    sd_mm: NonNegative = 0.0
    """Standard deviation of a mapped point on each axis. 2.33 times this value is added to the margin of each zone:
    99 % of the errors towards a needle are smaller."""
    doubts: Annotated[str, AfterValidator(one_line)] | None = None
    """Lines of `flexneedle image check` about what is outside of the model's assumptions, separated by `; `."""

    @property
    def doubt_lines(self) -> list[str]:
        """Lines of `doubts`."""
        return self.doubts.split("; ") if self.doubts else []


class ZoneSettings(Section):
    """Section `zones`: margins of the zones to avoid."""

    margin_mm: NonNegative = 2.0
    """Least distance of the needle's surface from a zone in a plan."""


class Zone(Section):
    """One `[[zone]]`: a region that the needle must not touch. A shape is a subclass."""

    shape: str
    """`sphere`, `capsule`, `box`, `half-space` or `file`."""
    name: Title
    """Name in messages, tables and figures."""
    margin_mm: NonNegative | None = None
    """Margin of this zone. Not set: `zones.margin_mm`."""


class Sphere(Zone):
    """One `[[zone]]` with `shape = "sphere"`."""

    shape: Literal["sphere"]
    center_mm: Vector
    """Center x, y, z of a sphere or a box."""
    radius_mm: Positive
    """Radius of a sphere or a capsule."""


class Capsule(Zone):
    """One `[[zone]]` with `shape = "capsule"`: all points within a radius of a line."""

    shape: Literal["capsule"]
    from_mm: Vector
    """One end x, y, z of the line of a capsule."""
    to_mm: Vector
    """Its other end."""
    radius_mm: Positive
    """Radius."""


class Box(Zone):
    """One `[[zone]]` with `shape = "box"`."""

    shape: Literal["box"]
    center_mm: Vector
    """Center x, y, z."""
    size_mm: Annotated[tuple[Positive, Positive, Positive], Field(strict=False)]
    """Lengths of the edges of a box along its own axes."""
    rotation: UnitQuaternion = (1.0, 0.0, 0.0, 0.0)
    """Unit quaternion w, x, y, z from the box's axes to the insertion frame."""


class HalfSpace(Zone):
    """One `[[zone]]` with `shape = "half-space"`: all points behind a plane."""

    shape: Literal["half-space"]
    point_mm: Vector
    """A point x, y, z of the surface of a half-space."""
    normal: Direction
    """Direction x, y, z out of a half-space, of any length."""


class ZoneFile(Zone):
    """One `[[zone]]` with `shape = "file"`: a segment of a label map, or a closed surface, in the image's frame."""

    shape: Literal["file"]
    file: Annotated[str, AfterValidator(one_line)]
    """Path of a label map (.seg.nrrd, .nrrd, .nii, .nii.gz) or of a mesh (.stl, .ply, .obj). A relative path is from
    the folder of the scenario."""
    segment: Title | None = None
    """Name of the segment. Not set: `label`; a mesh has neither."""
    label: Annotated[int, Field(ge=1, le=2**31 - 1)] | None = None
    """Label of the voxels, in the first layer of the file."""
    frame: Literal["LPS", "RAS"] | None = None
    """Frame of a mesh whose comment does not name it."""
    sha256: Annotated[str, Field(pattern="^[0-9a-f]{64}$")] | None = None
    """SHA-256 of the file, added when the scenario is loaded. A file that has changed since then is refused."""


_SHAPES: dict[str, type[Zone]] = {
    get_args(shape.model_fields["shape"].annotation)[0]: shape
    for shape in (Sphere, Capsule, Box, HalfSpace, ZoneFile)
}


def _zone(value: Any, _validate: ValidatorFunctionWrapHandler) -> Zone:
    """Return the zone of the shape in a table."""
    return read_table(value, Zone, lambda table: _choose_shape(table.get("shape")))


def _choose_shape(name: object) -> type[Zone]:
    if str(name) not in _SHAPES:
        refuse([Problem("shape", name, f"must be one of {', '.join(_SHAPES)}")])
    return _SHAPES[str(name)]


if TYPE_CHECKING:
    AnyZone = Zone
else:
    AnyZone = Annotated[SerializeAsAny[Union[(Sphere, *_SHAPES.values())]], WrapValidator(_zone)]
"""A zone of any shape."""
