"""The laws by name: a new one is one file and one line here."""

from spacerobot_ros.control.computed_torque import ComputedTorqueLaw
from spacerobot_ros.control.law import ControlLaw
from spacerobot_ros.control.model_based import ModelBasedLaw
from spacerobot_ros.control.transposed_jacobian import TransposedJacobianLaw

LAWS: dict[str, type[ControlLaw]] = {
    TransposedJacobianLaw.name: TransposedJacobianLaw,
    ModelBasedLaw.name: ModelBasedLaw,
    ComputedTorqueLaw.name: ComputedTorqueLaw,
}
