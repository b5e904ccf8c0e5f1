"""The emulated motion controller: a Galil DMC-4143 with the commands that a needle driver needs."""
