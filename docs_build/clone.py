"""The generated references as files of the repository, for readers without the site.

``make reference`` writes ``reference/``; a test compares the files with the code.
"""

from __future__ import annotations

from docs_build.hooks import prepared
from docs_build.reference import DOCS

FOLDER = DOCS.parent / "reference"


def references() -> dict[str, str]:
    """Return the pages of parameters, topics and commands by file name."""
    pages = (DOCS / "reference" / f"{name}.md" for name in ("parameters", "topics", "cli"))
    return {
        page.name: prepared(page.read_text("utf-8")).replace("](../", "](../docs/")
        for page in pages
    }


def main() -> None:
    """Write the references."""
    for name, text in references().items():
        (FOLDER / name).write_text(text, "utf-8")
        print(FOLDER / name)


if __name__ == "__main__":
    main()
