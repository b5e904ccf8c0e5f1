"""A message of every type of OpenIGTLink."""

from flexneedle.lab.igtl.messages import (
    NamedPoint,
    PointMessage,
    PolylineMessage,
    PositionMessage,
    StatusMessage,
    StringMessage,
    Trajectory,
    TrajectoryMessage,
    TransformMessage,
)

MATRIX = ((0.0, -1.0, 0.0, 1.5), (1.0, 0.0, 0.0, -2.25), (0.0, 0.0, 1.0, 30.0), (0.0, 0.0, 0.0, 1.0))
TARGET = NamedPoint(name="Target", position=(1.0, 2.0, 35.5), group="Fiducial", diameter=2.0, owner="CT")
PATH = Trajectory(name="Plan", entry=(0.0, 0.0, 0.0), target=(1.0, 2.0, 35.5), radius=0.5)
EXAMPLES = {
    message.type: message
    for message in (
        TransformMessage(name="Tip", time=1.5, matrix=MATRIX),
        PositionMessage(name="Tip", time=1.5, position=(1.0, 2.0, 3.0), orientation=(1.0, 0.0, 0.0, 0.0)),
        PointMessage(
            name="Target", time=1.5, points=(TARGET, NamedPoint(name="Entry", position=(0.0, 0.0, 0.0)))
        ),
        TrajectoryMessage(name="Plan", time=1.5, trajectories=(PATH,)),
        PolylineMessage(
            name="Needle", time=1.5, points=((0.0, 0.0, 0.0), (1.0, 0.5, 0.0), (2.0, 0.75, -1.0))
        ),
        StatusMessage(name="Needle", time=1.5, code=1, subcode=-2, error="OK", text="inserting"),
        StringMessage(name="Error", time=1.5, text="0.4 mm"),
    )
}
