"""Trackers named on the command line."""

from collections.abc import Callable
from contextlib import AbstractContextManager

from flexneedle.errors import InputError, RigError, one_line
from flexneedle.lab.rig.devices import trackers
from flexneedle.ports import Clock, Tracker

FORMS = "aurora:PORT[=NAME,NAME,…] or replay:FILE (a recording or a run folder)"
"""Syntax of a tracker on the command line."""


def open_tracker(spec: str, clock: Clock) -> AbstractContextManager[Tracker]:
    """Return the tracker given by `spec`, started; leaving the context stops it.

    `aurora:/dev/ttyUSB0` has the sensors tip, ref1, ref2, ref3 at ports 1 to 4; `aurora:/dev/ttyUSB0=ref1,tip` names
    those at ports 1 and 2. `replay:FILE` plays back a recording or the readings in a run folder.

    Raises InputError for any other `spec`, RunError if the tracker does not respond.
    """
    kind, _, rest = spec.partition(":")
    if not rest or kind not in ("aurora", "replay"):
        raise InputError(f"tracker {spec}: must be {FORMS}")
    return _open(spec, _open_aurora if kind == "aurora" else _open_replay, rest, clock)


def _open(
    spec: str, make: Callable[[str, Clock], AbstractContextManager[Tracker]], rest: str, clock: Clock
) -> AbstractContextManager[Tracker]:
    try:
        return make(rest, clock)
    except RigError as error:
        raise InputError(f"tracker {spec}: {one_line(error)}") from error


def _open_aurora(rest: str, clock: Clock) -> AbstractContextManager[Tracker]:
    port, equals, names = rest.partition("=")
    sensors = {"sensors": names.split(",")} if equals and names else {}
    return trackers.aurora({"port": port, **sensors}, clock)


def _open_replay(rest: str, clock: Clock) -> AbstractContextManager[Tracker]:
    return trackers.replay({"file": rest}, clock)
