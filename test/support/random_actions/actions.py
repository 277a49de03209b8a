"""What an operator may do to a stack at any time, and how that is drawn."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import numpy as np
from support.random_actions.setups import CONTROLLER, Setup

PLANT = "plant"


class Kind(Enum):
    """What is done, and how often it is drawn beside the others."""

    GOAL = ("goal", 6.0)
    BURST = ("burst of goals", 2.0)
    SHAPE_GOAL = ("goal with a shape", 2.0)
    UNREACHABLE = ("unreachable goal", 2.0)
    BAD_GOAL = ("goal that is none", 1.0)
    BAD_SHAPE = ("shape that is none", 0.5)
    TIP_GOAL = ("goal of the end-effector", 3.0)
    TWIST = ("twist of the end-effector", 3.0)
    BAD_TWIST = ("twist that is none", 1.0)
    DETUMBLE = ("detumble", 1.5)
    ABORT = ("abort", 4.0)
    REARM = ("rearm", 3.0)
    PAUSE = ("pause", 1.5)
    RESUME = ("resume", 2.5)
    RESET = ("reset", 1.0)
    DEACTIVATE = ("deactivate", 1.5)
    ACTIVATE = ("activate", 3.0)
    RECONFIGURE = ("cleanup and configure", 1.0)
    FAULT = ("fault", 3.0)
    BAD_FAULT = ("fault that is none", 0.7)
    CLEAR = ("clear faults", 2.0)
    WAIT = ("wait", 3.0)

    def __init__(self, words: str, weight: float) -> None:
        self.words, self.weight = words, weight


@dataclass(frozen=True)
class Aim:
    """A goal relative to where the robot is: m, and a rotation vector in rad."""

    offset: tuple[float, ...]
    turn: tuple[float, ...]


@dataclass(frozen=True)
class Action:
    """One action, and how many ticks pass before the next.

    Attributes
    ----------
    kind
        What is done.
    node
        To which node, where it is done to one.
    aims
        Goals that are sent.
    shape
        Joint positions that are sent.
    text
        A line of fault injection; ``NOW+x`` stands for simulated times. Or what is wrong.
    ticks
        How many ticks pass afterwards, if time runs.
    """

    kind: Kind
    node: str = ""
    aims: tuple[Aim, ...] = ()
    shape: tuple[float, ...] = ()
    text: str = ""
    ticks: int = 0

    def __str__(self) -> str:
        words = [self.kind.words, self.node, self.text]
        words += [f"{aim.offset} {aim.turn}" for aim in self.aims]
        words += [str(self.shape)] if self.shape else []
        return f"{' '.join(word for word in words if word)}; {self.ticks} ticks"


_TICK_VARIABLES = (0, 0, 1, 2, 5, 20, 60, 200)

_BAD: dict[Kind, tuple[str, ...]] = {
    Kind.BAD_GOAL: ("frame", "quaternion", "nan", "infinite"),
    Kind.BAD_SHAPE: ("unknown", "short", "nan", "twice"),
    Kind.BAD_TWIST: ("1e308", "-1e155", "1e7", "nan", "inf"),
    Kind.BAD_FAULT: (
        "joint_stuck nobody",
        "joint_slow",
        "sensor_noise position 1e200",
        "sensor_bias position_x 1e308",
        "sensor_delay odom 1e9",
        "meteor base",
        "sensor_dropout odom at 1e308 until 1",
        "\x00",
        "sensor_noise position nan",
    ),
}
"""What is wrong with what is none."""


class Draw:
    """Draws actions for a setup."""

    def __init__(self, setup: Setup, rng: np.random.Generator) -> None:
        self._setup, self._rng = setup, rng
        self._joints = setup.model.joint_names
        possible = {
            Kind.SHAPE_GOAL: setup.shapes,
            Kind.BAD_SHAPE: setup.planner,
            Kind.TIP_GOAL: setup.tip,
            Kind.TWIST: setup.twists,
            Kind.BAD_TWIST: setup.twists,
            Kind.DETUMBLE: setup.controller and setup.tip,
        }
        self._kinds = [kind for kind in Kind if possible.get(kind, True)]
        weights = np.array([kind.weight for kind in self._kinds])
        self._chances = weights / weights.sum()

    def action(self) -> Action:
        """Return the next action."""
        kind = self._kinds[self._rng.choice(len(self._kinds), p=self._chances)]
        ticks = int(self._rng.choice(_TICK_VARIABLES))
        match kind:
            case Kind.GOAL | Kind.TIP_GOAL:
                return Action(kind, aims=(self._aim(),), ticks=ticks)
            case Kind.BURST:
                count = int(self._rng.integers(2, 7))
                return Action(kind, aims=tuple(self._aim() for _ in range(count)), ticks=ticks)
            case Kind.SHAPE_GOAL:
                shape = self._rng.uniform(-1.0, 1.0, len(self._joints)) * self._setup.shapes
                return Action(kind, aims=(self._aim(),), shape=tuple(shape.tolist()), ticks=ticks)
            case Kind.UNREACHABLE:
                return Action(kind, aims=(self._aim(300.0),), ticks=ticks)
            case Kind.BAD_GOAL:
                return Action(kind, aims=(self._aim(),), text=self._one(_BAD[kind]), ticks=ticks)
            case Kind.BAD_SHAPE | Kind.BAD_TWIST | Kind.BAD_FAULT:
                return Action(kind, text=self._one(_BAD[kind]), ticks=ticks)
            case Kind.TWIST:
                v, w = self._rng.uniform(-0.1, 0.1, (2, 3)).round(6).tolist()
                return Action(kind, aims=(Aim(tuple(v), tuple(w)),), ticks=ticks)
            case Kind.DETUMBLE:
                return Action(kind, CONTROLLER, ticks=ticks)
            case Kind.ABORT | Kind.DEACTIVATE | Kind.RECONFIGURE | Kind.ACTIVATE:
                return Action(kind, self._one((PLANT, *self._setup.commanders)), ticks=ticks)
            case Kind.FAULT:
                return Action(kind, text=self._fault(), ticks=ticks)
            case _:
                return Action(kind, ticks=ticks)

    def _one(self, words: tuple[str, ...]) -> str:
        return str(words[self._rng.integers(len(words))])

    def _aim(self, far: float = 1.0) -> Aim:
        setup, rng = self._setup, self._rng
        offset = far * rng.uniform(-1.0, 1.0, 3) * setup.reach
        turn = rng.uniform(-1.0, 1.0, 3) * setup.turn
        if far > 1.0 and not any(setup.reach):
            turn = rng.uniform(0.5, 1.0, 3)
        return Aim(tuple(np.round(offset, 6).tolist()), tuple(np.round(turn, 6).tolist()))

    def _fault(self) -> str:
        setup, rng = self._setup, self._rng
        joint = self._one(tuple(self._joints))
        lines = [
            f"joint_stuck {joint}",
            f"joint_slow {joint} {rng.uniform(0.0, 1.0):.3g}",
            f"actuator_noise {joint} {rng.uniform(0.0, 0.01):.3g}",
            f"actuator_bias {joint} {rng.uniform(-0.01, 0.01):.3g}",
            f"sensor_noise position {rng.uniform(0.0, 1e-4):.3g}",
            f"sensor_noise joints {rng.uniform(0.0, 1e-5):.3g}",
            f"sensor_bias attitude_x {rng.uniform(-0.01, 0.01):.3g}",
            "sensor_dropout odom",
            f"sensor_delay odom {rng.uniform(0.0, 0.3):.3g}",
        ]
        if not setup.servos:
            lines += [
                "thruster_off all",
                f"thruster_weak all {rng.uniform(0.0, 1.0):.3g}",
                f"thruster_stuck force_x {rng.uniform(-5.0, 5.0):.3g}",
                f"thruster_stuck torque_z {rng.uniform(-1.0, 1.0):.3g}",
            ]
        if setup.nozzles:
            nozzle = self._one(setup.nozzles)
            lines += [f"nozzle_{kind} {nozzle}" for kind in ("open", "closed")]
            lines += [f"nozzle_weak {nozzle} 0.4"]
        times = ["", " until NOW+2", " at NOW+1 until NOW+3", " at NOW+0.5"]
        return self._one(tuple(lines)) + self._one(tuple(times))
