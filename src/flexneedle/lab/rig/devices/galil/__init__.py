"""Motors on a Galil DMC-4143, over TCP."""
