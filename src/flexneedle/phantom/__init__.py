"""A virtual phantom: what the controller's commands do to a needle in tissue that is not the controller's model."""

from flexneedle.phantom.draw import Truth, draw
from flexneedle.phantom.phantom import Condition, Phantom
from flexneedle.phantom.plants import DEFAULT_PLANT, PLANTS, Plant, PlantFactory

__all__ = ["DEFAULT_PLANT", "PLANTS", "Condition", "Phantom", "Plant", "PlantFactory", "Truth", "draw"]
