"""Check of the sensors along the needle in air: motions, fit and findings."""
