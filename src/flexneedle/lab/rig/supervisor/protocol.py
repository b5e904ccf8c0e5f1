"""Messages between the supervisor and its client, pickled on a channel of one machine.

Positions of axes are in mm or rad, times in s on the run's clock.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

from flexneedle.geometry.rigid import Rigid
from flexneedle.lab.rig.devices.lock import describe_program
from flexneedle.lab.rig.rig_file import RigFile
from flexneedle.lab.rig.supervisor.machine import SupervisorState
from flexneedle.ports import MotorState
from flexneedle.scenario.sections.monitor import MonitorSettings
from flexneedle.types import Measurement, Point


@dataclass(frozen=True)
class SupervisorTask:
    """Task of a supervisor, its first message.

    started: zero of the run's clock on the monotonic clock (s); lateral_axes: of the needle; to_stage: map from the
    tracker's frame to the frame of the insertion; tip_offset: from the sensor to the tip (mm); stale_after: age (s)
    above which a reading is stale; dry: motors are read, and never moved; tracked: the tracker is opened; client:
    program that the motors are held for, for the message to another one.
    """

    rig: RigFile
    started: float
    lateral_axes: int
    monitor: MonitorSettings
    to_stage: Rigid
    tip_offset: float
    stale_after: float
    dry: bool = False
    tracked: bool = True
    client: str = field(default_factory=describe_program)


@dataclass(frozen=True)
class Expectation:
    """Expected positions (mm) of the tip at begin and end of a step.

    most_off: largest distance of a reading from them (mm); sensed: a sensor along the needle measures it, and corrects
    the estimate, so that a lost tracker ends neither this step nor the rest after it.
    """

    begin: Point
    end: Point
    most_off: float
    sensed: bool = False


# To the supervisor


@dataclass(frozen=True)
class Heartbeat:
    """A sign of life of the client."""


@dataclass(frozen=True)
class ArmCommand:
    """Switch motors on and take their positions as the start. deepest: largest advance (mm) from there."""

    deepest: float


@dataclass(frozen=True)
class StepCommand:
    """A step of an insertion.

    The roll (rad) takes `roll_duration` s and is confirmed by its position; then follows `travel` by axis in
    `duration` s. An axis that needs more time takes longer.
    """

    number: int
    roll: float
    travel: Mapping[str, float]
    duration: float
    expected: Expectation | None = None
    roll_duration: float = 0.0


@dataclass(frozen=True)
class MoveCommand:
    """Move one axis alone to a position, at most at `speed` (mm/s or rad/s).

    retract: as a withdrawal of the base, and not as a motion of the operator.
    """

    number: int
    axis: str
    position: float
    speed: float
    retract: bool = False


@dataclass(frozen=True)
class HomeCommand:
    """Find the home of an axis."""

    number: int
    axis: str


@dataclass(frozen=True)
class StopCommand:
    """Stop all motors. who: the keyboard, a service, a signal."""

    who: str


@dataclass(frozen=True)
class ResetCommand:
    """Leave the states stopped and fault; nothing moves."""


@dataclass(frozen=True)
class OffCommand:
    """Switch all motors off, after a stop."""


@dataclass(frozen=True)
class CloseCommand:
    """Stop, and end the supervisor."""


Request = (
    Heartbeat
    | ArmCommand
    | StepCommand
    | MoveCommand
    | HomeCommand
    | StopCommand
    | ResetCommand
    | OffCommand
    | CloseCommand
)


# From the supervisor


@dataclass(frozen=True)
class AxisState:
    """Measured position of an axis, its motor, and the distance to its last target (mm or rad)."""

    position: float
    motor: MotorState
    queued: float = 0.0


@dataclass(frozen=True)
class MotionResult:
    """End of a motion, and the travel by axis, from `begun` to `ended` (s).

    turned: begin of the travel after a roll, None without a roll; why: reason why it ended before its goal, or "";
    state: of the rig after it.
    """

    number: int
    travelled: Mapping[str, float]
    begun: float
    ended: float
    state: SupervisorState
    why: str = ""
    turned: float | None = None


@dataclass(frozen=True)
class RequestRefused:
    """A request that the state does not allow, or that breaks a limit; nothing moved.

    number: of the motion, or 0; state, cause: of the rig, and the reason of a stop or fault.
    """

    number: int
    why: str
    state: SupervisorState
    cause: str = ""


@dataclass(frozen=True)
class TickReport:
    """Report of one tick.

    time: of the tick (s); state, why: of the rig, and the reason of a stop, hold or fault, or a note of what arming
    has changed; axes: by name; measurements: since the last report, oldest first; tracker: its status; at_rest: no
    motion and no stop is under way; late, work: delay and duration of the tick (s); missed: ticks left out since the
    start; requests: number of requests acted on, so that a client can wait for the effect of its request.
    """

    time: float
    state: SupervisorState
    why: str = ""
    axes: Mapping[str, AxisState] = field(default_factory=dict)
    measurements: tuple[Measurement, ...] = ()
    tracker: str = ""
    at_rest: bool = True
    late: float = 0.0
    work: float = 0.0
    missed: int = 0
    requests: int = 0


@dataclass(frozen=True)
class SupervisorEnded:
    """End of the supervisor; why: the reason, "" at a request."""

    why: str = ""
