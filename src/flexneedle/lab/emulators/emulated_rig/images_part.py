"""Images of an emulated rig: a process with an OpenIGTLink server of points of the phantom.

`python -m flexneedle.lab.emulators.emulated_rig.images_part PARENT PHANTOM`, with descriptors of channels. Each sensor
`slice`, `points` or `view` of the scenario is a device, whose POINT messages have the errors and faults of the virtual
sensor.
"""

import asyncio
import select
from collections.abc import Mapping
from time import monotonic
from typing import Any

import numpy as np

from flexneedle.errors import RigError
from flexneedle.geometry.rigid import Rigid, identity
from flexneedle.lab.emulators.emulated_rig.child import Parent, run
from flexneedle.lab.emulators.emulated_rig.following import NeedleHistory
from flexneedle.lab.emulators.emulated_rig.job import EmulationJob
from flexneedle.lab.emulators.emulated_rig.stream import receive_first, receive_records
from flexneedle.lab.igtl.endpoint import IgtlServer
from flexneedle.lab.igtl.messages import NamedPoint, PointMessage
from flexneedle.lab.igtl.sensor import IgtlSensorSettings
from flexneedle.lab.images.frames import registration_of
from flexneedle.lab.process import MessageChannel
from flexneedle.lab.rig.devices.priority import set_realtime_priority
from flexneedle.lab.rig.rig_file import check_settings
from flexneedle.loop.virtual import Seeds, virtual_sensors
from flexneedle.phantom.tracking.along import VirtualSensor
from flexneedle.types import Matrix

_HOST = "127.0.0.1"
_TICK_S = 0.005


def main(job: EmulationJob, parent: Parent, channels: list[MessageChannel]) -> None:
    """Send the readings of all images until the parent ends."""
    (phantom,) = channels
    begun, first, seeds = monotonic(), receive_first(phantom), Seeds.of(job.seed)
    needles = {one.title: NeedleHistory(begun, first) for one in job.images}
    sensors = {name: virtual_sensors(job.scenario, one, seeds)[name] for name, one in needles.items()}
    for name, needle in needles.items():
        needle.late = sensors[name].clock_error

    def take() -> None:
        records = receive_records(phantom)
        for needle in needles.values():
            needle.add(records)

    parent.others, parent.take = channels, take
    asyncio.run(_serve(job, parent, sensors))


async def _serve(job: EmulationJob, parent: Parent, sensors: Mapping[str, VirtualSensor]) -> None:
    registration = registration_of(job.scenario)
    to_image = identity() if registration is None else registration.inverse()
    async with IgtlServer(lambda *_: None, lambda _: None, *address_of_images(job)) as server:
        set_realtime_priority()
        parent.report(ready=f"{server.host}:{server.port}")
        while True:
            parent.read(select.select(parent.sources, [], [], 0.0)[0])
            for name, sensor in sensors.items():
                for reading in sensor.read():
                    server.send(to_message(name, reading.rows, to_image))
            await asyncio.sleep(_TICK_S)


def to_message(name: str, rows: Matrix, to_image: Rigid) -> PointMessage:
    """Return the message of a reading, without stamp; points that are not measured are left out.

    rows: x, y, z (mm) in the frame of the insertion, or column and row of pixels.
    """
    known = [row for row in rows if np.isfinite(row).all()]
    if known and len(known[0]) == 2:
        places = np.pad(np.array(known), ((0, 0), (0, 1)))
    else:
        places = to_image.apply(np.array(known).reshape(-1, 3))
    named = (NamedPoint(name=str(k), position=(x, y, z)) for k, (x, y, z) in enumerate(places.tolist()))
    return PointMessage(name=name, points=tuple(named))


def sections_of(job: EmulationJob, address: str) -> list[dict[str, Any]]:
    """Return the tables `[[sensor]]` of a rig file for the emulated images at HOST:PORT."""
    host, _, port = address.rpartition(":")
    # The time of arrival, less the delay: the delay of stamps would not be known.
    given = {"kind": "igtl", "host": host, "port": int(port), "stamps": False}
    return [{"name": one.title, "device": one.title, **given} for one in job.images]


def address_of_images(job: EmulationJob) -> tuple[str, int]:
    """Return host and port of the images in the rig file; any free port of this machine if it has none of them.

    Raises RigError for a sensor that does not read what is sent.
    """
    names, first = {one.title for one in job.images}, None
    for part in (one for one in job.rig.sensor if one.name in names):
        given = check_settings(IgtlSensorSettings, part.settings) if part.kind == "igtl" else None
        first = first or given
        sent = {"device": part.name, "stamps": False, "listen": False}
        if first is None or given != first.model_copy(update=sent):
            raise RigError(
                f'sensor {part.name}: must have kind = "igtl", device = "{part.name}", stamps = false, and host and '
                "port of the other images to be emulated"
            )
    return (_HOST, 0) if first is None else (first.host, first.port)


if __name__ == "__main__":
    run(main)
