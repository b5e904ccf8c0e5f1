"""The virtual phantom: what an insertion runs against without a rig."""

from flexneedle.phantom.phantom import Phantom, draw

__all__ = ["Phantom", "draw"]
