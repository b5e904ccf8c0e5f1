"""The figure of a plan or an insertion, whichever it is given."""

from matplotlib.figure import Figure

from flexneedle.figures.insertion import insertion_figure
from flexneedle.figures.plans import plan_figure
from flexneedle.types import Insertion, Plan, scenario_of


def plot(record: Plan | Insertion) -> Figure:
    """Return the figure of a plan or of an insertion, as `flexneedle view` draws it; without a period it is the plan's.

    Raises InputError for anything else, and for a record that does not carry its scenario.
    """
    scenario = scenario_of(record)
    if isinstance(record, Insertion) and record.periods:
        return insertion_figure(scenario, record)
    return plan_figure(scenario, [record.plan if isinstance(record, Insertion) else record])
