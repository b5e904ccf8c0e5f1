"""How kernels are compiled: Numba, double precision, no fast-math, no GIL, kept on disk.

Numba's own cache looks only at the file of the outermost function, so an edit of a law in another file would
silently run the old law. Here the cache folder is named after the sources of all kernels.
"""

import hashlib
import os
from pathlib import Path
from typing import Any, TypeVar

import numba as nb
from numba.core import config as _numba_config

_Function = TypeVar("_Function")  # a compiled function is called like the one that it was
_njit: Any = nb.njit
_config: Any = _numba_config  # its settings are not declared
_HERE = Path(__file__).parent


def _cache_folder() -> str:
    """The folder for this exact source: under NUMBA_CACHE_DIR, beside the code, or in the user's cache."""
    digest = hashlib.sha256()
    for source in sorted(_HERE.glob("*.py")):
        digest.update(source.read_bytes())
    beside = _HERE / "__pycache__"
    user = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "flexneedle"
    writable = os.access(beside if beside.exists() else _HERE, os.W_OK)
    base = Path(_config.CACHE_DIR) if _config.CACHE_DIR else (beside if writable else user)
    return str(base / f"kernels-{digest.hexdigest()[:16]}")


_FOLDER = _cache_folder()


def compiled() -> bool:
    """Whether kernels of these sources lie in the cache, so that a start takes no compilation."""
    return any(Path(_FOLDER).rglob("*.nbi"))


def inner(function: _Function) -> _Function:
    """Compile a function that only other kernels call."""
    compiled: _Function = _njit(nogil=True, error_model="numpy")(function)
    return compiled


def kernel(function: _Function) -> _Function:
    """Compile an entry point, once for each version of the sources."""
    before = _config.CACHE_DIR
    _config.CACHE_DIR = _FOLDER
    try:
        compiled: _Function = _njit(cache=True, nogil=True, error_model="numpy")(function)
        return compiled
    finally:
        _config.CACHE_DIR = before
