"""The documentation's hooks: what they make of docstrings and pages."""

import importlib.util
import pathlib

import pytest

PROJECT = pathlib.Path(__file__).parents[1]


def hook(name):
    """A module of docs/hooks, which is no package."""
    spec = importlib.util.spec_from_file_location(f"docs_{name}", PROJECT / "docs" / "hooks" / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def fence_doctests(text):
    pytest.importorskip("griffe", reason="pip install '.[docs]'")
    return hook("doctests").fence_doctests(text)


def test_each_doctest_has_a_fence_of_its_own():
    text = 'Says.\n\n>>> a = [1]\n>>> [b for b in a][0]\n1\n\nMore.\n\n  >>> f("\n  ... ")\n  2'
    fenced = (
        "Says.\n\n```pycon\n>>> a = [1]\n>>> [b for b in a][0]\n1\n```\n\n"
        'More.\n\n  ```pycon\n  >>> f("\n  ... ")\n  2\n  ```'
    )
    assert fence_doctests(text) == fenced


@pytest.mark.parametrize("text", ["Says a >>> b.", "Says.\n\nExamples:\n    >>> 1\n    1"])
def test_no_fence_where_none_is_missing(text):
    assert fence_doctests(text) == text
