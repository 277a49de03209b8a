"""Random actions of operators on a stack, and what the specification demands of each state."""

from support.random_actions.flight import RandomFlight, random_flights
from support.random_actions.observer import Figures
from support.random_actions.setups import SETUPS, Setup

__all__ = ["SETUPS", "Figures", "RandomFlight", "Setup", "random_flights"]
