"""The C++ that lanes are compiled from: its declarations, sizes and options."""

from __future__ import annotations

import ctypes
import subprocess
from pathlib import Path

import pytest

from spacerobot_ros.batch import native
from spacerobot_ros.batch.native import Job, Pending, Program, RowLayout
from spacerobot_ros.model.compilation import cxx_compiler

ROWS = RowLayout({"alive": 1, "state": 7, "measured": 3})


def test_rows_follow_one_another() -> None:
    assert ROWS.total_rows == 11
    assert [ROWS[name] for name in ROWS.slices] == [slice(0, 1), slice(1, 8), slice(8, 11)]
    assert (ROWS.first_row("measured"), ROWS.first_row("state", 4), ROWS.row_count("state")) == (
        8,
        5,
        7,
    )
    assert ROWS.copy_range("state", "measured") == (1, 8, 7)


def test_a_compiler_reads_the_declarations_as_python_means_them(tmp_path: Path) -> None:
    """Numbers, enumerations and the layout of the job, printed by a C++ program."""
    compiler = cxx_compiler()
    if compiler is None:
        pytest.skip("there is no C++ compiler")
    declared = native._shared_declarations(
        ROWS,
        {"WIDTH": 26, "JOINTS": 3},
        {"ARGUMENTS": [4, 2, 9]},
        {"COPIES": [(1, 8, 3), (5, 0, 2)]},
    )
    members = [name for _, name, _ in native._JOB_MEMBERS]
    offsets = "".join(f'  std::printf("%zu\\n", offsetof(Job, {name}));\n' for name in members)
    main = tmp_path / "main.cpp"
    main.write_text(
        f"#include <cstddef>\n#include <cstdio>\ntypedef double V;\n{declared}\n"
        "int main() {\n"
        '  std::printf("%d %d\\n", WIDTH, JOINTS);\n'
        '  std::printf("%lld %lld %lld\\n", row::alive, row::state, row::measured);\n'
        '  std::printf("%d %d %d %d\\n", program::HELD, program::FOLLOWED, program::CONTROLLED,'
        " program::GIVEN);\n"
        '  std::printf("%d %d %d\\n", pending::COMMIT, pending::TICK, pending::FIRE);\n'
        '  std::printf("%d %d\\n", decision::REACHED, decision::LOST);\n'
        '  std::printf("%lld %lld\\n", ARGUMENTS[1], COPIES[1].from + COPIES[0].to);\n'
        '  std::printf("%zu %lld\\n", sizeof(ARGUMENTS) / sizeof(long long), COPIES[0].count);\n'
        f'  std::printf("%zu\\n", sizeof(Job));\n{offsets}}}\n'
    )
    program = tmp_path / "main"
    subprocess.run([compiler, str(main), "-o", str(program)], check=True, timeout=60)
    printed = subprocess.run([str(program)], check=True, capture_output=True, text=True, timeout=9)
    lines = printed.stdout.splitlines()
    assert lines[:7] == ["26 3", "0 1 8", "0 1 2 3", "1 2 3", "1 3", "2 13", "3 3"]
    assert int(lines[7]) == ctypes.sizeof(Job)
    assert [int(line) for line in lines[8:]] == [getattr(Job, name).offset for name in members]
    assert (list(Program), list(Pending)) == ([0, 1, 2, 3], [0, 1, 2, 3])
