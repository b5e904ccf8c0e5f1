"""The controllers by name. A further one is a file here with a METHOD, and a line below."""

from flexneedle.control.interface import Method
from flexneedle.control.methods import (
    adaptive_mpc,
    bevel_only,
    broyden_mpc,
    ce_mpc,
    open_loop,
    resolved_rate,
)
from flexneedle.errors import InputError

__all__ = ["DEFAULT", "METHODS", "method"]

METHODS: dict[str, Method] = {
    module.METHOD.name: module.METHOD
    for module in (adaptive_mpc, ce_mpc, open_loop, bevel_only, resolved_rate, broyden_mpc)
}
DEFAULT = adaptive_mpc.METHOD.name


def method(name: str) -> Method:
    """Return the controller of this name. Raises InputError with the choices."""
    if name not in METHODS:
        raise InputError(f"controller = {name!r}: must be one of {', '.join(METHODS)}")
    return METHODS[name]
