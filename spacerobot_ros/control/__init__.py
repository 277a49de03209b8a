"""State and reference to thruster wrench and joint efforts: one module a law, one common base."""

from spacerobot_ros.control.laws.law import ControlLaw, GainPair, Gains, LawOptions, LawStatus
from spacerobot_ros.control.laws.registry import LAWS
from spacerobot_ros.control.limits import ActuatorLimits, MotionLimits, Saturated
from spacerobot_ros.control.outputs import OutputSelection, default_selection, plane_normal
from spacerobot_ros.control.reference import (
    PROFILES,
    QuinticReference,
    ReferenceProfile,
    StepReference,
)
from spacerobot_ros.control.state import (
    Actuation,
    ControlState,
    DeadReckoning,
    JointReference,
    NotFiniteError,
    PoseReference,
    Reference,
    TargetNotSetError,
)

__all__ = [
    "LAWS",
    "PROFILES",
    "Actuation",
    "ActuatorLimits",
    "ControlLaw",
    "ControlState",
    "DeadReckoning",
    "GainPair",
    "Gains",
    "JointReference",
    "LawOptions",
    "LawStatus",
    "MotionLimits",
    "NotFiniteError",
    "OutputSelection",
    "PoseReference",
    "QuinticReference",
    "Reference",
    "ReferenceProfile",
    "Saturated",
    "StepReference",
    "TargetNotSetError",
    "default_selection",
    "plane_normal",
]
