"""Learning environments with the interface of Gymnasium, one robot each or thousands in SIMD lanes.

Importing this package registers ``spacerobot/ReorientArm-v0`` and ``spacerobot/Reach-v0`` where
Gymnasium is installed. Tasks and actions (:mod:`.tasks`) need no Gymnasium: a trained policy flies
without it.
"""

from importlib.util import find_spec

from spacerobot_ros.environments.registration import register

if find_spec("gymnasium") is not None:
    register()

__all__ = ["register"]
