"""Every option, every parameter of a node and every column has a test that misses it."""

from __future__ import annotations

import pytest
from support.lost_values import TESTS, losses, notices, table

NOT_HELD = {
    *(
        f"option {command} --end-effector{part}"
        for command in ("plan", "run", "goal")
        for part in ("", "-goal", "-position")
    ),
    *(f"parameter recorder.{name}" for name in ("tf_period", "flush_period", "max_duration")),
    *("parameter replay.rate", "parameter replay.duration"),
    *("parameter plant.tf_period", "parameter plant.tf_links"),
    "parameter coordinated_control.world_frame",
}
"""Of these, and of those of :data:`NOT_HELD_KINDS`, no test is known yet that misses them."""

NOT_HELD_KINDS = ("column ", "unit of column ", "parameter viewer.")
NOT_HELD_NAMES = (".stop_when_decided", ".watchdog_timeout")


def held(loss: str) -> bool:
    return not (
        loss in NOT_HELD or loss.startswith(NOT_HELD_KINDS) or loss.endswith(NOT_HELD_NAMES)
    )


def test_everything_that_can_be_lost_has_a_test_that_exists() -> None:
    assert {loss for loss in losses() if held(loss)} <= set(table()) <= set(losses())
    for loss, test in table().items():
        file, _, name = test.partition("::")
        assert f"def {name.partition('[')[0]}(" in (TESTS / file).read_text("utf-8"), loss


@pytest.mark.slow
@pytest.mark.parametrize("loss", sorted(table()))
def test_what_is_lost_is_missed(loss: str) -> None:
    assert notices(table()[loss], loss)
