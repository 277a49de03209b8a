"""State and reference to thruster wrench and joint efforts: one module a law, one common base."""

from spacerobot_ros.control.errors import NotFiniteError, TargetNotSetError
from spacerobot_ros.control.estimator import DeadReckoning
from spacerobot_ros.control.gains import GainPair, Gains
from spacerobot_ros.control.laws.law import ControlLaw, LawStatus
from spacerobot_ros.control.laws.registry import LAWS
from spacerobot_ros.control.reference import (
    PROFILES,
    MotionLimits,
    QuinticReference,
    ReferenceProfile,
    StepReference,
)
from spacerobot_ros.control.saturation import ActuatorLimits, Saturated
from spacerobot_ros.control.selection import OutputSelection, default_selection, plane_normal
from spacerobot_ros.control.state import (
    Actuation,
    ControlState,
    JointReference,
    PoseReference,
    Reference,
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
