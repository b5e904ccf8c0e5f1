"""`offset-free`: CE-MPC on a model whose prediction has no offset: start fitted in air, tip load learnt in tissue."""

from flexneedle.control.interface import Method
from flexneedle.control.methods.ce_mpc import decide
from flexneedle.control.observer import Beliefs

METHOD = Method(
    "offset-free",
    "cross-entropy MPC on a model that learns start and tip load",
    Beliefs(),
    begin=lambda _task: None,
    decide=decide,
)
