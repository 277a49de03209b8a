"""Speed of the stack: in lockstep, in real time, of its dynamics, and against another checkout.

The benchmarks are part of the package because ``spacerobot bench`` is an installed command.
"""
