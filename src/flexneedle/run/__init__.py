"""Whole tasks: plan an insertion, carry it out."""

from flexneedle.run.insertion import insert
from flexneedle.run.planner import plan

__all__ = ["insert", "plan"]
