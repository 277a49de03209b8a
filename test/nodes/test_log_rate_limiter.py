"""Lines about goals in the log: a burst, then one a second, the last one never lost."""

from __future__ import annotations

from spacerobot_ros.nodes.common.commander import Line, LogRateLimiter


def test_goals_at_100_hz_write_a_line_a_second() -> None:
    limit, written = LogRateLimiter(), []
    for i in range(700):
        now = 50.0 + 0.01 * i
        for words in ("received", "measuring"):
            line = limit.offer(now, Line("info", f"{i} {words}"))
            if line is not None:
                written.append((now, line.message))
    assert [message for _, message in written[:20]] == [
        f"{i} {words}" for i in range(10) for words in ("received", "measuring")
    ]
    assert [round(now) for now, _ in written[20:]] == [51, 52, 53, 54, 55, 56]
    # Two lines of each goal, from the eleventh on.
    assert written[20][1].endswith(" line(s) about goals left out.)")
    assert written[21][1].endswith("(199 line(s) about goals left out.)")
    last = limit.due(58.0)
    assert last == Line("info", f"699 measuring ({_count(written)} line(s) about goals left out.)")
    assert limit.due(100.0) is None


def _count(written: list[tuple[float, str]]) -> int:
    told = sum(int(text.split("(")[1].split()[0]) for _, text in written[20:])
    return 1400 - len(written) - told - 1


def test_a_line_passes_at_once_after_a_quiet_time() -> None:
    limit = LogRateLimiter()
    assert limit.due(3.0) is None
    lines = [Line("warning", f"{i}") for i in range(23)]
    assert [limit.offer(3.0, line) for line in lines[:20]] == lines[:20]
    assert limit.offer(3.25, lines[20]) is None
    assert limit.due(3.75) is None
    assert limit.due(4.0) == lines[20]
    # No more than the burst is saved up.
    assert [limit.offer(1000.0, line) for line in lines[:21]] == [*lines[:20], None]
    assert limit.offer(1000.5, lines[21]) is None
    assert limit.due(1001.0) == Line("warning", "21 (1 line(s) about goals left out.)")
