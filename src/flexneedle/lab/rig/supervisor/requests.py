"""Requests: their rules, and the motions of steps, of jogs and of searches of homes. Pure functions."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from flexneedle.lab.rig.supervisor.checks import resting_switch_problem, switch_problem
from flexneedle.lab.rig.supervisor.drives import Drive, homing_reach, homing_speed, position_after_homing
from flexneedle.lab.rig.supervisor.motion import CommandedMotion
from flexneedle.lab.rig.supervisor.protocol import HomeCommand, MoveCommand, StepCommand
from flexneedle.lab.rig.supervisor.trajectory import shortest_duration
from flexneedle.ports import MotorState

_ROUNDING = 1e-9


@dataclass(frozen=True)
class RequestRules:
    """Limits of requests from the present goals.

    drives: axes by name; at: their goals (mm or rad); deepest: largest position of the insertion (mm).
    """

    drives: Mapping[str, Drive]
    at: Mapping[str, float]
    deepest: float

    def step_problem(self, step: StepCommand) -> str:
        """Return the problem of a step, the end of its roll included, or ""."""
        spin = step.travel.get("rotation", 0.0)
        problem = self._travel_problem({**step.travel, "rotation": step.roll + spin})
        return problem or self._travel_problem({"rotation": step.roll})

    def move_problem(self, go: MoveCommand) -> str:
        """Return the problem of a motion of one axis, or "". From beyond its range it may move back towards it."""
        if go.axis not in self.drives:
            return self._missing_axes([go.axis])
        drive, now = self.drives[go.axis], self.at[go.axis]
        problem = self._travel_problem({go.axis: go.position - now})
        if problem and not self._leads_back(drive, now, go.position):
            return problem
        if go.retract and not (go.axis == "insertion" and go.position <= now):
            return f"retract to {drive.to_text(go.position)}: must withdraw the base, which is at {drive.to_text(now)}"
        if not 0.0 < go.speed <= drive.axis.speed * (1.0 + _ROUNDING):
            speed, fastest = (
                f"{drive.axis.to_text(one)} {drive.axis.unit}/s" for one in (go.speed, drive.axis.speed)
            )
            return f"speed of {go.axis} = {speed}: must be above 0, at most {fastest}"
        return ""

    def home_problem(self, home: HomeCommand) -> str:
        """Return the problem of the search of a home, or ""."""
        if home.axis not in self.drives:
            return self._missing_axes([home.axis])
        absolute = self.drives[home.axis].axis.home == "absolute"
        return f"{home.axis}: its absolute encoder needs no homing" if absolute else ""

    def _travel_problem(self, travel: Mapping[str, float]) -> str:
        """Return the problem of a travel by axis, or "".

        It is an unknown axis, an end outside a range, or a position too deep.
        """
        moved = {name: way for name, way in travel.items() if way}
        if missing := [name for name in moved if name not in self.drives]:
            return self._missing_axes(missing)
        ends = {name: self.at[name] + way for name, way in moved.items()}
        problem = range_problem(self.drives, list(ends.items()))
        if not problem and moved.get("insertion", 0.0) > 0.0 and ends["insertion"] > self.deepest + _ROUNDING:
            deepest = f"{self.deepest:.3f} mm, the limit of this insertion"
            return f"insertion = {ends['insertion']:.3f} mm: must be at most {deepest}"
        return problem

    def _missing_axes(self, names: list[str]) -> str:
        return f"the rig has no axis {', '.join(names)}; axes: {', '.join(self.drives)}"

    @staticmethod
    def _leads_back(drive: Drive, now: float, goal: float) -> bool:
        """Return whether a motion that begins beyond the range ends nearer to it."""
        low, high = drive.axis.limits
        return now < goal <= high if now < low else low <= goal < now if now > high else False


def make_step(step: StepCommand) -> CommandedMotion:
    """Return the motion of a step of an insertion: its roll, then its travel."""
    legs = [(step.travel, step.duration)]
    if step.roll:
        legs.insert(0, ({"rotation": step.roll}, step.roll_duration))
    return CommandedMotion(step.number, legs, step.expected, roll=bool(step.roll))


def make_move(go: MoveCommand, drive: Drive, at: float) -> CommandedMotion:
    """Return the motion of one axis alone, from its goal `at` (mm or rad)."""
    travel = go.position - at
    return CommandedMotion(
        go.number, [({go.axis: travel}, shortest_duration(abs(travel), go.speed, drive.axis.acceleration))]
    )


def make_homing(number: int, drive: Drive, *, at_switch: bool) -> CommandedMotion:
    """Return the motion that searches a home. Its axis is `home`, or `here` if the home is the present position.

    An axis at an active switch (`released`) first moves off it, since a stuck switch is no home.
    """
    if not drive.axis.to_home:
        return CommandedMotion(number, [], here=drive, unlimited=True)
    search = _homing_leg(drive, homing_reach(drive.axis))
    if at_switch:
        return CommandedMotion(number, [_back_off_leg(drive), search], released=drive, unlimited=True)
    return CommandedMotion(number, [search], home=drive, unlimited=True)


def _back_off_leg(drive: Drive) -> tuple[Mapping[str, float], float]:
    """Return the leg from the limit switch of the home into the range, as (travel by axis, duration)."""
    return _homing_leg(drive, position_after_homing(drive.axis) - drive.axis.at_home)


def _homing_leg(drive: Drive, travel: float) -> tuple[Mapping[str, float], float]:
    """Return the leg of a travel (mm or rad) at the speed of homing."""
    return {drive.name: travel}, shortest_duration(
        abs(travel), homing_speed(drive.axis), drive.axis.acceleration
    )


def leave_switch(motion: CommandedMotion, drive: Drive, shift: float) -> None:
    """Make the axis at the switch of its home move off it; shift: correction of its positions there (counts)."""
    motion.home, motion.released, motion.shift, motion.legs = None, drive, shift, [_back_off_leg(drive)]


def end_leaving_switch(motion: CommandedMotion, drive: Drive, state: MotorState) -> bool:
    """Return whether the home can be defined after an axis has left the switch; otherwise the search continues or ends.

    A switch that is still active is stuck: it shows no home, and positions are left unchanged.
    """
    motion.why = switch_problem(drive, state)
    if motion.why:
        motion.legs = []
    elif motion.legs:
        motion.home, motion.released = drive, None
    else:
        return True
    return False


def range_problem(
    drives: Mapping[str, Drive], ends: Sequence[tuple[str, float]], *, resting: bool = False
) -> str:
    """Return the problem of the first position (by axis) that is outside the axis's range, or "".

    A position beyond it by less than the tolerance is accepted, since a motor may rest there. resting: half of the
    lost motion is accepted, too.
    """
    for name, position in ends:
        axis = drives[name].axis
        (low, high), slack = axis.limits, axis.uncertainty if resting else axis.tolerance
        if not low - slack <= position <= high + slack:
            shown = drives[name].to_text
            return f"{name} = {shown(position)}: must be within {shown(low)} and {shown(high)}"
    return ""


def start_problem(drives: Mapping[str, Drive], states: Mapping[str, MotorState]) -> str:
    """Return the problem of an insertion from where axes rest (states by channel), or "".

    An axis is outside its range, or at a limit switch that is not its home.
    """
    resting = [(drive, states[drive.axis.channel]) for drive in drives.values()]
    positions = [(drive.name, drive.to_position(state.position)) for drive, state in resting]
    problems = [range_problem(drives, positions, resting=True)]
    problems += [resting_switch_problem(drive, state) for drive, state in resting]
    return next((f"arm: refused: {problem}" for problem in problems if problem), "")
