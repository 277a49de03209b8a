"""The goals of coordinated control: given, taken up at a measured state, kept on file."""

from __future__ import annotations

from spacerobot_ros.control import ControlState, PoseReference
from spacerobot_ros.control.controller import CoordinatedController
from spacerobot_ros.control.laws.law import ControlLaw
from spacerobot_ros.errors import ParameterError, PlanningError
from spacerobot_ros.planning import Goal
from spacerobot_ros.planning.execution.goal_file import BASE, GoalFile, IdentifiedGoal

END_EFFECTOR = "end_effector"
"""What the goal of the end-effector is kept as."""

GROUPS = (BASE, END_EFFECTOR)
"""What poses are given for."""


class ControlGoals:
    """What a controller is to take up at its next state, and what it flies to, in a file.

    Kept with a goal is what else is controlled, and held meanwhile: the other pose and the shape.
    So one that starts again has all of the goal, not only what was given last.

    Parameters
    ----------
    resume_file
        The file; empty: nothing is kept.
    """

    def __init__(self, resume_file: str) -> None:
        self._memory = GoalFile(resume_file, GROUPS)
        self._given: dict[str, Goal] = {}

    def give(self, group: str, goal: Goal) -> None:
        """Have a group go to a goal from the next state on."""
        self._given[group] = goal

    def recall(self, law: ControlLaw | None) -> bool:
        """Give what an earlier controller was flying to; return whether there is such a goal.

        Without a law nobody knows yet whether it suits; see :meth:`require_suited`.

        Raises
        ------
        ParameterError
            The file holds something else, or goals of another robot or law.
        """
        self._given = {group: found.goal for group, found in self._memory.load().items()}
        if law is not None:
            try:
                self.require_suited(law)
            except PlanningError as error:
                raise ParameterError(
                    f"Parameter 'resume_file' holds goals of another robot or law: {error}"
                ) from error
        return bool(self._given)

    def require_suited(self, law: ControlLaw) -> None:
        """Drop goals that were given before the robot was known, if they are none of its own.

        Raises
        ------
        PlanningError
            They are not; the file stays.
        """
        try:
            for group, goal in self._given.items():
                require_controlled(law, group)
                if goal.joint_positions is not None and len(goal.joint_positions) != law.robot.n:
                    raise PlanningError(
                        f"A shape of {len(goal.joint_positions)} joints is no goal of robot "
                        f"'{law.robot.description.name}', which has {law.robot.n}."
                    )
        except PlanningError:
            self._given = {}
            raise

    def take(self, controller: CoordinatedController, time: float, state: ControlState) -> bool:
        """Start towards what was given, at ``time`` (s); return whether anything was."""
        if not self._given:
            return False
        given, self._given = self._given, {}
        poses = {group: PoseReference(g.position, g.quaternion) for group, g in given.items()}
        shapes = [g.joint_positions for g in given.values() if g.joint_positions is not None]
        controller.set_goals(
            time,
            state,
            base=poses.get(BASE),
            end_effector=poses.get(END_EFFECTOR),
            joints=shapes[0] if shapes else None,
        )
        return True

    def keep(self, controller: CoordinatedController) -> None:
        """Write down where a controller flies to.

        Raises
        ------
        ParameterError
            The file cannot be written.
        """
        self._memory.save(
            {group: IdentifiedGoal(goal) for group, goal in _flown_to(controller).items()}
        )

    def drop(self) -> None:
        """Drop what was not taken up yet."""
        self._given = {}

    def forget(self) -> None:
        """Keep nothing any more: the goal is met, or given up."""
        self._memory.delete()


def require_controlled(law: ControlLaw, group: str) -> None:
    """Refuse a goal for what is no output.

    Raises
    ------
    PlanningError
        The law does not control the group.
    """
    if not getattr(law.outputs.selection, group):
        raise PlanningError(
            f"The law '{law.name}' does not control the {group.replace('_', '-')} of this robot; "
            f"its outputs are {', '.join(law.outputs.labels)}."
        )


def _flown_to(controller: CoordinatedController) -> dict[str, Goal]:
    """Return by group where a controller brings all that it controls."""
    goal, selection = controller.goal, controller.law.outputs.selection
    shape = goal.joints.q if goal.joints is not None and selection.joints else None
    poses = {BASE: goal.base, END_EFFECTOR: goal.end_effector}
    return {
        group: Goal(pose.position, pose.quaternion, shape)
        for group, pose in poses.items()
        if pose is not None and getattr(selection, group)
    }
