"""An insertion as a table for analysis."""

from typing import TYPE_CHECKING

from flexneedle.arguments import instance
from flexneedle.errors import InputError
from flexneedle.trace.columns import COLUMNS, to_values
from flexneedle.types import Insertion

if TYPE_CHECKING:
    from pandas import DataFrame


def to_dataframe(insertion: Insertion) -> "DataFrame":
    """Return a pandas DataFrame with a row for each control period, the columns as `flexneedle export --csv` has them.

    Units are those in the names; a number that is not known is NaN. Raises InputError for what is no insertion, and
    where pandas is not installed.
    """
    given = instance("insertion", insertion, Insertion, "make one with flexneedle.insert(scenario, plan)")
    try:
        from pandas import DataFrame
    except ModuleNotFoundError:
        raise InputError("to_dataframe needs pandas, which is not installed: pip install pandas") from None
    return DataFrame([to_values(period) for period in given.periods], columns=list(COLUMNS))
