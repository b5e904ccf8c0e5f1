"""How kernels are compiled: Numba, double precision, no fast-math, no GIL, kept on disk.

Numba's own cache looks only at the file of the outermost function, so an edit of a law in another file would
silently run the old law. Here the cache folder is named after the sources of all kernels.
"""

import hashlib
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba as nb

_HERE = Path(__file__).parent


def _cache_folder() -> str:
    """The folder for this exact source: under NUMBA_CACHE_DIR, beside the code, or in the user's cache."""
    digest = hashlib.sha256()
    for source in sorted(_HERE.glob("*.py")):
        digest.update(source.read_bytes())
    beside = _HERE / "__pycache__"
    user = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "flexneedle"
    writable = os.access(beside if beside.exists() else _HERE, os.W_OK)
    base = Path(nb.config.CACHE_DIR) if nb.config.CACHE_DIR else (beside if writable else user)
    return str(base / f"kernels-{digest.hexdigest()[:16]}")


_FOLDER = _cache_folder()


def inner(function: Callable[..., Any]) -> Any:
    """Compile a function that only other kernels call."""
    return nb.njit(nogil=True, error_model="numpy")(function)


def kernel(function: Callable[..., Any]) -> Any:
    """Compile an entry point, once for each version of the sources."""
    before = nb.config.CACHE_DIR
    nb.config.CACHE_DIR = _FOLDER
    try:
        return nb.njit(cache=True, nogil=True, error_model="numpy")(function)
    finally:
        nb.config.CACHE_DIR = before
