"""The methods by name: a new one is one file and one line here."""

from __future__ import annotations

from spacerobot_ros.planning.lie_bracket import LieBracketGait
from spacerobot_ros.planning.method import GaitMethod
from spacerobot_ros.planning.square_path import SquarePathGait

METHODS: dict[str, type[GaitMethod]] = {
    LieBracketGait.name: LieBracketGait,
    SquarePathGait.name: SquarePathGait,
}
