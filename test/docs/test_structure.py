"""The counts of the package's structure, on a package small enough to count by hand."""

from __future__ import annotations

from pathlib import Path

from docs_build.structure import structure


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
    }
