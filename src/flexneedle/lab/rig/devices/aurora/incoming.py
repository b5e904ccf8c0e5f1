"""Frames, counts and status from the messages of one link after another."""

from collections import Counter, deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from threading import Lock
from time import monotonic
from typing import Any

from flexneedle.lab.rig.devices.aurora.messages import Message, to_one_line
from flexneedle.lab.rig.devices.aurora.readings import make_readings, sensor_name
from flexneedle.lab.rig.devices.aurora.timing import Numbering, Timeline
from flexneedle.types import VISIBLE, Frame, SensorReading

RATE_HZ = 40.0
"""Frame rate of an Aurora."""

Location = tuple[str, str]
"""Port and channel of a sensor."""

_QUEUE = 4000  # frames: 100 s without a call of `read`
_LATE_S = 0.15  # six frames


@dataclass(frozen=True)
class AuroraCounts:
    """Counts since the start.

    frames received, frame numbers missed, frames dropped before they were read, connections after the first, and
    errors by kind ("garbled", "no reply", "error", "system", "unplugged"; "crash": the link ended without a reason,
    or sent an invalid message).
    """

    frames: int
    missed: int
    dropped: int
    reconnections: int
    errors: Mapping[str, int]


class LinkReceiver:
    """Receiver of the links' messages. One thread calls `take`, others may read.

    names: of the sensors at ports 1, 2, …; offset (s): from the monotonic clock to the run's clock; now: the
    monotonic clock.
    """

    def __init__(self, names: Sequence[str], offset: float, now: Callable[[], float] = monotonic) -> None:
        self._names, self._offset, self._now = tuple(names), offset, now
        self._frames: deque[Frame] = deque(maxlen=_QUEUE)
        self._numbering = Numbering(RATE_HZ)
        self._lock = Lock()
        self._received = self._missed = self._dropped = 0
        self._connections = 0
        self._errors: Counter[str] = Counter()
        self._last: tuple[int, float] | None = None
        self._reason = "connecting"
        self.begin_link()

    def begin_link(self) -> None:
        """Reset the state of the link, for a new one."""
        self._named: dict[str, str] = {}
        self._failed: dict[str, SensorReading] = {}
        self._again = False
        self._newest = -1, self._now()
        self._ended = False
        self._timeline = Timeline(RATE_HZ)

    def take(self, message: Message) -> None:
        """Take a message of the link. Raises ValueError for one out of order, after which the link is not trusted."""
        tracks = bool(self._named) and not self._ended
        match message:
            case ("ready", ports, failed) if not (self._named or self._ended):
                self._set_names(ports, failed)
            case ("plugged",) if tracks:  # the sensors are set up again
                self._named, self._newest = {}, (-1, self._newest[1])
                self.set_reason("a sensor was plugged in")
            case ("frame", number, requested, found) if tracks:
                self._add_frame(number, requested, found)
            case ("error", kind, description) if tracks:
                with self._lock:
                    self._errors[kind] += 1
                    self._reason = to_one_line(description)
            case ("end", reason) if not self._ended:
                self._ended = True
                self.set_reason(reason)
            case _:
                raise ValueError(f"a message out of order: {str(message)[:60]}")

    def record_crash(self, reason: str) -> None:
        """Count a link that ended without a reason, or with an invalid message."""
        with self._lock:
            self._errors["crash"] += 1
            self._reason = to_one_line(reason)

    def set_reason(self, reason: str) -> None:
        """Set the reason why there are no frames."""
        with self._lock:
            self._reason = to_one_line(reason)

    def read(self) -> tuple[Frame, ...]:
        """Return the frames since the last call, oldest first."""
        with self._lock:
            frames = tuple(self._frames)
            self._frames.clear()
        return frames

    @property
    def reason(self) -> str:
        """VISIBLE after a frame, else the reason why no frame arrives."""
        with self._lock:
            return self._reason

    @property
    def status(self) -> str:
        """VISIBLE while frames arrive, else the reason in a few words."""
        with self._lock:
            last, reason = self._last, self._reason
        if reason != VISIBLE:
            return reason
        silent = self._now() - last[1] if last is not None else 0.0
        return VISIBLE if silent < _LATE_S else f"no frame for {silent:.1f} s"

    @property
    def connections(self) -> int:
        """Number of links that became ready."""
        with self._lock:
            return self._connections

    @property
    def counts(self) -> AuroraCounts:
        """Counts since the start."""
        with self._lock:
            again = max(0, self._connections - 1)
            return AuroraCounts(self._received, self._missed, self._dropped, again, dict(self._errors))

    def _set_names(
        self, ports: Mapping[str, Location], failed: Mapping[str, tuple[Location | None, str]]
    ) -> None:
        named = {h: sensor_name(*location, self._names) for h, location in ports.items()}
        without = {
            f"handle{int(h):02X}" if location is None else sensor_name(*location, self._names): why
            for h, (location, why) in failed.items()
        }
        if len(set(named.values())) < len(named):
            raise ValueError(f"two sensors with one name: {', '.join(named.values())}")
        self._named = named
        self._failed = {
            name: SensorReading(None, status=to_one_line(why))
            for name, why in without.items()
            if name not in named.values()  # another handle of its port is read
        }
        with self._lock:
            self._connections += not self._again
        self._again = True

    def _add_frame(self, device_number: int, requested: float, found: Mapping[str, Sequence[Any]]) -> None:
        self._check_frame(device_number, requested, found)
        self._newest = device_number, requested
        number = self._numbering.count(device_number, requested)
        time = self._timeline.stamp(number, requested) + self._offset
        readings = make_readings(found, device_number, self._named) | self._failed
        frame = Frame(time, number, readings)
        with self._lock:
            self._missed += 0 if self._last is None else number - self._last[0] - 1
            self._dropped += len(self._frames) == _QUEUE
            self._received += 1
            self._last, self._reason = (number, requested), VISIBLE
            self._frames.append(frame)

    def _check_frame(self, number: int, requested: float, found: Mapping[str, Sequence[Any]]) -> None:
        """Raise ValueError for a frame that is not new, of the future, or without a sensor or with a foreign one."""
        newest, last_requested = self._newest
        if number <= newest:
            raise ValueError(f"frame {number} after frame {newest}")
        if not last_requested <= requested <= self._now():
            raise ValueError(f"frame {number} was requested at {requested:.3f} s, before or after its time")
        if found.keys() != self._named.keys():
            raise ValueError(f"frame {number} has sensors {', '.join(found)}, not {', '.join(self._named)}")
