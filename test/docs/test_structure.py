"""The counts of the package's structure, on a package small enough to count by hand."""

from __future__ import annotations

from pathlib import Path

from docs_build.hooks import prepared
from docs_build.structure import DRAWING, PACKAGE, ROOT, structure


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
    assert [counts[what] for what in DRAWING] == [3, 6, 3]
    assert prepared("{{ lines report/solids.py model/visuals.py }}") == str(
        sum(file.read_bytes().count(b"\n") for file in (files[0], files[-1]))
    )
