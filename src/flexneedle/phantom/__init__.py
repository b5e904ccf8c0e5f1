"""The virtual phantom: a needle in tissue, with another model than the controller's."""
