"""Table of repeated measurements for the evaluation of a tracker: one row per sample, many samples per grid point.

Written by `flexneedle em simulate` and `em record`, read by `em evaluate`.
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
"""Required columns: grid point and true position of the sensor (from the stage), measured position and indicator, name
of the sensor and of the environment. The indicator may be empty or omitted for sensors without one."""

OPTIONAL = ("qw", "qx", "qy", "qz")
"""Optional columns: orientation as a unit quaternion."""

COLUMNS = REQUIRED + OPTIONAL

TIP, REFERENCE = "tip", "reference"
"""Names of the paper's two sensors in the column `sensor`: 5-DOF at the tip, 6-DOF reference (Tables I and II)."""
