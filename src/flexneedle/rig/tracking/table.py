"""The table of repeated measurements that a tracker is judged by: one row a sample, a grid point many rows.

`flexneedle em simulate` and `em record` write it, `em evaluate` reads it.
"""

REQUIRED = (
    "point_id",
    "true_x_mm",
    "true_y_mm",
    "true_z_mm",
    "x_mm",
    "y_mm",
    "z_mm",
    "indicator",
    "sensor",
    "environment",
)
"""Columns that every table has: the grid point and where the stage put the sensor, what the tracker said, of which
sensor and in which environment. The indicator may be empty, or left out, where a sensor has none."""

OPTIONAL = ("qw", "qx", "qy", "qz", "distance_mm")
"""Columns that a table may have: orientation as a unit quaternion, distance from sensor to field generator."""

COLUMNS = REQUIRED + OPTIONAL

TIP, REFERENCE = "tip", "reference"
"""Names of the paper's two sensors in the column `sensor`: 5-DOF at the tip, 6-DOF reference (Tables I and II)."""
