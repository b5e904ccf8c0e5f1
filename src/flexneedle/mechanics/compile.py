"""Compilation of kernels: Numba, double precision, no fast-math, no GIL, cached on disk.

Numba's own cache checks only the file of the outermost function, so an edit of a law in another file would silently run
the old law. Here the cache folder is named after the sources of all kernels and the columns of arrays.
"""

import hashlib
import sys
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

import numba as nb
from numba import types as numba_types
from numba.core import config as _numba_config
from numba.core.registry import CPUDispatcher, cpu_target

from flexneedle import types
from flexneedle.caches import kernel_folder
from flexneedle.errors import InputError

_Function = TypeVar("_Function")  # compiled functions keep their signature
_njit: Any = nb.njit
_config: Any = _numba_config  # its settings are not declared
HERE = Path(__file__).parent

if _config.DISABLE_JIT:
    raise InputError("NUMBA_DISABLE_JIT=1: an insertion would take hours without compiled kernels; unset it")


def cache_folder(home: Path) -> str:
    """Return the cache folder for the exact sources of `home` and of this folder, and for this machine.

    It is in NUMBA_CACHE_DIR, beside the code, in the user's cache or in a temporary folder.
    """
    digest = hashlib.sha256(repr((_columns(), _machine())).encode())
    for source in _sources(home):
        digest.update(source.read_bytes())
    return str(kernel_folder(f"kernels-{digest.hexdigest()[:16]}", home, _config.CACHE_DIR))


def source_stamp(home: Path) -> str:
    """Return a text that changes where Numba compiles again: path and time of the sources of `home`."""
    stamps = [(str(source), source.stat().st_mtime_ns) for source in _sources(home)]
    return hashlib.sha256(repr(stamps).encode()).hexdigest()[:8]


def _sources(home: Path) -> list[Path]:
    folders = dict.fromkeys((HERE, home))  # in this order, whatever their paths
    return [source for folder in folders for source in sorted(folder.glob("*.py"))]


@cache
def _machine() -> tuple[object, ...]:
    """Return versions of Python and Numba, and the processor with its features, as Numba's cache compares them."""
    target: Any = cpu_target
    return sys.implementation.cache_tag, nb.__version__, target.target_context.codegen().magic_tuple()


def _columns() -> list[tuple[str, int]]:
    """Return the columns of poses and controls by name: kernels have them as constants."""
    return [(name, value) for name, value in vars(types).items() if type(value) is int]


class _InnerDispatcher(CPUDispatcher):
    """A compiled function that has no wrapper for Python: the call of one would end the process."""

    def get_call_template(self, args: Any, kws: Any) -> Any:
        """Compile once for an argument's type, not once more for each constant."""
        return super().get_call_template([numba_types.unliteral(arg) for arg in args], kws)

    def __call__(self, *_args: object, **_named: object) -> None:
        name = self.py_func.__name__
        raise TypeError(f"{name}() is compiled for kernels only: in Python, call interpret({name})")


def inner(function: _Function) -> _Function:
    """Compile a function that only kernels call, into each of its callers; it allocates and returns no array.

    In a call, lanes would pass through memory, which would take a third of a step.
    """
    return _compile_inner(function, forceinline=True)


def shared(function: _Function) -> _Function:
    """Compile a large function as `inner` does, but once for all of its callers."""
    return _compile_inner(function, forceinline=False)


def _compile_inner(function: _Function, *, forceinline: bool) -> _Function:
    # Without a count of references, which would take a third of a step: an array that it returns would be freed.
    compiled: Any = _njit(
        nogil=True,
        error_model="numpy",
        forceinline=forceinline,
        _nrt=False,
        no_cpython_wrapper=True,
        no_cfunc_wrapper=True,
    )(function)
    compiled.__class__ = _InnerDispatcher
    return compiled


def interpret(function: _Function) -> _Function:
    """Return a compiled function as Python runs it."""
    source: Any = function
    return source.py_func


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
