"""Tracker of an emulated rig: a process with an Aurora that measures the tip of the phantom.

`python -m flexneedle.lab.emulators.emulated_rig.tracker_part PARENT PHANTOM`, with descriptors of channels.
"""

import signal
from pathlib import Path
from time import monotonic

from flexneedle.errors import RigError
from flexneedle.lab.emulators.aurora import power_on
from flexneedle.lab.emulators.aurora_faults import FAULTS
from flexneedle.lab.emulators.aurora_server import EmulatorSession, SerialPort, serve
from flexneedle.lab.emulators.emulated_rig.child import Parent, run
from flexneedle.lab.emulators.emulated_rig.following import TipHistory
from flexneedle.lab.emulators.emulated_rig.job import EmulationJob
from flexneedle.lab.emulators.emulated_rig.stream import receive_first, receive_records
from flexneedle.lab.emulators.faults import parse_fault
from flexneedle.lab.emulators.motion import SensorNoise
from flexneedle.lab.process import MessageChannel
from flexneedle.lab.rig.devices.priority import set_realtime_priority
from flexneedle.lab.rig.rig_file import RigFile
from flexneedle.scenario.model import Scenario


def main(job: EmulationJob, parent: Parent, channels: list[MessageChannel]) -> None:
    """Serve the tracker at its port until the parent ends."""
    (phantom,) = channels
    faults = [parse_fault(text, FAULTS) for text in job.faults_of("aurora")]
    followed = TipHistory(begun := monotonic(), receive_first(phantom))
    parent.others, parent.take = channels, lambda: followed.add(receive_records(phantom))
    session = EmulatorSession(power_on(), faults, job.seed, begun, tip=followed, noise=noise_of(job.scenario))
    session.on_tracking = lambda now: parent.report(event="tracking", time_s=now)
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # so that the link is removed then, too
    with SerialPort(Path(port_of(job.rig))) as serial:
        set_realtime_priority()
        parent.report(ready=str(serial.link))
        serve(session, serial, parent, lambda order: parent.obey(session.schedule, order), parent.note)


def port_of(rig: RigFile) -> str:
    """Return the path of the tracker in a rig file. Raises RigError."""
    given = rig.tracker.settings.get("port")
    if not isinstance(given, str) or not given:
        raise RigError(f'tracker.port = {given!r}: must be a path, such as "/tmp/aurora"')
    return given


def noise_of(scenario: Scenario) -> SensorNoise:
    """Return the errors of the tip's sensor in a scenario."""
    settings = scenario.tracker
    return SensorNoise(
        settings.jitter_mm, settings.direction_jitter or 0.0, scenario.phantom.missing_fraction
    )


if __name__ == "__main__":
    run(main)
