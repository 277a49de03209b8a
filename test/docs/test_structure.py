"""The counts of the package's structure, on a package small enough to count by hand."""

from __future__ import annotations

from pathlib import Path

from docs_build.hooks import prepared
from docs_build.structure import DRAWING, PACKAGE, ROOT, sample, structure, words


def test_lines_and_imports_are_counted(tmp_path: Path) -> None:
    package = tmp_path / "spacerobot_ros"
    (package / "inner").mkdir(parents=True)
    (package / "__init__.py").write_text('"""A package."""\n')
    (package / "inner" / "__init__.py").write_text("from spacerobot_ros.inner.b import f\n")
    (package / "a.py").write_text(
        '"""Two lines of code."""\n\nfrom spacerobot_ros.inner import b  # a module\n\nx = b.f\n'
    )
    (package / "inner" / "b.py").write_text('def f() -> None:\n    """One more line."""\n')
    (package / "inner" / "c.py").write_text("import spacerobot_ros.a\n")
    assert structure(tmp_path) == {
        "lines": 10,
        "lines of code": 5,
        "files": 5,
        "modules": 3,
        "modules imported once": 1,
        **dict.fromkeys(DRAWING, 0),
    }


def test_what_draws_a_robot_is_counted_in_modules_that_are_there(tmp_path: Path) -> None:
    files = [ROOT / PACKAGE / name for names in DRAWING.values() for name in names]
    assert all(file.is_file() for file in files)
    for file in files:
        copy = tmp_path / PACKAGE / file.relative_to(ROOT / PACKAGE)
        copy.parent.mkdir(parents=True, exist_ok=True)
        copy.write_text("x = 1\n" * 3)
    counts = structure(tmp_path)
    assert [counts[what] for what in DRAWING] == [3, 3, 6]
    assert prepared("{{ lines report/solids.py model/visuals.py }}") == str(
        sum(file.read_bytes().count(b"\n") for file in (files[0], files[-1]))
    )


def _checkout(tmp_path: Path) -> Path:
    (tmp_path / PACKAGE).mkdir()
    (tmp_path / "docs").mkdir()
    (tmp_path / PACKAGE / "a.py").write_text(
        '"""What flies."""\n\nLIMIT = 2.0\n"""What is allowed, m."""\n\n\n'
        "class Arm:\n    # The planner says what the base does next.\n    mass_kg: float\n\n"
        "    def reach(self, r_WE: float) -> bool:\n"
        '        """Whatever it reaches."""\n'
        '        raise ValueError(f"The hand is at {r_WE} m, which is too far.")\n'
    )
    (tmp_path / "README.md").write_text("It shows what a robot does, and what it weighs at rest.\n")
    (tmp_path / "docs" / "page.md").write_text("# Head\n\nNobody says whatsoever about it here.\n")
    return tmp_path


def test_clauses_with_what_are_counted(tmp_path: Path) -> None:
    assert words(_checkout(tmp_path)) == {
        '"What ..." docstrings': 2,
        '"what is ..." in code': 2,
        '"what is ..." in pages': 2,
    }


def test_a_sample_has_names_with_signatures_and_texts(tmp_path: Path) -> None:
    checkout = _checkout(tmp_path)
    drawn = sample(checkout, seed=3, names=4, texts=4)
    for line in (
        "names, seed 3",
        "a.py: class Arm",
        "a.py: Arm.mass_kg: float",
        "a.py: def reach(self, r_WE: float) -> bool",
        "a.py: LIMIT = 2.0",
        "texts, seed 3",
        "a.py: The planner says what the base does next.",
        "README.md: It shows what a robot does, and what it weighs at rest.",
        "page.md: Nobody says whatsoever about it here.",
    ):
        assert line in drawn, line
    assert "too far" in drawn
    third, fourth = (sample(checkout, seed, 2, 2) for seed in (3, 4))
    assert third == sample(checkout, 3, 2, 2)
    assert third.replace("seed 3", "") != fourth.replace("seed 4", "")
