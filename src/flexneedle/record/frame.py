"""An insertion as a table for analysis."""

from typing import TYPE_CHECKING

from flexneedle.arguments import check_instance
from flexneedle.errors import InputError
from flexneedle.record.export import mark_columns
from flexneedle.record.fields import COLUMNS, to_values
from flexneedle.results import Insertion

if TYPE_CHECKING:
    from pandas import DataFrame


def to_dataframe(insertion: Insertion) -> "DataFrame":
    """Return a pandas DataFrame with one row per control period and the columns of `flexneedle export --csv`.

    Column names end in their unit; unknown numbers are NaN. Raises InputError for another type, or if pandas is not
    installed.
    """
    checked = check_instance(
        "insertion", insertion, Insertion, "make one with flexneedle.insert(scenario, plan)"
    )
    try:
        from pandas import DataFrame
    except ModuleNotFoundError:
        raise InputError("to_dataframe needs pandas, which is not installed: pip install pandas") from None
    marked = mark_columns(checked)
    rows = [to_values(period) | marked for period in checked.periods]
    return DataFrame(rows, columns=[*COLUMNS, *marked])
