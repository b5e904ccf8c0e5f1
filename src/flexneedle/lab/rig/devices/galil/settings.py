"""Settings of the driver `galil` in a rig file, besides `kind`."""

import re
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field

from flexneedle.errors import RigError
from flexneedle.lab.rig.rig_file import check_settings
from flexneedle.scenario.problems import Problem, to_line
from flexneedle.scenario.sections.fields import Section

AXES = "ABCDEFGH"
"""Axes of the largest controller of the series; a DMC-4143 has the first four."""

_TELNET = 23
_LAST_PORT = 65535
_ADDRESS = re.compile(r"(?P<host>[A-Za-z0-9._-]+|\[[0-9A-Fa-f:.%a-z]+\])(:(?P<port>[0-9]{1,5}))?")


def split_address(text: str, lowest: int = 1) -> tuple[str, int]:
    """Return host and port of an address. Raises ValueError, also for a port below the lowest."""
    form = _ADDRESS.fullmatch(text)
    if form is None or not lowest <= int(form["port"] or _TELNET) <= _LAST_PORT:
        raise ValueError(f"must be HOST or HOST:PORT, such as 192.168.1.10:{_TELNET}")
    return form["host"].strip("[]"), int(form["port"] or _TELNET)


def _check_address(text: str) -> str:
    split_address(text)
    return text


class GalilSettings(Section):
    """Table `driver` of a rig file with `kind = "galil"`."""

    address: Annotated[str, AfterValidator(_check_address)]
    """Host name or IP address of the controller, and port if it is not 23."""
    mode: Literal["tracking", "moves"] = "tracking"
    """Position tracking (PT), or a separate move for each target (PA, BG)."""
    reply_timeout_ms: Annotated[float, Field(ge=1, le=1000)] = 100.0
    """Time for a call, with all its replies, after which the connection counts as lost."""

    @property
    def host(self) -> str:
        """Host of the address."""
        return split_address(self.address)[0]

    @property
    def port(self) -> int:
        """Port of the address."""
        return split_address(self.address)[1]


def check_galil_settings(settings: Mapping[str, Any], channels: Sequence[str]) -> GalilSettings:
    """Return the settings of a driver with these channels. Raises RigError with one line for each problem."""
    found = check_settings(GalilSettings, settings)
    rule = f"must be an axis of the controller, one of {', '.join(AXES)}"
    unknown = [channel for channel in channels if len(channel) != 1 or channel not in AXES]
    if unknown:
        raise RigError(*(to_line(Problem("channel", channel, rule)) for channel in unknown))
    return found
