"""The phases of a planner's executive, and the table of the transitions between them."""

from __future__ import annotations

from enum import Enum
from typing import NamedTuple


class Phase(Enum):
    """What an executive is doing."""

    IDLE = "idle"
    """There is no goal; the joints rest."""

    MEASURING = "measuring"
    """A new goal waits for measured states to plan from; the joints rest."""

    PLANNING = "planning"
    """A plan is being made."""

    EXECUTING = "executing"
    """A schedule is tracked."""

    REPLANNING = "replanning"
    """A schedule is tracked, and a plan is made that takes over from it in motion."""

    TAKING_OVER = "taking over"
    """A schedule is tracked until the tick at which the plan that is there takes over."""

    BRAKING = "braking"
    """The joints brake along the planned path."""

    EVALUATING = "evaluating"
    """A schedule has ended; measured states are compared with the goal. The joints rest."""


class Event(Enum):
    """Why the phase of an executive changes."""

    NEW_GOAL = "new goal"
    """There is a new goal to plan for."""

    PLAN_REQUESTED = "plan requested"
    """The measured state is known, and a plan from it is requested (:class:`PlanReason`)."""

    PLANNED = "planned"
    """The plan is there."""

    REFUSED = "refused"
    """There is no plan, for a reason."""

    PLAN_LATE = "plan late"
    """The tick at which a plan was to take over has come, and the plan is not there."""

    TAKEN_OVER = "taken over"
    """The tick has come at which a plan takes over."""

    SCHEDULE_ENDED = "schedule ended"
    """The schedule that was tracked is over."""

    AT_REST = "at rest"
    """The braking is over."""

    TRACKING_ERROR = "tracking error"
    """The base is off its predicted path, and plans are made from rest."""

    JOINTS_STUCK = "joints stuck"
    """Joints do not follow."""

    TIME_JUMPED = "time jumped"
    """The time of the states is another one, at which nothing is planned."""

    REACHED = "reached"
    """The goal is reached within tolerance."""

    FAILED = "failed"
    """The goal is not reached, and no correction is left or the measured state is not finite."""

    ABORTED = "aborted"
    """The goal is given up on request."""

    PLANT_STOPPED = "plant stopped"
    """The plant has stopped obeying commands: the goal is given up at once."""

    PLANT_RESET = "plant reset"
    """The plant is in another state than before: nothing is planned from there."""

    DEACTIVATED = "deactivated"
    """Everything is given up at once."""


class Transition(NamedTuple):
    """A change of phase, and why."""

    source: Phase
    event: Event
    target: Phase


