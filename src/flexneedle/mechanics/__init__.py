"""Mechanics of a flexible needle in layered soft tissue: constants, laws, equilibrium, insertion steps.

Only this layer knows the compute library; everything here works on plain arrays.
"""

import warnings

from flexneedle.errors import InputError

with warnings.catch_warnings():
    warnings.filterwarnings("error", "Environment variable", RuntimeWarning)
    try:
        import numba as _numba  # noqa: F401  reads its settings
    except (RuntimeWarning, ValueError) as _error:
        _rule = "unset it, or set a whole number (of threads: at least 1)"
        raise InputError(f"Numba (NUMBA_…): {str(_error).splitlines()[0].rstrip('.')}: {_rule}") from None
