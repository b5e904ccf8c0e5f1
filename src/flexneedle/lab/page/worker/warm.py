"""What a worker does before it is ready, so that its first job is as fast as the next."""

from flexneedle.lab.page.worker.plans import smaller
from flexneedle.phantom.kernels import compile_kernels
from flexneedle.planning.planner import plan
from flexneedle.scenario.files import load_scenario


def warm_up() -> None:
    """Compile all kernels, or load them from the cache, and make a small plan."""
    for axes in (1, 2):
        compile_kernels(axes)
    plan(smaller(load_scenario("phantom"), 16, 1))
