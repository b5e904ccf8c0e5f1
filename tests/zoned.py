"""A scenario with one zone of each shape about the synthetic path."""

from flexneedle import load_scenario
from flexneedle.scenario.model import Scenario

SPHERE = {"name": "node", "shape": "sphere", "center_mm": [25.0, 9.0, 0.0], "radius_mm": 3.0}
CAPSULE = {
    "name": "vessel", "shape": "capsule", "from_mm": [12.0, -12.0, -8.0], "to_mm": [18.0, -5.0, 8.0],
    "radius_mm": 1.5, "margin_mm": 1.0,
}  # fmt: skip
BOX = {
    "name": "rib", "shape": "box", "center_mm": [8.0, 8.0, 2.0], "size_mm": [3.0, 6.0, 10.0],
    "rotation": [0.9238795325112867, 0.0, 0.0, 0.3826834323650898],
}  # fmt: skip
HALF_SPACE = {"name": "bone", "shape": "half-space", "point_mm": [48.0, 0.0, 0.0], "normal": [-1.0, 0.1, 0.0]}
PRIMITIVES = (SPHERE, CAPSULE, BOX, HALF_SPACE)


def with_zones(base: str | Scenario = "phantom", *zones: dict) -> Scenario:
    """Return a scenario with zones (default: one of each primitive)."""
    scenario = load_scenario(base) if isinstance(base, str) else base
    return scenario.with_values({"zone": list(zones or PRIMITIVES)})
