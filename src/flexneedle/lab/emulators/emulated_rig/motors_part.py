"""Motors of an emulated rig: a process with a Galil whose travel is sent to the phantom.

`python -m flexneedle.lab.emulators.emulated_rig.motors_part PARENT PHANTOM`, with descriptors of channels.
"""

from collections.abc import Sequence
from dataclasses import replace
from time import monotonic

from flexneedle.errors import RigError
from flexneedle.lab.emulators.emulated_rig.axes import carriages_of, channels_of
from flexneedle.lab.emulators.emulated_rig.child import Parent, run
from flexneedle.lab.emulators.emulated_rig.job import EmulationJob
from flexneedle.lab.emulators.emulated_rig.stream import Record, send_record
from flexneedle.lab.emulators.faults import parse_fault
from flexneedle.lab.emulators.galil.controller import ControllerState
from flexneedle.lab.emulators.galil.galil_server import FAULTS, GalilSession, TcpServer, serve
from flexneedle.lab.process import MessageChannel
from flexneedle.lab.rig.devices.galil.settings import split_address
from flexneedle.lab.rig.devices.priority import set_realtime_priority
from flexneedle.lab.rig.rig_file import RigFile

_REST_S = 0.02  # between two records at rest: a frame of the tracker waits for the next one


def main(job: EmulationJob, parent: Parent, channels: list[MessageChannel]) -> None:
    """Serve the controller at its address until the parent ends."""
    (phantom,) = channels
    faults = [parse_fault(text, FAULTS) for text in job.faults_of("galil")]
    with TcpServer(*address_of(job.rig)) as tcp:
        set_realtime_priority()
        session = GalilSession(make_controller(job), faults, monotonic())
        session.observe = _Observer(session, parent, phantom)
        parent.report(ready="{}:{}".format(*tcp.address))
        serve(session, tcp, parent, lambda order: parent.obey(session.schedule, order), parent.note)


def make_controller(job: EmulationJob) -> ControllerState:
    """Return the controller at power-on, with the limit switches of its axes."""
    carriages, channels = carriages_of(job.rig.axes, job.scenario), channels_of(job.rig.axes)
    axes = list(ControllerState().axes)
    for name, carriage in carriages.items():
        axes[channels[name]] = replace(axes[channels[name]], switches=carriage.switches)
    return ControllerState(tuple(axes))


def address_of(rig: RigFile) -> tuple[str, int]:
    """Return host and port of the controller in a rig file. Raises RigError."""
    given = rig.driver.settings.get("address")
    try:
        return split_address(given if isinstance(given, str) else "", lowest=0)  # 0: any free port
    except ValueError as error:
        raise RigError(f"driver.address = {given!r}: {error}") from None


class _Observer:
    """Sender of the motors' travel: every few samples during a motion, less often at rest."""

    def __init__(self, session: GalilSession, parent: Parent, phantom: MessageChannel) -> None:
        self._session, self._parent, self._phantom = session, parent, phantom
        self._sent, self._was_moving, self._announced = -1.0, False, False

    def __call__(self, time: float, travel: Sequence[float], moving: bool) -> None:
        due = time - self._sent >= _REST_S
        if (moving != self._was_moving) or (moving and time > self._sent) or due:
            send_record(self._phantom, Record(time, tuple(travel), moving), "phantom")
            self._sent, self._was_moving = time, moving
        if not self._announced and (begun := self._session.schedule.since) is not None:
            self._announced = True
            self._parent.report(event="first motion", time_s=begun)


if __name__ == "__main__":
    run(main)
