"""Costs of the planner and of the predictive controllers: their terms and weights in one table."""
