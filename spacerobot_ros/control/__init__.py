"""Control laws, from state and reference to thruster wrench and joint efforts."""

from typing import TYPE_CHECKING

from spacerobot_ros.lazy import lazy_names

if TYPE_CHECKING:
    from spacerobot_ros.control.laws.law import ControlLaw, GainPair, Gains, LawOptions, LawStatus
    from spacerobot_ros.control.laws.registry import LAWS
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

# A plant needs thrusters, and few plants a law.
__getattr__ = lazy_names(
    __name__,
    {
        "ControlLaw": "spacerobot_ros.control.laws.law",
        "GainPair": "spacerobot_ros.control.laws.law",
        "Gains": "spacerobot_ros.control.laws.law",
        "LawOptions": "spacerobot_ros.control.laws.law",
        "LawStatus": "spacerobot_ros.control.laws.law",
        "LAWS": "spacerobot_ros.control.laws.registry",
        "ActuatorLimits": "spacerobot_ros.control.limits",
        "MotionLimits": "spacerobot_ros.control.limits",
        "Saturated": "spacerobot_ros.control.limits",
        "OutputSelection": "spacerobot_ros.control.outputs",
        "default_selection": "spacerobot_ros.control.outputs",
        "plane_normal": "spacerobot_ros.model.description",
        "PROFILES": "spacerobot_ros.control.reference",
        "QuinticReference": "spacerobot_ros.control.reference",
        "ReferenceProfile": "spacerobot_ros.control.reference",
        "StepReference": "spacerobot_ros.control.reference",
        "Actuation": "spacerobot_ros.control.state",
        "ControlState": "spacerobot_ros.control.state",
        "DeadReckoning": "spacerobot_ros.control.state",
        "JointReference": "spacerobot_ros.control.state",
        "NotFiniteError": "spacerobot_ros.control.state",
        "PoseReference": "spacerobot_ros.control.state",
        "Reference": "spacerobot_ros.control.state",
        "TargetNotSetError": "spacerobot_ros.control.state",
    },
)
