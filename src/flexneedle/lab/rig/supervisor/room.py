"""Where the axes of a rig may go from where they are: pure functions of requests that return a problem, or ""."""

from collections.abc import Mapping
from dataclasses import dataclass

from flexneedle.lab.rig.supervisor.drives import Drive
from flexneedle.lab.rig.supervisor.messages import Go, Home, Step
from flexneedle.lab.rig.supervisor.motion import beyond

_ROUNDING = 1e-9


@dataclass(frozen=True)
class Room:
    """Axes by name, where each was last sent (mm or rad), and the deepest position of the insertion (mm)."""

    drives: Mapping[str, Drive]
    at: Mapping[str, float]
    deepest: float

    def step_problem(self, step: Step) -> str:
        """A problem with a step, the end of its roll included."""
        spin = step.travel.get("rotation", 0.0)
        problem = self._too_far({**step.travel, "rotation": step.roll + spin})
        return problem or self._too_far({"rotation": step.roll})

    def go_problem(self, go: Go) -> str:
        """A problem with a motion of one axis. From beyond its range it may go back towards it."""
        if go.axis not in self.drives:
            return self._missing([go.axis])
        drive, now = self.drives[go.axis], self.at[go.axis]
        problem = self._too_far({go.axis: go.position - now})
        if problem and not self._leads_back(drive, now, go.position):
            return problem
        if go.retract and not (go.axis == "insertion" and go.position <= now):
            return f"retract to {drive.shown(go.position)}: must withdraw the base, which is at {drive.shown(now)}"
        if not 0.0 < go.speed <= drive.axis.speed * (1.0 + _ROUNDING):
            speed, fastest = (
                f"{drive.axis.shown(one)} {drive.axis.unit}/s" for one in (go.speed, drive.axis.speed)
            )
            return f"speed of {go.axis} = {speed}: must be above 0, at most {fastest}"
        return ""

    def home_problem(self, home: Home) -> str:
        """A problem with the search of a home."""
        if home.axis not in self.drives:
            return self._missing([home.axis])
        absolute = self.drives[home.axis].axis.home == "absolute"
        return f"{home.axis}: has an absolute encoder, and no home to search" if absolute else ""

    def _too_far(self, travel: Mapping[str, float]) -> str:
        """A problem with a travel by axis: an axis that is not there, an end outside a range, or too deep."""
        moved = {name: way for name, way in travel.items() if way}
        if missing := [name for name in moved if name not in self.drives]:
            return self._missing(missing)
        ends = {name: self.at[name] + way for name, way in moved.items()}
        problem = beyond(self.drives, list(ends.items()))
        if not problem and moved.get("insertion", 0.0) > 0.0 and ends["insertion"] > self.deepest + _ROUNDING:
            deepest = f"{self.deepest:.3f} mm, as far as this insertion may go"
            return f"insertion = {ends['insertion']:.3f} mm: must be at most {deepest}"
        return problem

    def _missing(self, names: list[str]) -> str:
        return f"the rig has no axis {', '.join(names)}; axes: {', '.join(self.drives)}"

    @staticmethod
    def _leads_back(drive: Drive, now: float, goal: float) -> bool:
        """Whether a motion ends nearer to the range than it begins, from beyond it."""
        low, high = drive.axis.limits
        return now < goal <= high if now < low else low <= goal < now if now > high else False
