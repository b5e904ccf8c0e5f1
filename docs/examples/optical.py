"""Our optical tracker, simulated, with a tip at rest."""

from flexneedle.devices import VISIBLE, Frame, Section, SensorReading, check_settings


class Settings(Section):
    """The keys of [tracker] besides `kind`."""

    rate_hz: float = 40.0
    """Frames per second."""


class Optical:
    """Tracker with one sensor (port `Tracker`)."""

    status = VISIBLE  # on hardware: the reason, in a few words, while no frames arrive

    def __init__(self, clock, rate_hz):
        self.clock, self.rate_hz = clock, rate_hz
        self.start, self.next = clock.now(), 0

    def read(self):
        """Return the frames since the last call, oldest first, without waiting."""
        due = int((self.clock.now() - self.start) * self.rate_hz) + 1
        numbers, self.next = range(self.next, due), due
        return tuple(self.frame(number) for number in numbers)

    def frame(self, number):
        """Return a frame with its time of measurement and its number, which counts lost frames."""
        tip = SensorReading(position=(-28.5, 0.0, 0.0))
        return Frame(self.start + number / self.rate_hz, number, {"tip": tip})

    def close(self):
        """Release the camera."""


def open_tracker(settings, clock):
    """Start the tracker; frames have the clock's times."""
    return Optical(clock, check_settings(Settings, settings).rate_hz)
