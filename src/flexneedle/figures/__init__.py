"""Figures of plans and insertions, as pure functions of records.

They need no backend: matplotlib, imported here first, ignores a MPLBACKEND that it does not know.
"""

import os
import sys
from contextlib import suppress

from flexneedle.caches import use_matplotlib_folder

if "matplotlib" not in sys.modules:
    use_matplotlib_folder()
    _backend = os.environ.pop("MPLBACKEND", "")
    import matplotlib as _matplotlib

    if _backend:
        os.environ["MPLBACKEND"] = _backend
        with suppress(ValueError):  # pyplot, which this package does not use, then chooses one
            _matplotlib.rcParams["backend"] = _backend