_TABLE: dict[tuple[Phase, Event], tuple[Phase, ...]] = {
    (Phase.IDLE, Event.NEW_GOAL): (Phase.MEASURING,),
    (Phase.MEASURING, Event.NEW_GOAL): (Phase.MEASURING,),
    (Phase.MEASURING, Event.PLAN_REQUESTED): (Phase.PLANNING,),
    (Phase.MEASURING, Event.ABORTED): (Phase.IDLE,),
    (Phase.PLANNING, Event.PLANNED): (Phase.EXECUTING,),
    (Phase.PLANNING, Event.REFUSED): (
        *(Phase.IDLE, Phase.MEASURING, Phase.EXECUTING, Phase.BRAKING, Phase.EVALUATING),
    ),
    (Phase.PLANNING, Event.PLANT_RESET): (Phase.MEASURING, Phase.EVALUATING),
    (Phase.PLANNING, Event.ABORTED): (Phase.IDLE,),
    (Phase.EXECUTING, Event.NEW_GOAL): (Phase.BRAKING,),
    (Phase.EXECUTING, Event.PLAN_REQUESTED): (Phase.PLANNING, Phase.REPLANNING),
    (Phase.EXECUTING, Event.SCHEDULE_ENDED): (Phase.EVALUATING, Phase.MEASURING),
    (Phase.EXECUTING, Event.TRACKING_ERROR): (Phase.BRAKING,),
    (Phase.EXECUTING, Event.JOINTS_STUCK): (Phase.EVALUATING, Phase.MEASURING),
    (Phase.EXECUTING, Event.TIME_JUMPED): (Phase.EVALUATING, Phase.MEASURING),
    (Phase.EXECUTING, Event.PLANT_RESET): (Phase.EVALUATING, Phase.MEASURING),
    (Phase.EXECUTING, Event.ABORTED): (Phase.BRAKING,),
    (Phase.REPLANNING, Event.PLANNED): (Phase.TAKING_OVER,),
    (Phase.REPLANNING, Event.REFUSED): (Phase.EXECUTING,),
    (Phase.REPLANNING, Event.PLAN_LATE): (Phase.EXECUTING,),
    (Phase.REPLANNING, Event.SCHEDULE_ENDED): (Phase.EVALUATING, Phase.MEASURING),
    (Phase.TAKING_OVER, Event.TAKEN_OVER): (Phase.EXECUTING,),
    **{
        (phase, event): targets
        for phase in (Phase.REPLANNING, Phase.TAKING_OVER)
        for event, targets in (
            (Event.NEW_GOAL, (Phase.EXECUTING,)),
            (Event.JOINTS_STUCK, (Phase.EVALUATING, Phase.MEASURING)),
            (Event.TIME_JUMPED, (Phase.EVALUATING, Phase.MEASURING)),
            (Event.PLANT_RESET, (Phase.EVALUATING, Phase.MEASURING)),
            (Event.ABORTED, (Phase.BRAKING,)),
        )
    },
    (Phase.BRAKING, Event.PLAN_REQUESTED): (Phase.PLANNING,),
    (Phase.BRAKING, Event.AT_REST): (Phase.IDLE, Phase.MEASURING, Phase.EVALUATING),
    (Phase.BRAKING, Event.JOINTS_STUCK): (Phase.EVALUATING, Phase.MEASURING),
    (Phase.BRAKING, Event.TIME_JUMPED): (Phase.IDLE, Phase.MEASURING, Phase.EVALUATING),
    (Phase.BRAKING, Event.PLANT_RESET): (Phase.IDLE, Phase.MEASURING, Phase.EVALUATING),
    (Phase.BRAKING, Event.ABORTED): (Phase.BRAKING,),
    (Phase.EVALUATING, Event.NEW_GOAL): (Phase.MEASURING,),
    (Phase.EVALUATING, Event.PLAN_REQUESTED): (Phase.PLANNING,),
    (Phase.EVALUATING, Event.REACHED): (Phase.IDLE,),
    (Phase.EVALUATING, Event.FAILED): (Phase.IDLE,),
    (Phase.EVALUATING, Event.ABORTED): (Phase.IDLE,),
    **{(phase, Event.PLANT_STOPPED): (Phase.IDLE,) for phase in Phase if phase is not Phase.IDLE},
    **{(phase, Event.DEACTIVATED): (Phase.IDLE,) for phase in Phase},
}

TRANSITIONS: frozenset[Transition] = frozenset(
    Transition(source, event, target)
    for (source, event), targets in _TABLE.items()
    for target in targets
)
"""Every transition that is allowed; ``docs/planner_state_machine.md`` shows them."""


class PlanReason(Enum):
    """Why a plan was requested."""

    NEW_GOAL = "new goal"
    """A goal, from rest."""

    BLEND = "blend"
    """A goal while the joints move: they brake along the planned path first."""

    IN_MOTION = "new goal in motion"
    """A goal while the joints move: its plan takes over at a tick ahead, without a stop."""

    SHRINKING_HORIZON = "shrinking horizon"
    """The remaining motion once more, from the measured state, to take over at a tick ahead."""

    CORRECTION = "correction"
    """The schedule has ended, and the goal is not reached."""

    CONTINUATION = "continuation"
    """The schedule was partial on purpose: this is its next piece."""

    TRACKING_ERROR = "tracking error"
    """The base is off its predicted path; the joints brake along that path first."""

    REPLAN = "replan"
    """The schedule was braked: off its path, or for a new goal that was refused then."""

    STUCK_JOINTS = "stuck joints"
    """Joints do not follow; the plan is made with the others."""

    @property
    def for_new_goal(self) -> bool:
        """Whether the plan is for a goal that is not pursued yet."""
        return self in (PlanReason.NEW_GOAL, PlanReason.BLEND, PlanReason.IN_MOTION)


class IllegalTransitionError(RuntimeError):
    """A defect: a transition that the table does not allow."""


class StateMachine:
    """The present phase; every change of it is held against the table."""

    def __init__(self) -> None:
        self.phase = Phase.IDLE

    def go(self, event: Event, target: Phase) -> Transition:
        """Change the phase, and return the transition.

        Raises
        ------
        IllegalTransitionError
            The table does not allow it; the phase stays.
        """
        transition = Transition(self.phase, event, target)
        if transition not in TRANSITIONS:
            raise IllegalTransitionError(
                f"{self.phase.name} may not become {target.name} by {event.name}."
            )
        self.phase = target
        return transition
