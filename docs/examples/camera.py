"""A camera above the phantom: 20 images per second, the tip to the nearest pixel."""

import math

from flexneedle import Measurement

RATE_HZ, PIXEL_MM, BLIND = 20.0, 0.1, 0.02


class Camera:
    """A tracker that finds the tip in most images."""

    status = "ok"

    def __init__(self, scenario, phantom, rng):
        self.phantom, self.rng, self.images = phantom, rng, 0

    def read(self):
        """Return the readings of the images since the last call."""
        due = math.floor(self.phantom.now() * RATE_HZ + 1e-6) + 1
        taken = range(self.images, due)
        self.images = due
        return tuple(self.sample(number) for number in taken)

    def sample(self, number):
        """Return the reading of an image; the first always shows the tip."""
        time = number / RATE_HZ
        if self.rng.random() < BLIND and number > 0:
            return Measurement(time, None, None)
        x, y = (PIXEL_MM * round(value / PIXEL_MM) for value in self.phantom.tip_at(time)[:2])
        return Measurement(time, x, y)
