"""What can be chosen, from a file, since the controllers themselves load the compiler.

`python tools/docs/page_catalog.py` writes the file.
"""

import json
from importlib.resources import files
from typing import Any, get_args

from flexneedle.lab.page.messages import Strategy

_CATALOG: dict[str, Any] = json.loads((files(__package__) / "catalog.json").read_text(encoding="utf-8"))

CONTROLLERS: list[dict[str, str]] = _CATALOG["controllers"]
"""Name and summary of each controller, the default first."""
STRATEGIES: list[str] = list(get_args(Strategy))
SCHEMA = json.dumps(_CATALOG["schema"], ensure_ascii=False).encode()
"""JSON schema of scenario files, as `flexneedle scenario schema` prints it."""
