"""MkDocs hook: the project's own Markdown files as pages of the documentation."""

import pathlib
import re
from typing import Any

from mkdocs.structure.files import File, Files

PROJECT = pathlib.Path(__file__).parents[2]
PAGES = {"CONTRIBUTING.md": "contributing.md", "CHANGELOG.md": "changelog.md"}
"""Pages by the file that they are made of."""


def on_files(files: Files, *, config: Any) -> Files:
    """Called by MkDocs with the files of the documentation."""
    for source, page in PAGES.items():
        text = (PROJECT / source).read_text("utf-8")
        files.append(File.generated(config, page, content=with_links_of_the_site(text)))
    return files


def with_links_of_the_site(text: str) -> str:
    """Links to pages of the documentation stay; those to other files of the project become their words."""
    return re.sub(r"\[([^\]]+)\]\((?!\w+:)([^)]+)\)", link, text)


def link(match: re.Match[str]) -> str:
    """One link to a file of the project."""
    words, target = match.groups()
    target = PAGES.get(target, target.removeprefix("docs/") if target.startswith("docs/") else None)
    return f"[{words}]({target})" if target else words
