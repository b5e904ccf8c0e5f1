"""A simulated electromagnetic tracker: smooth errors of its field, a metal plate, its sensors and its frames."""

from flexneedle.tracking.field.poses import Pose, reference_poses, tip_sensor_pose
from flexneedle.tracking.field.room import REFERENCES, Room
from flexneedle.tracking.field.tracker import FieldTracker

__all__ = ["REFERENCES", "FieldTracker", "Pose", "Room", "reference_poses", "tip_sensor_pose"]
