"""Controllers that a client can choose, and the JSON schema of its form."""

import json
from dataclasses import dataclass
from functools import cache
from typing import get_args

from flexneedle.lab.page.protocol import Strategy
from flexneedle.lab.page.server.clients import Refusal

STRATEGIES: list[str] = list(get_args(Strategy))


@dataclass(frozen=True)
class Catalog:
    """Choices of the page. controllers: name and summary of each, the default first; schema: of scenario files."""

    controllers: list[dict[str, str]]
    schema: bytes


@cache
def build_catalog() -> Catalog:
    """Return the choices. The first call imports the controllers, which takes about 0.6 s."""
    from flexneedle.control.controller_tables import scenario_class
    from flexneedle.control.controllers import CONTROLLERS

    controllers = [{"name": one.name, "summary": one.summary} for one in CONTROLLERS.values()]
    schema = scenario_class(tuple(CONTROLLERS.values())).model_json_schema()
    return Catalog(controllers, json.dumps(schema, ensure_ascii=False).encode())


def require_controller(name: str) -> None:
    """Raise Refusal for an unknown controller."""
    known = [controller["name"] for controller in build_catalog().controllers]
    if name not in known:
        raise Refusal(f"controller = {name}: must be one of {', '.join(known)}")
