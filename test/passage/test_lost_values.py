"""Every option, every parameter of a node and every column has a test that misses it."""

from __future__ import annotations

import pytest
from support.lost_values import TESTS, losses, notices, table


def test_everything_that_can_be_lost_has_a_test_that_exists() -> None:
    lost, held = set(losses()), set(table())
    assert held == lost, f"{len(held & lost)} of {len(lost)} values have a test"
    for loss, test in table().items():
        file, _, name = test.partition("::")
        assert f"def {name.partition('[')[0]}(" in (TESTS / file).read_text("utf-8"), loss


@pytest.mark.slow
@pytest.mark.parametrize("loss", sorted(table()))
def test_what_is_lost_is_missed(loss: str) -> None:
    assert notices(table()[loss], loss)
