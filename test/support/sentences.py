"""What sentences for people must be like."""

from __future__ import annotations

import re


def assert_one_sentence(text: str, *mentions: str) -> None:
    """Assert that a refusal is one sentence, for people, that mentions what it must.

    A second one may ask whether a similar name was meant.
    """
    assert "\n" not in text.strip(), text
    assert re.fullmatch(r".*\.( Did you mean '[^']+'\?)?", text.strip()), text
    assert "Traceback" not in text, text
    for mention in mentions:
        assert mention in text, f"'{mention}' is not mentioned in: {text}"
