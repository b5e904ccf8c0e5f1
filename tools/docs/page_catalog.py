"""Writes src/flexneedle/lab/page/server/catalog.json: the controllers, and the schema of scenario files.

python tools/docs/page_catalog.py
"""

import json
from pathlib import Path

from flexneedle.control.controllers import CONTROLLERS
from flexneedle.control.tables import typed_scenario

CATALOG = Path(__file__).parents[2] / "src" / "flexneedle" / "lab" / "page" / "server" / "catalog.json"


def catalog() -> str:
    """Return the file, JSON."""
    controllers = [{"name": method.name, "summary": method.summary} for method in CONTROLLERS.values()]
    schema = typed_scenario(tuple(CONTROLLERS.values())).model_json_schema()
    return json.dumps({"controllers": controllers, "schema": schema}, indent=1, ensure_ascii=False) + "\n"


if __name__ == "__main__":
    CATALOG.write_text(catalog(), encoding="utf-8")
