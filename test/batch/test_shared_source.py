"""The C++ that lanes are compiled from: its declarations, sizes and options."""

from __future__ import annotations

import ctypes
import subprocess
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import casadi as ca
import pytest

from spacerobot_ros.batch import native
from spacerobot_ros.batch.native import Job, Pending, Program, RowLayout, VectorUnit
from spacerobot_ros.model.compilation import NoLibraryError, cxx_compiler

ROWS = RowLayout({"alive": 1, "state": 7, "measured": 3})

UNIT = VectorUnit("pairs", 2, ("-mpairs",), "b")


def small_function() -> ca.Function:
    x, y = ca.SX.sym("x", 2), ca.SX.sym("y", 3)
    return ca.Function("small", [x, y], [ca.sin(x) * y[:2], ca.sum1(y)], ["x", "y"], ["a", "b"])


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


def test_sizes_are_those_of_the_largest_function() -> None:
    function = small_function()
    larger = ca.Function("larger", [ca.SX.sym("z", 9)], [ca.SX(1)])
    lines = native._define_sizes([function, larger], UNIT, "", 5).splitlines()
    assert lines[:2] == ["#define THRUSTERS 5", "#define LANES 2"]
    assert lines[2] == f"#define WORK_SIZE {max(function.sz_w(), larger.sz_w()) + 1}"
    assert lines[3] == f"#define ARGUMENT_POINTERS {function.sz_arg() + 1}"
    assert lines[4] == f"#define RESULT_POINTERS {function.sz_res() + 1}"
    assert lines[5:] == [f"#define INTEGER_SIZE {function.sz_iw() + 1}"]
    with_sine = native._define_sizes([function], UNIT, "b", 0).splitlines()
    assert with_sine[6:] == [
        "#define LIBMVEC",
        "#define VECTOR_SIN _ZGVbN2v_sin",
        "#define VECTOR_COS _ZGVbN2v_cos",
    ]


def test_the_sine_of_the_c_library_is_used_where_it_can_be(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    asked: list[Any] = []

    def library(
        name: str, source: str, load: Any, *, flags: Any, libraries: Any = (), language: str
    ) -> Any:
        assert (load, language) == (ctypes.CDLL, "cpp")
        asked.append((name, "#define LIBMVEC" in source, libraries, flags))
        if libraries and "-mbroken" in flags:
            raise NoLibraryError("no such library")
        made = SimpleNamespace()
        for each in ("start_flights", "fly_until", "measure_starts", "end_flights"):
            setattr(made, each, SimpleNamespace())
        return made

    monkeypatch.setattr(native, "load_library", library)
    functions = {"FLIGHT": small_function()}
    broken = VectorUnit("pairs", 2, ("-mbroken",), "b")
    plain = VectorUnit("pairs", 2, (), "")
    for unit, tried in ((UNIT, [True]), (broken, [True, False]), (plain, [False])):
        asked.clear()
        native._load_library(functions, "", unit, 0)
        assert [each[1] for each in asked] == tried
        assert [each[2] for each in asked] == [("-lmvec",) if each else () for each in tried]
        assert all(each[0] == "lanes_small" and each[3][-1:] != ("-lmvec",) for each in asked)
        assert asked[0][3][:2] == ("-O2", "-std=c++17")
    made = native._load_library(functions, "", plain, 0)
    assert made.start_flights.argtypes == [ctypes.POINTER(Job)]
    assert made.start_flights.restype is None
    assert made.fly_until.argtypes == [ctypes.POINTER(Job), ctypes.c_longlong]
    assert made.fly_until.restype is ctypes.c_longlong
    assert not hasattr(made.end_flights, "argtypes")
    made = native._load_library({**functions, "CONTROL": small_function()}, "", plain, 0)
    assert made.measure_starts.argtypes == made.end_flights.argtypes == [ctypes.POINTER(Job)]


def test_a_number_that_may_be_zero_is_chosen_by_a_function_for_vectors() -> None:
    text = native._CASADI_SELECTION.sub(r"where(\1,\2)", "a0=(a1?a2:0);")
    assert text == "a0=where(a1,a2);"


def test_registers_of_64_bits_by_the_options_of_compilers(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A register of 512 bits has eight numbers; the options are those that GCC knows."""
    bits = {"avx512f": 512, "avx2": 256, "sse2": 128}
    assert {flag: 64 * unit.lanes for flag, unit in native.VECTOR_UNITS.items()} == bits
    assert [unit.flags[0] for unit in native.VECTOR_UNITS.values()] == [
        f"-m{flag}" for flag in bits
    ]
    assert [unit.libmvec for unit in native.VECTOR_UNITS.values()] == ["e", "d", "b"]
    assert (native._PORTABLE_UNIT.lanes, native._PORTABLE_UNIT.libmvec) == (2, "")

    def refuse(*_: Any, **__: Any) -> str:
        raise OSError("no such file")

    monkeypatch.setattr(Path, "read_text", refuse)
    native.vector_unit.cache_clear()
    assert native.vector_unit() is native._PORTABLE_UNIT
    monkeypatch.setattr(Path, "read_text", lambda *_, **__: "no processor\n")
    native.vector_unit.cache_clear()
    assert native.vector_unit() is native._PORTABLE_UNIT
    monkeypatch.undo()
    native.vector_unit.cache_clear()
