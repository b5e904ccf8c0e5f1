"""Settings of the driver and the tracker `ros` in a rig file."""

from collections.abc import Mapping
from typing import Annotated, Any, Literal, TypeVar

from pydantic import Field, ValidationError

from flexneedle.errors import RigError
from flexneedle.lab.ros.profile import Profile, load_profile
from flexneedle.scenario.problems import Problem, describe, to_line
from flexneedle.scenario.sections.fields import Section

_Settings = TypeVar("_Settings", bound=Section)
_Age = Annotated[float, Field(gt=0, le=1000)]


class DriverSettings(Section):
    """Settings beside `kind = "ros"` in the section `driver`."""

    profile: str = "neutral"
    """Name or file of the profile."""
    stale_ms: _Age = 200.0
    """Age of the last joint states beyond which the motors count as lost."""


class TrackerSettings(Section):
    """Settings beside `kind = "ros"` in the section `tracker`."""

    profile: str = "neutral"
    """Name or file of the profile."""
    source: Literal["tip", "shape"] = "tip"
    """Topic of the tip, or of a shape with the tip as its last pose."""
    late_ms: _Age = 250.0
    """Time without a frame after which the tracker's status is not ok."""


def checked(settings: Mapping[str, Any], model: type[_Settings]) -> _Settings:
    """Return the settings of a section. Raises RigError with `key = value: rule`."""
    try:
        return model.model_validate(dict(settings))
    except ValidationError as error:
        raise RigError(*describe(error, model)) from None


def profile_with(name: str, *keys: str) -> Profile:
    """Return a profile reduced to keys such as `subscribe.tip`. Raises RigError if it lacks one."""
    profile = load_profile(name)
    known = dict(profile.topics())
    for key in keys:
        if key not in known:
            raise RigError(to_line(Problem("profile", name, f"must list {key}; it lists {', '.join(known)}")))
    parts = {
        section: [key.partition(".")[2] for key in keys if key.startswith(f"{section}.")]
        for section in ("publish", "subscribe")
    }
    return profile.only(**parts)
