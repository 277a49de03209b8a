"""What an operator may do to a stack at any time, and how that is drawn."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import numpy as np
from support.random_actions.setups import CONTROLLER, PLANNER, Setup

PLANT = "plant"


class Kind(str, Enum):
    """What is done."""

    GOAL = "goal"
    BURST = "burst of goals"
    SHAPE_GOAL = "goal with a shape"
    UNREACHABLE = "unreachable goal"
    BAD_GOAL = "goal that is none"
    BAD_SHAPE = "shape that is none"
    TIP_GOAL = "goal of the end-effector"
    TWIST = "twist of the end-effector"
    BAD_TWIST = "twist that is none"
    DETUMBLE = "detumble"
    ABORT = "abort"
    REARM = "rearm"
    PAUSE = "pause"
    RESUME = "resume"
    RESET = "reset"
    DEACTIVATE = "deactivate"
    ACTIVATE = "activate"
    RECONFIGURE = "cleanup and configure"
    FAULT = "fault"
    BAD_FAULT = "fault that is none"
    CLEAR = "clear faults"
    WAIT = "wait"


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
        words = [self.kind.value, self.node, self.text]
        words += [f"{aim.offset} {aim.turn}" for aim in self.aims]
        words += [str(self.shape)] if self.shape else []
        return f"{' '.join(word for word in words if word)}; {self.ticks} ticks"


_WEIGHTS: dict[Kind, float] = {
    Kind.GOAL: 6.0,
    Kind.BURST: 2.0,
    Kind.SHAPE_GOAL: 2.0,
    Kind.UNREACHABLE: 2.0,
    Kind.BAD_GOAL: 1.0,
    Kind.BAD_SHAPE: 0.5,
    Kind.TIP_GOAL: 3.0,
    Kind.TWIST: 3.0,
    Kind.BAD_TWIST: 1.0,
    Kind.DETUMBLE: 1.5,
    Kind.ABORT: 4.0,
    Kind.REARM: 3.0,
    Kind.PAUSE: 1.5,
    Kind.RESUME: 2.5,
    Kind.RESET: 1.0,
    Kind.DEACTIVATE: 1.5,
    Kind.ACTIVATE: 3.0,
    Kind.RECONFIGURE: 1.0,
    Kind.FAULT: 3.0,
    Kind.BAD_FAULT: 0.7,
    Kind.CLEAR: 2.0,
    Kind.WAIT: 3.0,
}

_TICK_VARIABLES = (0, 0, 1, 2, 5, 20, 60, 200)

_BAD_FAULTS = (
    "joint_stuck nobody",
    "joint_slow",
    "sensor_noise position 1e200",
    "sensor_bias position_x 1e308",
    "sensor_delay odom 1e9",
    "meteor base",
    "sensor_dropout odom at 1e308 until 1",
    "\x00",
    "sensor_noise position nan",
)

_BAD_GOALS = ("frame", "quaternion", "nan", "infinite")
_BAD_SHAPES = ("unknown", "short", "nan", "twice")
_BAD_TWISTS = ("1e308", "-1e155", "1e7", "nan", "inf")


class Draw:
    """Draws actions for a setup.

    Parameters
    ----------
    setup
        What they are for.
    rng
        Where randomness comes from.
    """

    def __init__(self, setup: Setup, rng: np.random.Generator) -> None:
        self._setup, self._rng = setup, rng
        self._joints = setup.model.joint_names
        unused = set()
        if not setup.shapes:
            unused |= {Kind.SHAPE_GOAL}
        if not setup.planner:
            unused |= {Kind.BAD_SHAPE}
        if not setup.tip:
            unused |= {Kind.TIP_GOAL}
        if not setup.twists:
            unused |= {Kind.TWIST, Kind.BAD_TWIST}
        if not setup.controller or not setup.tip:
            unused |= {Kind.DETUMBLE}
        kinds = [kind for kind in _WEIGHTS if kind not in unused]
        weights = np.array([_WEIGHTS[kind] for kind in kinds])
        self._kinds, self._chances = kinds, weights / weights.sum()

    def action(self) -> Action:
        """Return the next action."""
        kind = self._kinds[self._rng.choice(len(self._kinds), p=self._chances)]
        ticks = int(self._rng.choice(_TICK_VARIABLES))
        nodes = (PLANT, *self._setup.commanders)
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
                return Action(kind, aims=(self._aim(),), text=self._one(_BAD_GOALS), ticks=ticks)
            case Kind.BAD_SHAPE:
                return Action(kind, text=self._one(_BAD_SHAPES), ticks=ticks)
            case Kind.TWIST:
                v, w = self._rng.uniform(-0.1, 0.1, (2, 3)).round(6).tolist()
                return Action(kind, aims=(Aim(tuple(v), tuple(w)),), ticks=ticks)
            case Kind.DETUMBLE:
                return Action(kind, CONTROLLER, ticks=ticks)
            case Kind.BAD_TWIST:
                return Action(kind, text=self._one(_BAD_TWISTS), ticks=ticks)
            case Kind.ABORT:
                return Action(kind, self._one(nodes), ticks=ticks)
            case Kind.DEACTIVATE | Kind.RECONFIGURE:
                return Action(kind, self._one(nodes), ticks=ticks)
            case Kind.ACTIVATE:
                return Action(kind, self._one(nodes), ticks=ticks)
            case Kind.FAULT:
                return Action(kind, text=self._fault(), ticks=ticks)
            case Kind.BAD_FAULT:
                return Action(kind, text=self._one(_BAD_FAULTS), ticks=ticks)
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


__all__ = ["CONTROLLER", "PLANNER", "PLANT", "Action", "Aim", "Draw", "Kind"]
