"""The server of the page: clients, session, jobs of the workers, recorded runs; no physics and no numba."""
