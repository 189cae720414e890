"""MkDocs hook: formulas become MathML, which browsers show without scripts and without a network."""

import html
import re
from typing import Any

from latex2mathml.converter import convert

FORMULA = re.compile(r'<(span|div) class="arithmatex">\\[(\[](.*?)\\[)\]]</\1>', re.DOTALL)
"""What pymdownx.arithmatex makes of a formula within a line (span) or on its own (div)."""


def on_page_content(content: str, **_: Any) -> str:
    """Called by MkDocs for each page once its Markdown is HTML."""
    return FORMULA.sub(as_mathml, content)


def as_mathml(match: re.Match[str]) -> str:
    """One formula."""
    display = "block" if match[1] == "div" else "inline"
    return convert(html.unescape(match[2]).strip(), display=display)
