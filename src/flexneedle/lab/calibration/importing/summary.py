"""A summary of an import, line by line: insertions, steps, ranges, and the share of missing positions."""

from collections.abc import Iterator, Sequence

import numpy as np

from flexneedle.lab.calibration.importing.recordings import Found
from flexneedle.lab.calibration.session import Recording, Session

_STILL_MM, _STILL_RAD = 0.05, 0.02


def summarize(session: Session, found: Found) -> Iterator[str]:
    """Yield the lines; found: of the tables, with the missing positions and the fitted frames."""
    recordings = session.recordings
    steps = [len(one.depth) for one in recordings]
    spread = f"{min(steps)} to {max(steps)}" if min(steps) < max(steps) else f"{max(steps)}"
    missing = f"{100.0 * found.missing:.3g} % of the rows without a position"
    yield f"{count_insertions(session)}, {spread} steps each, {missing}"
    depth = np.concatenate([one.depth for one in recordings])
    across = np.concatenate([one.position for one in recordings])
    above = int((depth < 0.0).sum())
    air = f", {above} steps above the skin" if above else ""
    yield f"depth {depth.min():.4g} to {depth.max():.4g} mm{air}"
    yield f"lateral offset {across.min():.3g} to {across.max():.3g} mm"
    yield _describe_slope(recordings)
    for name in ("guide", "base"):
        moves = [
            float(np.linalg.norm(each - each[0], axis=1).max())
            for one in recordings
            for each in [getattr(one, name)]
        ]
        yield f"the {name} moves in {_count(moves, _STILL_MM, 'mm')}"
    yield f"the needle is rotated in {_count([float(np.ptp(one.roll)) for one in recordings], _STILL_RAD, 'rad')}"
    for sensor in dict.fromkeys(each.sensor for one in recordings for each in one.readings):
        steps = [len({each.step for each in one.readings if each.sensor == sensor}) for one in recordings]
        yield f"readings of {sensor} at {sum(steps)} steps in {sum(map(bool, steps))} of {len(steps)} insertions"
    for name, frame in found.frames.items():
        rows = zip("xyz", frame.rotation.round(3).tolist(), strict=True)
        shown = ", ".join(f"{axis} = {row}" for axis, row in rows)
        yield f"fitted frame of {name} in the axes of the tracker: {shown}"


def count_insertions(session: Session) -> str:
    """Return the numbers of insertions and sessions as text."""
    counts = (len(session.recordings), "insertion"), (len(session.names), "session")
    return " in ".join(f"{count} {noun}{'s' * (count > 1)}" for count, noun in counts)


def _describe_slope(recordings: Sequence[Recording]) -> str:
    slope = np.concatenate([one.slope for one in recordings])
    if not np.isfinite(slope).any():
        return "no direction of the needle at the tip"
    return f"slope of the needle at the tip {1e3 * np.nanmin(slope):.3g} to {1e3 * np.nanmax(slope):.3g} mrad"


def _count(moves: Sequence[float], still: float, unit: str) -> str:
    moved = sum(each > still for each in moves)
    return f"{moved} of {len(moves)} insertions" + (f", by up to {max(moves):.3g} {unit}" if moved else "")
