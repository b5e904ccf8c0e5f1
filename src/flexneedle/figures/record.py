"""The figure of a plan or an insertion."""

from matplotlib.figure import Figure

from flexneedle.figures.insertion import insertion_figure
from flexneedle.figures.plans import plan_figure
from flexneedle.results import Insertion, Plan, scenario_of


def plot(record: Plan | Insertion) -> Figure:
    """Return the figure of a plan or of an insertion, as `flexneedle view` draws it.

    An insertion without a period is drawn as its plan.

    Raises:
        InputError: Not a plan or insertion, or without a scenario.
    """
    scenario = scenario_of(record)
    if isinstance(record, Insertion) and record.periods:
        return insertion_figure(scenario, record)
    return plan_figure(scenario, [record.plan if isinstance(record, Insertion) else record])
