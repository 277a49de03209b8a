"""The laws by name: a new one is one file and one line here."""

from spacerobot_ros.control.laws.computed_torque import ComputedTorqueLaw
from spacerobot_ros.control.laws.law import ControlLaw
from spacerobot_ros.control.laws.model_based import ModelBasedLaw
from spacerobot_ros.control.laws.transposed_jacobian import TransposedJacobianLaw

LAWS: dict[str, type[ControlLaw]] = {
    TransposedJacobianLaw.name: TransposedJacobianLaw,
    ModelBasedLaw.name: ModelBasedLaw,
    ComputedTorqueLaw.name: ComputedTorqueLaw,
}
