"""Choices of an insertion besides its scenario and plan, resolved once."""

from dataclasses import dataclass
from typing import Any

from flexneedle.arguments import check_instance, check_whole
from flexneedle.control.controllers import CONTROLLERS, DEFAULT, find_controller
from flexneedle.control.interface import Controller
from flexneedle.loop.rig import RigSource
from flexneedle.loop.virtual import VirtualRig


@dataclass(frozen=True, eq=False)
class Choices:
    """Seed, controller with its name in the record, rig, and options of an insertion."""

    seed: int
    name: str
    controller: Controller
    rig: RigSource
    force: bool = False
    threads: int | None = None

    @classmethod
    def of(
        cls,
        seed: int = 0,
        controller: str | Controller = DEFAULT,
        rig: RigSource | None = None,
        *,
        force: bool = False,
        threads: int | None = None,
    ) -> "Choices":
        """Return the resolved choices. Raises InputError for an unknown controller, and for anything but a rig."""
        name, resolved = find_controller(controller)
        known = "such as a VirtualRig, a Rig with its ports, or the rig of flexneedle.devices.open_rig"
        source = check_instance("rig", VirtualRig() if rig is None else rig, RigSource, known)
        return cls(check_whole("seed", seed, 0), name, resolved, source, force, threads)

    @property
    def parts(self) -> dict[str, Any]:
        """Fields of `Insertion` that name controller, phantom, tracker and rig."""
        own = self.controller.name
        shown = self.name if own in CONTROLLERS else own  # another one's name would mislead
        return {"controller": self.name, "controller_name": shown, **self.rig.names}
