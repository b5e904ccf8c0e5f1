"""The virtual phantom: a needle in tissue that is not the model of the controller."""
