"""Suspected errors of units and signs in a session, one line each."""

import re
from collections.abc import Iterator, Sequence

import numpy as np

from flexneedle.lab.calibration.importing.frames import guide_response
from flexneedle.lab.calibration.importing.map_file import LENGTHS, RecordingMap
from flexneedle.lab.calibration.session import Recording, Session
from flexneedle.types import Floats

_SUFFIX = re.compile(r"[_\s\[(](mm|cm|m|um|µm|inch|rad|deg|mrad|s|ms|us|ns)[\])]?$")
_DEPTHS_MM = (5.0, 400.0)  # usual depths of a recording
_SPEED_MM_S = (0.01, 200.0)
_STEEP_RAD = 0.8
_STILL_MM = 0.05
_FAR_MM = 100.0  # beyond the travel of a guide
_ROLL_RAD = 40.0


def find_suspicions(session: Session, recording_map: RecordingMap | None) -> Iterator[str]:
    """Yield suspicions about a session, and about the map of its files if there is one."""
    recordings = session.recordings
    yield from _wrong_depths(recordings, recording_map)
    yield from _wrong_sizes(recordings, recording_map)
    yield from _wrong_sides(session)
    yield from _wrong_guide(session)
    for key, unit, name in [] if recording_map is None else _given_units(recording_map):
        found = _SUFFIX.search(name)
        if found and found[1].replace("µ", "u") != unit:
            yield f"column {name!r} seems to be in {found[1]}, but {key} = {unit!r}"


def _wrong_depths(recordings: Sequence[Recording], recording_map: RecordingMap | None) -> Iterator[str]:
    reached = float(np.median([np.ptp(one.depth) for one in recordings]))
    if not _DEPTHS_MM[0] <= reached <= _DEPTHS_MM[1]:
        line = f"the insertions are {reached:.3g} mm deep (median)"
        if recording_map is not None:
            now = recording_map.tip.unit
            other = [unit for unit, size in LENGTHS.items() if 20.0 <= reached * size / LENGTHS[now] <= 250.0]
            line += f": check tip.unit = {now!r}" + (f" ({' or '.join(other)}?)" if other else "")
        yield line
    above = sum(float(one.depth.max()) <= 0.0 for one in recordings)
    if above:
        yield (
            f"{above} of {len(recordings)} insertions have no step in tissue: check tip.unit, frame.x and "
            "frame.skin_mm"
        )
    speeds = [
        np.ptp(one.depth) / np.ptp(one.time)
        for one in recordings
        if np.isfinite(one.time).all() and np.ptp(one.time)
    ]
    if speeds and not _SPEED_MM_S[0] <= np.median(speeds) <= _SPEED_MM_S[1]:
        yield f"the tip advances at {np.median(speeds):.3g} mm/s (median): check time.unit"


def _wrong_sizes(recordings: Sequence[Recording], recording_map: RecordingMap | None) -> Iterator[str]:
    moved = max(one.guide_moves for one in recordings)
    if recording_map is not None and recording_map.guide is not None and moved < _STILL_MM:
        still = all(one.rests for one in recordings)
        lost = ", so that stiffness and guide distance will not be identified" if still else ""
        yield f"the guide moves by {moved:.2g} mm at most{lost}: check guide.unit and the columns of [guide]"
    if moved > _FAR_MM:
        yield f"the guide moves by {moved:.3g} mm: check guide.unit"
    roll = max(float(np.ptp(one.roll)) for one in recordings)
    if roll > _ROLL_RAD:
        yield f"the needle turns by {roll:.3g} rad: check roll.unit"
    slope = np.concatenate([one.slope for one in recordings])
    if (np.abs(slope[np.isfinite(slope)]) > _STEEP_RAD).any():
        yield f"the sensor's slope reaches {np.nanmax(np.abs(slope)):.3g} rad: check tip.angle_unit"
    repeated = sum(
        int((np.diff(one.depth) == 0.0).sum()) for one in recordings if one.guide_moves < _STILL_MM
    )
    if repeated > len(slope) // 4:
        yield f"{repeated} of {len(slope)} steps repeat the depth before while the guide rests: check the sensor"


def _given_units(recording_map: RecordingMap) -> Iterator[tuple[str, str, str]]:
    """Yield key, unit and column of each quantity with a unit."""
    for name in recording_map.tip.position:
        yield "tip.unit", recording_map.tip.unit, name
    for name in recording_map.tip.angle or ():
        yield "tip.angle_unit", recording_map.tip.angle_unit, name
    for key, stage in (("guide", recording_map.guide), ("base", recording_map.base)):
        if stage is not None:
            for name in filter(None, (stage.y, stage.z, *(stage.position or ()))):
                yield f"{key}.unit", stage.unit, name
    if recording_map.roll is not None:
        yield "roll.unit", recording_map.roll.unit, recording_map.roll.column
    if recording_map.time.columns:
        yield "time.unit", recording_map.time.unit, recording_map.time.columns[0]


def _wrong_sides(session: Session) -> Iterator[str]:
    """Yield axes on which the sensor's slope and the path turn to opposite sides."""
    for axis, name in enumerate("yz"[: session.axes]):
        pairs = [_turns(one, axis) for one in session.recordings]
        turns, bends = (np.concatenate(each) for each in zip(*pairs, strict=True))
        if len(turns) > 20 and turns.std() > 0.0 < bends.std() and np.corrcoef(turns, bends)[0, 1] < -0.3:
            yield f"the sensor's slope and the path turn to opposite sides along {name}: check the sign of tip.axis"


def _turns(one: Recording, axis: int) -> tuple[Floats, Floats]:
    """Return turns of the slope and of the path (k − 2,); none for steps that do not advance."""
    advance = np.diff(one.depth)
    if not np.isfinite(one.slope[:, axis]).all() or (advance < 0.1).any():
        return np.zeros(0), np.zeros(0)
    return np.diff(one.slope[:, axis])[:-1], np.diff(np.diff(one.position[:, axis]) / advance)


def _wrong_guide(session: Session) -> Iterator[str]:
    """Yield axes on which the tip turns to the side to which the guide moves, or along the other axis."""
    response = guide_response(session.recordings)
    if response is None:
        return
    matrix, certain = np.where(response.certain, response.matrix, 0.0), np.abs(response.matrix)
    for k, axis in enumerate("yz"[: session.axes]):
        if matrix[k, k] > 0.0 and certain[k, k] == certain[:, k].max():
            yield (
                f"the tip turns towards the guide's motion along {axis}, where tissue turns it away: "
                f"check the sign of guide.{axis}, and frame.y"
            )
    if session.axes == 2 and (np.abs(np.diag(matrix[::-1])) > 2.0 * np.abs(np.diag(response.matrix))).all():
        yield "motions of the guide along y turn the tip along z: exchange guide.y and guide.z, or check frame.y"
