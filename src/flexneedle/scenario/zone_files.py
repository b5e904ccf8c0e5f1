"""Files of zones: whether each is the one with which the scenario was made."""

from functools import lru_cache
from pathlib import Path

from flexneedle.errors import InputError
from flexneedle.files import digest_of
from flexneedle.scenario.model import Scenario
from flexneedle.scenario.sections.zones import Zone, ZoneFile


def stamp_of(zone: Zone) -> tuple[int, int] | None:
    """Return time and size of a zone's file, None without one.

    Raises InputError if the file cannot be read, or has changed.
    """
    if not isinstance(zone, ZoneFile):
        return None
    path = Path(zone.file)
    try:
        found = path.stat()
        stamp = found.st_mtime_ns, found.st_size
        digest = _digest_of(path, stamp) if zone.sha256 else None
    except OSError as error:
        raise InputError(f"zone {zone.name}: {path}: cannot be read: {error.strerror}") from error
    if digest != zone.sha256:
        raise InputError(
            f"zone {zone.name}: {path}: has changed since the scenario was made (sha256 {digest}); "
            "write the scenario again (flexneedle image show CASE, or without this sha256)"
        )
    return stamp


def find_lost(scenario: Scenario) -> dict[int, str]:
    """Return by number, of each zone whose file cannot be read or has changed, the reason."""
    lost = {}
    for number, zone in enumerate(scenario.zone):
        try:
            stamp_of(zone)
        except InputError as error:
            lost[number] = str(error)
    return lost


@lru_cache(maxsize=100)
def _digest_of(path: Path, _stamp: tuple[int, int]) -> str:
    return digest_of(path)
