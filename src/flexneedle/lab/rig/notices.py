"""Notices to the user of a rig."""

SWITCHED_ON = (
    "The motors of all axes are switched on first. A motor that rests away from its commanded position is switched "
    "off and on again at its present position: support a vertical axis."
)
"""Notice before any motion."""
STILL_IN = "the needle stays in place: withdraw it with {command}"
"""Notice of a needle that is left in."""
