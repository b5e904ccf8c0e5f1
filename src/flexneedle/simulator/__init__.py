"""The finite element simulator: (X, C)_{k+1} = f((X, C)_k, U_k) (paper eq. 1)."""

from flexneedle.mechanics.model import Learnt
from flexneedle.simulator.control import Control
from flexneedle.simulator.simulator import Assimilation, Rollout, Simulator
from flexneedle.simulator.state import Contacts, Reactions, State

__all__ = ["Assimilation", "Contacts", "Control", "Learnt", "Reactions", "Rollout", "Simulator", "State"]
