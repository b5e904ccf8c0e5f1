"""Fibre of an emulated rig: a process with an FBGS stream of the curvatures of the phantom.

`python -m flexneedle.lab.emulators.emulated_rig.fibre_part PARENT PHANTOM`, with descriptors of channels. The gratings
are at the sites of the scenario, and have the errors and faults of the virtual sensor.
"""

from collections.abc import Mapping
from time import monotonic
from typing import Any

import numpy as np

from flexneedle.errors import RigError
from flexneedle.lab.emulators.emulated_rig.child import Parent, run
from flexneedle.lab.emulators.emulated_rig.following import NeedleHistory
from flexneedle.lab.emulators.emulated_rig.job import EmulationJob
from flexneedle.lab.emulators.emulated_rig.stream import receive_first, receive_records
from flexneedle.lab.emulators.faults import parse_fault
from flexneedle.lab.emulators.fbgs import FAULTS, UNUSED, FbgsServer, FbgsSession, serve
from flexneedle.lab.process import MessageChannel
from flexneedle.lab.rig.devices.fbg.fbgs import FbgsSettings
from flexneedle.lab.rig.devices.priority import set_realtime_priority
from flexneedle.lab.rig.rig_file import RigFile
from flexneedle.loop.virtual import Seeds, virtual_sensors
from flexneedle.scenario.sensors.fbg import Fbg
from flexneedle.types import Floats, Matrix

_HOST = "127.0.0.1"
_BEHIND_MM = 10.0  # distance of the grating without values behind a single site: a stream has two at least


def main(job: EmulationJob, parent: Parent, channels: list[MessageChannel]) -> None:
    """Serve the stream at its address until the parent ends."""
    (phantom,), fibre = channels, job.fibre
    if fibre is None:
        raise ValueError("the scenario has no fibre")
    needle = NeedleHistory(begun := monotonic(), receive_first(phantom))
    parent.others, parent.take = channels, lambda: needle.add(receive_records(phantom))
    sensor = virtual_sensors(job.scenario, needle, Seeds.of(job.seed))[fibre.title]
    needle.late = sensor.clock_error

    def newest(_now: float) -> Floats | None:
        parent.take()
        readings = sensor.read()
        return to_bends(readings[-1].rows, len(fibre.sites_mm)) if readings else None

    faults = [parse_fault(text, FAULTS) for text in job.faults_of("fbgs")]
    first = begun + needle.late + fibre.delay_s  # on arrival
    session = FbgsSession(faults, first, job.seed, newest, fibre.rate_hz)
    with FbgsServer(*address_of_fibre(job.rig, fibre)) as tcp:
        set_realtime_priority()
        parent.report(ready="{}:{}".format(*tcp.address))
        serve(session, tcp, parent, lambda order: parent.obey(session.schedule, order), parent.note)


def to_bends(rows: Matrix, sites: int) -> Floats:
    """Return κy, κz (2, n), 1/mm, at the gratings of these sites: NaN where a reading has none, κz = 0 in the plane."""
    bends = np.full((2, max(sites, 2)), np.nan)
    if rows:
        bends[:, :sites] = 0.0
        bends[: len(rows[0]), :sites] = np.array(rows).T
    return bends


def section_of(fibre: Fbg, address: str) -> Mapping[str, Any]:
    """Return the table `[[sensor]]` of a rig file for the emulated fibre at HOST:PORT."""
    host, _, port = address.rpartition(":")
    sites = fibre.sites_mm
    gratings = sites if len(sites) > 1 else (*sites, sites[0] + _BEHIND_MM)
    given = {"host": host, "port": int(port), "positions_mm": list(gratings), "first": UNUSED + 1}
    return {"name": fibre.title, "kind": "fbgs", **given}


def address_of_fibre(rig: RigFile, fibre: Fbg) -> tuple[str, int]:
    """Return host and port of the fibre in a rig file; any free port of this machine if the file has no such sensor.

    Raises RigError if its gratings are not at the sites of the fibre.
    """
    part = next((one for one in rig.sensor if one.name == fibre.title), None)
    if part is None:
        return _HOST, 0
    given = {"port": FbgsSettings.model_fields["port"].default, **part.settings}
    offered = section_of(fibre, f"{given.get('host')}:{given['port']}")
    if {"name": part.name, "kind": part.kind, **given} != offered:
        wanted = ", ".join(f"{key} = {offered[key]}" for key in ("positions_mm", "first"))
        raise RigError(
            f'sensor {part.name}: must have kind = "fbgs", host, port, {wanted} and no other key to be emulated'
        )
    return given["host"], given["port"]


if __name__ == "__main__":
    run(main)
