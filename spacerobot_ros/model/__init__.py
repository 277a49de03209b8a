"""Derives the equations of a robot from its description (URDF): kinematics, momentum, connection,
dynamics."""

from spacerobot_ros.model.description import RobotDescription
from spacerobot_ros.model.inertial_parameters import InertialParameters
from spacerobot_ros.model.space_robot import SpaceRobot
from spacerobot_ros.model.urdf import load_robot, parse_robot

__all__ = ["InertialParameters", "RobotDescription", "SpaceRobot", "load_robot", "parse_robot"]
