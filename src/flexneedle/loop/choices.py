"""Choices of an insertion besides its scenario and plan, resolved once."""

from dataclasses import dataclass
from typing import Any

from flexneedle.arguments import check_whole, make_refusal
from flexneedle.control.controllers import DEFAULT, find_controller
from flexneedle.control.interface import Controller
from flexneedle.loop.rig import RigSource
from flexneedle.loop.virtual import VirtualRig

_PARTS_OF_SOURCE = ("names", "moves", "check", "open", "results")


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
        source = VirtualRig() if rig is None else rig
        if isinstance(source, type) or not all(hasattr(source, part) for part in _PARTS_OF_SOURCE):
            wanted = "must be a VirtualRig, a Rig with its ports, or the rig of a rig file"
            raise make_refusal("rig", source, wanted, "see flexneedle.devices.open_rig")
        return cls(check_whole("seed", seed, 0), name, resolved, source, force, threads)

    @property
    def parts(self) -> dict[str, Any]:
        """Fields of `Insertion` that name controller, phantom, tracker and rig."""
        return {"controller": self.name, **self.rig.names}
