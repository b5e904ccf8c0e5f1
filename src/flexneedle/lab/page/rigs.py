"""Rigs that the page can insert on."""

from flexneedle.errors import RigError
from flexneedle.lab.rig.rig_file import RigFile, load_rig
from flexneedle.scenario.problems import Problem, to_line


def usable_rig(source: str) -> RigFile:
    """Return the rig of a file or of a shipped name.

    Raises RigError, also for a rig that ROS arms or gives the target.
    """
    rig = load_rig(source)
    for key in ("arm", "target"):
        if rig.ros is not None and getattr(rig.ros, key):
            rule = "must be false for the page, which arms the rig and has the target: use flexneedle insert"
            raise RigError(to_line(Problem(f"ros.{key}", True, rule)))
    return rig
