"""The server of the page: clients, their session, jobs of the workers, recorded runs. It has no physics and no numba."""
