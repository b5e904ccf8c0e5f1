import numpy as np

import flexneedle


class Fung(flexneedle.Layer):
    """W = (exp(b e²) − 1) / 2b."""

    limit = 0.7
    exponent: float
    """Exponent b."""

    def energy(self, e):
        return np.expm1(self.exponent * e**2) / (2 * self.exponent)

    def force(self, e):
        return e * np.exp(self.exponent * e**2)

    def stiffness(self, e):
        return (1 + 2 * self.exponent * e**2) * np.exp(self.exponent * e**2)
