"""How far a tracker can be trusted, from repeated measurements on a grid (paper, section IV-B)."""
