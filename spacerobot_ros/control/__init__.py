"""Control laws, from state and reference to thruster wrench and joint efforts."""

from typing import TYPE_CHECKING

from spacerobot_ros.control.laws.law import ControlLaw, GainPair, Gains, LawOptions, LawStatus
from spacerobot_ros.control.limits import ActuatorLimits, MotionLimits, Saturated
from spacerobot_ros.control.outputs import OutputSelection, default_selection
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
from spacerobot_ros.model.description import plane_normal
from spacerobot_ros.resources import lazy_names

if TYPE_CHECKING:
    from spacerobot_ros.control.laws.registry import LAWS

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

# Laws of other packages import names from here.
__getattr__ = lazy_names(__name__, {"control.laws.registry": ["LAWS"]})
