"""Thrusters: their table, allocation of a wrench, pulse modulation."""
