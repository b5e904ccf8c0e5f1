"""Ports of a dry run: the supervisor simulates all motions, and the needle is the virtual phantom's."""

from flexneedle.errors import InputError
from flexneedle.loop.rig import Rig
from flexneedle.phantom.phantom import Condition, Phantom
from flexneedle.types import Control, Measurement, Motion


class DryRunPorts:
    """Clock, driver and tracker of a supervised rig whose motors do not move, with a virtual needle that does."""

    def __init__(self, supervised: Rig, virtual: Rig, phantom: Phantom) -> None:
        self._supervised, self._virtual, self._phantom = supervised, virtual, phantom

    def now(self) -> float:
        """Return the seconds since the start of the run."""
        return self._supervised.clock.now()

    def wait(self, seconds: float) -> None:
        """Wait for `seconds`."""
        self._supervised.clock.wait(seconds)
        self._rest_until(self.now())

    def apply(self, command: Control, duration: float) -> Motion:
        """Apply a motion to the supervisor's simulated motors, and to the virtual needle."""
        motion = self._supervised.driver.apply(command, duration)
        self._rest_until(motion.begun)
        done = motion.control if motion.held else command
        self._phantom.apply(done, max(motion.ended - motion.travel_begun, 1e-3))
        return motion

    def stop(self) -> None:
        """Stop the simulated motors."""
        self._supervised.driver.stop()

    def read(self) -> tuple[Measurement, ...]:
        """Return the readings of the virtual tracker since the last call."""
        self._rest_until(self.now())
        return self._virtual.tracker.read()

    @property
    def status(self) -> str:
        """Status of the virtual tracker."""
        return self._virtual.tracker.status

    def condition(self) -> Condition:
        """Return the state of the virtual needle."""
        return self._phantom.condition()

    def _rest_until(self, time: float) -> None:
        """Let the virtual needle rest until a time (s)."""
        left = time - self._phantom.now()
        if left > 0.0:
            self._phantom.wait(left)


def dry_run_ports(supervised: Rig, virtual: Rig) -> Rig:
    """Return the rig of a dry run: supervised motions, and the needle and sensors of a virtual rig.

    Raises InputError if that has no phantom.
    """
    if not isinstance(virtual.driver, Phantom):
        raise InputError("a dry run needs a virtual phantom")
    ports = DryRunPorts(supervised, virtual, virtual.driver)
    return Rig(ports, ports, ports, ports.condition, sensors=virtual.sensors)
