"""The job of the processes of an emulated rig."""

from dataclasses import dataclass
from pathlib import Path

from flexneedle.errors import InputError, RigError
from flexneedle.lab.emulators.emulated_rig.axes import carriages_of
from flexneedle.lab.rig.rig_file import RigFile
from flexneedle.planning.origin import check_origin, with_planned_entry
from flexneedle.results import Insertion, Plan
from flexneedle.scenario.model import Scenario
from flexneedle.scenario.sensors.fbg import Fbg
from flexneedle.scenario.sensors.points import Points
from flexneedle.scenario.sensors.slice import Slice
from flexneedle.scenario.sensors.view import View


@dataclass(frozen=True)
class EmulationJob:
    """A rig, the scenario of its phantom, the seed of the draw, and the file of the true states or None.

    faults: texts of scheduled faults by device, "aurora", "galil" or "fbgs"; save: new file for the rig file with the
    addresses, or None.
    """

    rig: RigFile
    scenario: Scenario
    seed: int = 0
    truth: Path | None = None
    faults: tuple[tuple[str, str], ...] = ()
    save: Path | None = None

    @property
    def fibre(self) -> Fbg | None:
        """The fibre with gratings in the needle, None without one."""
        return next((one for one in self.scenario.sensor if isinstance(one, Fbg)), None)

    @property
    def images(self) -> tuple[Slice | Points | View, ...]:
        """The sensors along the needle that images are."""
        return tuple(one for one in self.scenario.sensor if isinstance(one, Slice | Points | View))

    def faults_of(self, device: str) -> list[str]:
        """Return the texts of the scheduled faults of a device."""
        return [text for name, text in self.faults if name == device]


def make_job(
    rig: RigFile,
    scenario: Scenario,
    record: object,
    seed: int,
    truth: Path | None,
    faults: tuple[tuple[str, str], ...],
    save: Path | None = None,
) -> EmulationJob:
    """Return the job of a rig, a scenario, and the record of a plan, of an insertion or None.

    Raises InputError if it cannot be emulated: devices or sensors of another kind, a tracker in an environment, an
    entry that is free without a plan, several plans, one of another scenario, or several fibres; RigError for axes that
    the phantom cannot have.
    """
    for part, kind in (("driver", "galil"), ("tracker", "aurora")):
        if (given := getattr(rig, part).kind) != kind:
            raise RigError(f"{part}.kind = {given!r}: must be {kind!r} to be emulated")
    if scenario.tracker.environment is not None:
        raise InputError("tracker.environment: the emulated tracker has white noise only; leave it out")
    plan = record.plan if isinstance(record, Insertion) else record
    if isinstance(plan, Plan):
        scenario = with_planned_entry(scenario, plan)
        check_origin(plan, scenario)
    elif plan is not None:
        raise InputError(
            "--plan: the folder has several plans; make one with flexneedle plan --strategy NAME"
        )
    elif scenario.entry.free:
        raise InputError(
            "entry: the plan chooses it (free_radius_mm, free_slope_mrad); give the plan with --plan"
        )
    carriages_of(rig.axes, scenario)
    job = EmulationJob(rig, scenario, seed, truth, faults, save)
    if sum(isinstance(one, Fbg) for one in scenario.sensor) > 1:
        raise InputError("sensor: an emulated rig has one sensor of kind fbg; leave the others out")
    for one in scenario.sensor:
        if not isinstance(one, Fbg | Slice | Points | View):
            rule = "must be fbg, slice, points or view to be emulated; leave it out"
            raise InputError(f'sensor {one.title}: kind = "{one.kind}": {rule}')
    if job.fibre is None and job.faults_of("fbgs"):
        raise InputError("--fault fbgs: the scenario has no sensor of kind fbg")
    return job
