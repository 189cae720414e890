"""MkDocs hook: the project's own Markdown files as pages of the documentation."""

import importlib
import pathlib
import re
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mkdocs.structure.files import Files

PROJECT = pathlib.Path(__file__).parents[2]
PAGES = {"CONTRIBUTING.md": "contributing.md", "CHANGELOG.md": "changelog.md"}
"""Pages by the file that they are made of."""


def on_files(files: "Files", *, config: Any) -> "Files":
    """Called by MkDocs with the files of the documentation."""
    # Imported here, as a test of the pages runs where MkDocs is not installed.
    file: Any = importlib.import_module("mkdocs.structure.files").File
    for source, page in PAGES.items():
        text = (PROJECT / source).read_text("utf-8")
        files.append(file.generated(config, page, content=with_links_of_the_site(text)))
    return files


def with_links_of_the_site(text: str) -> str:
    """Links to pages of the documentation stay; those to other files of the project become their words."""
    return re.sub(r"\[([^\]]+)\]\((?!\w+:)([^)]+)\)", link, text)


def link(match: re.Match[str]) -> str:
    """One link to a file of the project."""
    words, target = match.groups()
    target = PAGES.get(target, target.removeprefix("docs/") if target.startswith("docs/") else None)
    return f"[{words}]({target})" if target else words
