"""Benchmarks: lockstep, engines, planning, real time, long flights, another checkout.

They are part of the package because ``spacerobot bench`` is an installed command.
"""
