"""Figures of plans and insertions, as pure functions of records.

The room can be called: `flexneedle.plot(insertion)` returns the figure of a record. Python binds a package to its name
in `flexneedle` when it is first imported, by whatever module, so a function of that name there would be lost.
"""

import sys
from types import ModuleType
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from flexneedle.types import Insertion, Plan


class _Room(ModuleType):
    def __call__(self, record: "Plan | Insertion") -> "Figure":
        from flexneedle.plot.record import plot

        return plot(record)


sys.modules[__name__].__class__ = _Room
