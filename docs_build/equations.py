"""LaTeX to MathML, while the site is built: browsers draw it without a script."""

from __future__ import annotations

import html
import re
from importlib.util import find_spec
from pathlib import Path

from math_core import LatexError, LatexToMathML

_EQUATION = re.compile(
    r'<(?P<tag>span|div) class="arithmatex">\\(?P<open>[(\[])(?P<latex>.*?)\\[)\]]</(?P=tag)>',
    re.DOTALL,
)
_NUMBERED = re.compile(r"\\begin\{(align|equation|gather)\*?\}")
"""Where a number may stand."""

_ALWAYS = "√\N{OVERLINE}abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789"
"""Roots have their sign from an element and not from the text."""

_TAGS = re.compile(r"<[^>]*>")


def with_equations(page: str) -> str:
    r"""Return the HTML of a page with MathML where ``\(...\)`` and ``\[...\]`` were marked.

    Equations are numbered by page.

    Raises
    ------
    ValueError
        An equation cannot be converted; the sentence shows it.
    """
    converter = LatexToMathML(fancy_error=False)

    def mathml(found: re.Match[str]) -> str:
        latex = html.unescape(found["latex"]).strip()
        if r"\tag" in latex and not _NUMBERED.match(latex):
            latex = rf"\begin{{equation}}{latex}\end{{equation}}"
        try:
            math = converter.convert_with_global_state(latex, displaystyle=found["open"] == "[")
        except LatexError as error:
            raise ValueError(f"No LaTeX that can be converted ({error}): {latex}") from error
        return f'<{found["tag"]} class="arithmatex">{math}</{found["tag"]}>'

    return _EQUATION.sub(mathml, page)


def characters(page: str) -> set[str]:
    """Return the characters of all equations in the HTML of a page."""
    return {
        character
        for math in re.findall(r"<math.*?</math>", page, re.DOTALL)
        for character in html.unescape(_TAGS.sub("", math))
    }


def write_font(target: Path, used: set[str]) -> None:
    """Write the font of the equations, STIX Two Math, with the characters that are used.

    Fences and roots grow only with a font that has a table of sizes, which few systems have.
    """
    from fontTools import subset

    package = find_spec("ziamath")
    assert package is not None
    assert package.origin is not None
    options = subset.Options(flavor="woff", layout_features=["*"], notdef_outline=True)
    font = subset.load_font(
        str(Path(package.origin).parent / "fonts" / "STIXTwoMath-Regular.ttf"), options
    )
    subsetter = subset.Subsetter(options)
    subsetter.populate(text="".join(sorted(used | {*_ALWAYS})))
    subsetter.subset(font)
    target.parent.mkdir(parents=True, exist_ok=True)
    subset.save_font(font, str(target), options)
