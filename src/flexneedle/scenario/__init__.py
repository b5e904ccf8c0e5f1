"""Scenarios: what is inserted, into what, towards what, and with which settings."""

from .apparatus import Setup, Tracker
from .fields import Section
from .files import dump_scenario, load_scenario
from .model import Scenario, check_target
from .monitor import Monitor
from .needle import GAUGES, Bevel, Needle
from .preset import preset_names
from .registration import Registration
from .settings import Control, Phantom, Plan, Target, elite_count
from .tissue import Contact, Layer

__all__ = [
    "GAUGES",
    "Bevel",
    "Contact",
    "Control",
    "Layer",
    "Monitor",
    "Needle",
    "Phantom",
    "Plan",
    "Registration",
    "Scenario",
    "Section",
    "Setup",
    "Target",
    "Tracker",
    "check_target",
    "dump_scenario",
    "elite_count",
    "load_scenario",
    "preset_names",
]
