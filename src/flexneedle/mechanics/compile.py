"""Compilation of kernels: Numba, double precision, no fast-math, no GIL, cached on disk.

Numba's own cache checks only the file of the outermost function, so an edit of a law in another file would silently run
the old law. Here the cache folder is named after the sources of all kernels and the columns of arrays.
"""

import hashlib
import os
from pathlib import Path
from typing import Any, TypeVar

import numba as nb
from numba.core import config as _numba_config

from flexneedle import types

_Function = TypeVar("_Function")  # compiled functions keep their signature
_njit: Any = nb.njit
_config: Any = _numba_config  # its settings are not declared
HERE = Path(__file__).parent


def cache_folder(home: Path) -> str:
    """Return the cache folder for the exact sources of `home` and of this folder.

    It is under NUMBA_CACHE_DIR, beside the code, or in the user's cache.
    """
    digest = hashlib.sha256(repr(_columns()).encode())
    for folder in dict.fromkeys((HERE, home)):  # in this order, whatever their paths
        for source in sorted(folder.glob("*.py")):
            digest.update(source.read_bytes())
    beside = home / "__pycache__"
    user = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "flexneedle"
    writable = os.access(beside if beside.exists() else home, os.W_OK)
    base = Path(_config.CACHE_DIR) if _config.CACHE_DIR else (beside if writable else user)
    return str(base / f"kernels-{digest.hexdigest()[:16]}")


def _columns() -> list[tuple[str, int]]:
    """Return the columns of poses and controls by name: kernels have them as constants."""
    return [(name, value) for name, value in vars(types).items() if type(value) is int]


def inner(function: _Function) -> _Function:
    """Compile a function that only kernels call and that allocates no array.

    Its caller owns the arrays: counting references to them would take a third of a step.
    """
    compiled: _Function = _njit(nogil=True, error_model="numpy", _nrt=False)(function)
    return compiled


def kernel(function: _Function) -> _Function:
    """Compile an entry point, once for each version of the sources."""
    before = _config.CACHE_DIR
    source: Any = function
    _config.CACHE_DIR = cache_folder(Path(source.__code__.co_filename).parent)
    try:
        compiled: _Function = _njit(cache=True, nogil=True, error_model="numpy")(function)
        return compiled
    finally:
        _config.CACHE_DIR = before
