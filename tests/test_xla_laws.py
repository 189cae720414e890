"""Every public function of `jaxbox.xla` states its law in one line, and a test next to this one runs it."""

import ast
import importlib
import inspect
import pathlib
import pkgutil

import pytest

from jaxbox import xla

MODULES = [
    importlib.import_module(f"jaxbox.xla.{module.name}") for module in pkgutil.iter_modules(xla.__path__)
]
FUNCTIONS = {
    f"{module.__name__.rpartition('.')[2]}.{name}": function
    for module in MODULES
    for name, function in vars(module).items()
    if inspect.isfunction(inspect.unwrap(function))
    and function.__module__ == module.__name__
    and not name.startswith("_")
}
WITHOUT_LAW = {
    "backend.batch_together": "says what a program is built for",
    "backend.building_for": "says what a program is built for",
    "backend.default_device": "asks JAX",
    "backend.is_on_device": "asks JAX",
    "backend.on_accelerator": "says what a program is built for",
    "backend.platform_of": "asks JAX",
    "loops.fast_axis": "of speed only: either axis gives the same sums",
}


def functions_in_tests():
    """Names such as `rows.compact` in the tests of the modules."""
    for path in pathlib.Path(__file__).parent.glob("test_xla_*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
                yield f"{node.value.id}.{node.attr}"


def test_the_modules_have_functions_and_the_list_names_some_of_them():
    assert len(FUNCTIONS) > 50
    assert WITHOUT_LAW.keys() < FUNCTIONS.keys()


@pytest.mark.parametrize("name", sorted(FUNCTIONS))
def test_a_public_function_states_its_law_in_one_line(name):
    laws = [line for line in inspect.getdoc(FUNCTIONS[name]).splitlines() if "Law: " in line]
    assert len(laws) == (name not in WITHOUT_LAW)
    # Nothing follows, so that the line holds it whole.
    assert all(line.endswith(".") for line in laws)


def test_every_public_function_is_in_a_test():
    assert set(FUNCTIONS) <= set(functions_in_tests())
