"""Schedules for the trajectory server of a robot: sent, replaced, cancelled, and their ends."""

from __future__ import annotations

from typing import Any

import pytest
from commanding.commanders import TrajectoryServer

from spacerobot_ros.commanding.planner import Outcome, TrajectoryOutput
from spacerobot_ros.planning.execution.status import Phase
from spacerobot_ros.times import SECOND

FIRST = 40 * SECOND
"""Stamp of the first state."""


class Sent:
    """An output with its server and the ends that it has told."""

    def __init__(self) -> None:
        self.server, self.ends = TrajectoryServer(), list[tuple[str, bool]]()
        self.output = TrajectoryOutput(
            self.server, "/arm/follow", lambda why, final: self.ends.append((why, final))
        )

    def start(self, schedule: Any = "schedule", *, accepted: bool = True) -> int:
        self.output.start(schedule)
        number = self.server.sent[-1][0]
        if accepted:
            self.output.accepted(number)
        return number


def test_a_schedule_is_sent_and_ends_with_its_result() -> None:
    sent = Sent()
    number = sent.start("first")
    assert sent.server.sent == [(number, "first")]
    sent.output.on_phase_change(Phase.EXECUTING)
    sent.output.ended(number, Outcome.SUCCEEDED, 0, "")
    assert sent.ends == [("", False)]
    # Each schedule ends once, and nothing that has ended is cancelled.
    sent.output.ended(number, Outcome.ABORTED, -4, "")
    sent.output.rejected(number)
    sent.output.on_phase_change(Phase.EVALUATING)
    assert len(sent.ends) == 1
    assert sent.server.cancelled == []


@pytest.mark.parametrize(
    ("outcome", "code", "text", "message", "final"),
    [
        (Outcome.ABORTED, -4, "wrist off.", "the trajectory ended early with "
         "PATH_TOLERANCE_VIOLATED: wrist off", False),
        (Outcome.ABORTED, -5, "", "the trajectory ended early with GOAL_TOLERANCE_VIOLATED",
         False),
        (Outcome.ABORTED, -1, "", "the trajectory ended early with INVALID_GOAL", True),
        (Outcome.ABORTED, -2, "no wrist", "the trajectory ended early with INVALID_JOINTS: "
         "no wrist", True),
        (Outcome.ABORTED, -3, "", "the trajectory ended early with OLD_HEADER_TIMESTAMP", True),
        (Outcome.ABORTED, 0, "", "the trajectory was aborted without an error code", True),
        (Outcome.ABORTED, 17, "", "the trajectory ended early with error code 17", True),
        (Outcome.CANCELED, -4, "new goal", "another client has replaced or cancelled the "
         "trajectory: new goal", True),
        (Outcome.SUCCEEDED, -5, "", "the trajectory ended early with GOAL_TOLERANCE_VIOLATED",
         False),
    ],
)  # fmt: skip
def test_results_are_corrected_or_final(
    outcome: Outcome, code: int, text: str, message: str, final: bool
) -> None:
    sent = Sent()
    sent.output.ended(sent.start(), outcome, code, text)
    assert sent.ends == [(message, final)]


def test_what_is_left_is_cancelled_and_its_result_does_not_count() -> None:
    for phase in Phase:
        sent = Sent()
        number = sent.start()
        sent.output.on_phase_change(phase)
        goes_on = phase in (
            Phase.EXECUTING, Phase.PLANNING, Phase.REPLANNING, Phase.TAKING_OVER
        )  # fmt: skip
        assert sent.server.cancelled == ([] if goes_on else [number])
        sent.output.ended(number, Outcome.CANCELED, 0, "")
        assert len(sent.ends) == (1 if goes_on else 0)


def test_a_schedule_replaces_another() -> None:
    sent = Sent()
    first, second = sent.start("first"), sent.start("second", accepted=False)
    assert first != second
    sent.output.accepted(first)  # Too late, and of no meaning
    sent.output.ended(first, Outcome.CANCELED, -1, "preempted")
    assert sent.ends == []
    sent.output.accepted(second)
    assert sent.server.cancelled == []
    third = sent.start("third", accepted=False)
    sent.output.rejected(second)
    assert sent.ends == []
    sent.output.rejected(third)
    # The robot must not follow the second one on.
    assert sent.server.cancelled == [second]
    assert sent.ends == [("the action '/arm/follow' has rejected the trajectory", True)]


def test_a_server_that_is_not_there_or_does_not_answer_ends_the_goal() -> None:
    sent = Sent()
    sent.server.present = False
    lost: Any = "lost"
    sent.output.start(lost)
    assert sent.server.sent == []
    assert sent.ends.pop() == ("the action '/arm/follow' has no server", True)
    sent.server.present = True
    number = sent.start(accepted=False)
    for second in range(6):
        assert not sent.ends
        sent.output.check_server(FIRST + second * SECOND)
    sent.output.check_server(FIRST + 5 * SECOND + 1)
    assert sent.ends == [("the action '/arm/follow' has not responded", True)]
    assert sent.server.cancelled == [number]
    # One that was accepted may take any time; a schedule that is left ends nothing.
    later = sent.start()
    for second in range(20):
        sent.output.check_server(FIRST + second * SECOND)
    sent.output.on_phase_change(Phase.EVALUATING)
    reset = sent.start(accepted=False)
    sent.output.on_phase_change(Phase.EVALUATING)
    sent.output.check_server(FIRST + 60 * SECOND)
    assert len(sent.ends) == 1
    assert sent.server.cancelled == [number, later, reset]


def test_the_time_for_an_answer_begins_with_the_state_after_the_schedule() -> None:
    sent = Sent()
    sent.start()
    sent.output.check_server(FIRST)
    # Planning took ten seconds, and time may jump back.
    sent.start(accepted=False)
    sent.output.check_server(FIRST + 15 * SECOND)
    sent.output.check_server(FIRST)
    sent.output.check_server(FIRST + 5 * SECOND)
    assert sent.ends == []
    sent.output.check_server(FIRST + 5 * SECOND + 1)
    assert len(sent.ends) == 1


def test_a_server_that_goes_ends_the_goal_within_a_second() -> None:
    sent = Sent()
    number = sent.start()
    sent.output.check_server(FIRST)
    sent.server.present = False
    sent.output.check_server(FIRST + SECOND - 1)
    assert sent.ends == []
    sent.output.check_server(FIRST + SECOND)
    wanted = ("the server of the action '/arm/follow' is gone", True)
    assert sent.ends == [wanted]
    # It may still drive the joints, and only this planner not see it.
    assert sent.server.cancelled == [number]
    sent.output.check_server(FIRST + 2 * SECOND)
    assert sent.ends == [wanted]


def test_texts_of_the_server_are_one_line_without_control_characters() -> None:
    sent = Sent()
    sent.output.ended(sent.start(), Outcome.ABORTED, -6, "stop\n\x1b[31mred")
    ((why, _),) = sent.ends
    assert why == "the trajectory ended early with error code -6: stop \ufffd[31mred"
