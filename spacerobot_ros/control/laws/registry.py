"""Laws by name; a new law needs one file and one line here."""

from spacerobot_ros.control.laws.computed_torque import ComputedTorqueLaw
from spacerobot_ros.control.laws.law import ControlLaw
from spacerobot_ros.control.laws.model_based import ModelBasedLaw
from spacerobot_ros.control.laws.transposed_jacobian import TransposedJacobianLaw
from spacerobot_ros.registry import Registry

LAWS: Registry[ControlLaw] = Registry(
    "control law",
    "spacerobot_ros.control_laws",
    ControlLaw,
    (TransposedJacobianLaw, ModelBasedLaw, ComputedTorqueLaw),
)
LAWS.load()
