"""The needle at the start of the insertion, bent by its guide."""

from flexneedle.lab.page.frames import Kind, Source, frame_of
from flexneedle.lab.page.worker.task import Task
from flexneedle.simulator.simulator import Simulator


def needle(task: Task) -> None:
    """Report the needle of a scenario at the start."""
    nodes = Simulator(task.scenario, threads=1).start().nodes[:, :3]
    task.show(frame_of(Kind.NEEDLE, Source.SCENE, 0, nodes))
