"""Fenced blocks of a page: what a reader is to run, the files that it needs, and diagrams.

The line that opens a block may say, after its language,

``run``
    The tests run it, in a folder of the page's own, after the blocks above it.
``slow``
    Only `make test-slow` runs it, with all others of the page.
``exit=N``
    Its last command ends with exit code N; without it every command ends with 0.
``file=NAME``
    The tests write it into the folder: a file that commands below it use.

Language and marks are separated by spaces: ```` ```sh run exit=2 ````.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass

_OPENING = re.compile(r"^(?P<indent> *)(?P<fence>`{3,})(?P<language>[\w+-]*)(?P<marks>( +[^`]+)?)$")


@dataclass(frozen=True)
class Block:
    """A fenced block.

    Attributes
    ----------
    language, text
        As they stand on the page.
    line
        Where its text begins, counted from 1.
    run, slow
        Whether the tests run it, and whether only the slow ones do.
    exit_code
        Of its last command.
    file
        What file it is; empty: none.
    """

    language: str
    text: str
    line: int
    run: bool = False
    slow: bool = False
    exit_code: int = 0
    file: str = ""


def blocks(page: str) -> list[Block]:
    """Return the fenced blocks of a Markdown text that name a language.

    Raises
    ------
    ValueError
        A mark is unknown; the sentence names it and the line.
    """
    found: list[Block] = []
    replace_blocks(page, lambda block: found.append(block))
    return found


def replace_blocks(page: str, replacement: Callable[[Block], str | None]) -> str:
    """Return the text without marks, and with other text for some blocks.

    ``replacement`` returns what stands for a block, fences and all, or None to keep it.
    """
    lines: list[str] = []
    remaining = iter(enumerate(page.split("\n"), start=1))
    for number, line in remaining:
        opening = _OPENING.match(line)
        if opening is None:
            lines.append(line)
            continue
        indent, inside = opening["indent"], []
        for _, text in remaining:
            if text.strip() == opening["fence"]:
                break
            inside.append(text.removeprefix(indent))
        if not opening["language"]:
            # Shown as it stands, also where it shows how a block is written.
            lines += [line, *(indent + text if text else "" for text in inside)]
            lines.append(indent + opening["fence"])
            continue
        block = _block(opening["language"], opening["marks"], "\n".join(inside), number + 1)
        other = replacement(block)
        if other is not None:
            lines.append(other)
            continue
        title = f' title="{block.file}"' if block.file else ""
        lines.append(f"{indent}{opening['fence']}{block.language}{title}")
        lines += [indent + text if text else "" for text in inside]
        lines.append(indent + opening["fence"])
    return "\n".join(lines)


def _block(language: str, marks: str, text: str, line: int) -> Block:
    run = slow = False
    exit_code, file = 0, ""
    for mark in marks.split():
        key, _, value = mark.partition("=")
        match key:
            case "run":
                run = True
            case "slow":
                slow = True
            case "exit":
                exit_code = int(value)
            case "file":
                file = value
            case _:
                raise ValueError(f"Line {line - 1}: a block has the unknown mark '{mark}'.")
    return Block(language, text, line, run, slow, exit_code, file)
