"""Griffe extension: doctests become fenced blocks, so that Markdown does not read their brackets as links."""

import re
from typing import Any

from griffe import Extension, Object

DOCTEST = re.compile(r"^(?P<indent> *)>>> .*(?:\n(?P=indent)\S.*)*", re.MULTILINE)
"""A prompt and every line that follows it up to the next empty one."""
SECTION = re.compile(r"^Examples?:$", re.MULTILINE)
"""Where a docstring has this heading, mkdocstrings sets the doctests itself."""


class FenceDoctests(Extension):
    """Applies `fence_doctests` to every docstring that mkdocstrings collects."""

    def on_object(self, *, obj: Object, **_: Any) -> None:
        """Called by griffe for each object once it is loaded."""
        if obj.docstring:
            obj.docstring.value = fence_doctests(obj.docstring.value)


def fence_doctests(text: str) -> str:
    """Puts the doctests of a docstring without an ``Examples:`` section into fenced blocks.

    Args:
      text: the docstring, in Markdown, without common indentation.

    Returns:
      The text with every doctest fenced.
    """
    if SECTION.search(text):
        return text
    return DOCTEST.sub(
        lambda match: f"{match['indent']}```pycon\n{match[0]}\n{match['indent']}```",
        text,
    )
