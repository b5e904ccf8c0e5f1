"""The ports through which a controller sees the world: what moves the needle, what measures its tip."""
