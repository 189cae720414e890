"""The documentation's hooks: what they make of docstrings and pages."""

import importlib
import importlib.util
import pathlib
import re

import numpy as np
import pytest

import jaxbox
from jaxbox import DetectorConfig
from jaxbox.config import fields
from jaxbox.io.images import read_image

PROJECT = pathlib.Path(__file__).parents[1]


def load(path):
    """A module that belongs to no package."""
    spec = importlib.util.spec_from_file_location(f"{path.parent.name}_{path.stem}", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def hook(name):
    """A module of docs/hooks."""
    return load(PROJECT / "docs" / "hooks" / f"{name}.py")


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


def rows_of(page):
    """The cells of each row of its tables."""
    lines = [line[2:-2] for line in page.splitlines() if line.startswith("| `")]
    rows = [re.split(r" (?<!\\)\| ", line) for line in lines]
    return {name.strip("`"): cells for name, *cells in rows}


def test_the_page_of_settings_has_every_setting_its_default_and_whether_it_is_traced():
    config = DetectorConfig()
    rows = rows_of(hook("figures").settings())
    traced = fields.traced_fields(config)
    names = {name: re.sub(r"\.\d+\.", ".N.", name) for name in fields.all_fields(config)}
    assert set(rows) == set(names.values())
    for name, value in fields.all_fields(config).items():
        default, takes, unit, kind, meaning = rows[names[name]]
        assert f"`{value}`" in default
        assert (takes != "") == (not isinstance(value, bool | str)), name
        assert kind == ("traced" if name in traced else "static"), name
        assert (unit == "m") == name.endswith("_m")
        assert meaning


def test_the_page_of_the_api_has_every_public_name():
    page = (PROJECT / "docs" / "api.md").read_text()
    missing = [name for name in jaxbox.__all__ if not re.search(rf"jaxbox\.{name}\b", page)]
    assert not missing, "add them to docs/api.md"


METHOD = (PROJECT / "docs" / "method.md").read_text()


@pytest.mark.parametrize("formula", re.findall(r"\\[(\[]\s*(.*?)\s*\\[)\]]", METHOD, re.DOTALL))
def test_every_formula_is_known_to_the_converter(formula):
    markup = hook("formulas").on_page_content(f'<span class="arithmatex">\\({formula}\\)</span>')
    assert markup.startswith("<math")
    assert "\\" not in markup


def test_links_of_the_projects_files_lead_within_the_site_or_are_words():
    pytest.importorskip("mkdocs", reason="pip install '.[docs]'")
    text = "[a](docs/install.md) [b](CHANGELOG.md) [c](LICENSE) [d](https://e.org)"
    links = hook("project_pages").with_links_of_the_site(text)
    assert links == "[a](install.md) [b](changelog.md) c [d](https://e.org)"


@pytest.mark.slow
def test_the_pipeline_strip_is_of_this_detector(tmp_path):
    load(PROJECT / "examples" / "pipeline_strip.py").main([str(tmp_path / "strip.png")])
    drawn, shown = read_image(tmp_path / "strip.png"), read_image(PROJECT / "docs" / "pipeline.png")
    assert drawn.shape == shown.shape
    # Another processor rounds differently, which may move an edge by a pixel.
    differing = np.any(drawn != shown, axis=-1).mean()
    assert differing < 0.001, "python examples/pipeline_strip.py docs/pipeline.png"


@pytest.mark.slow
def test_the_pictures_of_the_tutorial_are_of_these_steps(tmp_path):
    load(PROJECT / "examples" / "single_steps.py").main([str(tmp_path)])
    names = re.findall(r"\((step_\w+\.png)\)", (PROJECT / "docs" / "tutorial.md").read_text())
    assert sorted(names) == sorted(path.name for path in tmp_path.iterdir())
    for name in names:
        drawn, shown = read_image(tmp_path / name), read_image(PROJECT / "docs" / name)
        assert drawn.shape == shown.shape
        # As above.
        assert np.any(drawn != shown, axis=-1).mean() < 0.001, "python examples/single_steps.py docs"


ARCHITECTURE = (PROJECT / "docs" / "architecture.md").read_text()


def test_the_calls_and_files_that_the_architecture_names_exist():
    walks = re.findall(r"^## One (?:point|step).*?(?=^## )", ARCHITECTURE, re.MULTILINE | re.DOTALL)
    calls = {name for walk in walks for cell in first_cells(walk) for name in re.findall(r"`([\w.]+)`", cell)}
    assert {"ground.remove_ground", "association.associate"} <= calls
    assert {name for name in calls if not is_known(name)} == set()
    assert not is_known("scoring.detect")
    files = set(re.findall(r"`((?:\w+/)+\w+\.py)`", ARCHITECTURE))
    assert {"stages/ground.py", "tracking/association.py"} <= files
    places = PROJECT, PROJECT / "jaxbox"
    assert {name for name in files if not any((place / name).is_file() for place in places)} == set()


def first_cells(text):
    return [line.split("|")[1] for line in text.splitlines() if line.startswith("| ")]


def is_known(name):
    """Whether a dotted name is one of jaxbox, of a stage or of the tracker."""
    module, _, attribute = name.removeprefix("jaxbox.").rpartition(".")
    if hasattr(getattr(jaxbox, module, None) if module else jaxbox, attribute):
        return True
    homes = [f"jaxbox{home}.{module}" for home in ("", ".stages", ".tracking")]
    found = [importlib.import_module(home) for home in homes if importlib.util.find_spec(home)]
    return any(hasattr(home, attribute) for home in found)


def anchors(page):
    """Anchors of a page's headings, as the site and GitHub make them."""
    text = re.sub(r"^```.*?^```", "", page.read_text(), flags=re.MULTILINE | re.DOTALL)
    headings = re.findall(r"^#+ (.*)$", text, re.MULTILINE)
    return {re.sub(r"[-\s]+", "-", re.sub(r"[^\w\s-]", "", heading.lower())) for heading in headings}


def test_links_to_a_section_lead_to_one():
    pages = [*(PROJECT / "docs").rglob("*.md"), PROJECT / "README.md"]
    links = [
        (page, link) for page in pages for link in re.findall(r"\]\(([^)\s]*#[^)\s]+)\)", page.read_text())
    ]
    broken = []
    for page, link in links:
        name, _, anchor = link.partition("#")
        target = page.parent / name if name else page
        # Sections of the API are made from its docstrings.
        if target.is_file() and target.name != "api.md" and anchor not in anchors(target):
            broken.append((page.name, link))
    assert len(links) > 20
    assert broken == []


def test_the_pages_of_the_navigation_are_the_pages_that_exist():
    named = set(re.findall(r"[\w/]+\.md", (PROJECT / "mkdocs.yml").read_text()))
    made = set(hook("project_pages").PAGES.values())
    docs = PROJECT / "docs"
    assert named - made == {path.relative_to(docs).as_posix() for path in docs.rglob("*.md")}


def test_the_page_of_other_sensors_has_the_recorded_counts():
    page = " ".join((PROJECT / "docs" / "my_sensor.md").read_text().split())
    figures = hook("figures")
    report = figures.load("sensors")
    found = {name: report[name]["recall"]["cars"] for name in ("argoverse2", "pandaset", "semantic_kitti")}
    for name, words in (
        ("argoverse2", "Argoverse 2"),
        ("pandaset", "PandaSet"),
        ("semantic_kitti", "SemanticKITTI"),
    ):
        assert re.search(rf"{found[name]['found']} of {found[name]['wanted']}(?: cars)? \({words}\)", page)
    cut = next(row for row in report["pooled"]["cuts"] if row["min_score"] == report["pooled"]["library_cut"])
    assert (
        f"{100 * cut['precision']:.0f} of 100 boxes from a score of {cut['min_score']:g}".replace("0.", ".")
        in page
    )
    (dense,) = (
        row for row in figures.load("beams")["kitti"] if row["sensor"] == 64 and row["set"] == "58 frames"
    )
    recall = f"{dense['recall bev 0.5']:.3f}"
    assert f"| 64 | {recall} | {recall} |" in figures.beams_recall()
