"""The house rules as tests: import layers, exports, docstrings, keyword-only options, README."""

import ast
import dataclasses
import functools
import importlib
import inspect
import pathlib
import pkgutil
import re
import tokenize

import pytest

import jaxbox

ROOT = pathlib.Path(jaxbox.__file__).parent
PROJECT = ROOT.parent

# Each layer may import those before it, and itself.
LAYERS = [
    # The standard library and NumPy alone.
    {"_version", "_extras", "_files", "_interrupts", "_loopback", "_padding"},
    {"config"},
    # `_box` and `_box_rows` are parts of `types`: what one box, and what boxes of any kind, can do.
    {"_box", "_box_rows", "types", "geometry", "xla"},
    {"stages"},
    {"detector"},
    {"tracking"},
    {"run"},
    {"io", "evaluation", "viz", "synthetic"},
    {"tuning", "viewer", "cluster", "live"},
]
# An oracle is independent of what it checks.
REFERENCE = {"_version", "config", "types"}
ALLOWED = {room: set.union(*LAYERS[: level + 1]) for level, rooms in enumerate(LAYERS) for room in rooms} | {
    "reference": REFERENCE
}
TOP = {"cli", "__main__", "__init__"}

MODULES = sorted(
    name for _, name, _ in pkgutil.walk_packages([str(ROOT)], "jaxbox.") if not name.endswith("__main__")
)
PUBLIC_MODULES = [
    "jaxbox",
    "jaxbox.cluster",
    "jaxbox.io",
    "jaxbox.live",
    "jaxbox.evaluation",
    "jaxbox.evaluation.tracking",
    "jaxbox.run.export",
    "jaxbox.tracking",
    "jaxbox.tuning",
    "jaxbox.viz",
    "jaxbox.synthetic",
    "jaxbox.viewer",
]


def source_files():
    return sorted(ROOT.rglob("*.py"))


def offenders(paths, rule):
    """By file, what breaks a rule: `rule` lists it for one path."""
    return {relative(path): found for path in paths if (found := rule(path))}


def room_of(path):
    """The part of the package that a file belongs to: its top-level module or package."""
    return path.relative_to(ROOT).with_suffix("").parts[0]


def imported_rooms(path):
    """Rooms of jaxbox that a file imports, with `from jaxbox import x` and relative imports resolved."""
    for node in ast.walk(parsed(path)):
        names = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}:{node.lineno}: relative import"
            module = node.module or ""
            names = [f"{module}.{alias.name}" for alias in node.names] if module == "jaxbox" else [module]
        for name in names:
            parts = name.split(".")
            if parts[0] == "jaxbox":
                yield parts[1] if len(parts) > 1 else "__init__"


def public_callables():
    for module_name in PUBLIC_MODULES:
        module = importlib.import_module(module_name)
        for name in module.__all__:
            item = getattr(module, name)
            if inspect.isroutine(item) or inspect.isclass(item) or hasattr(item, "__wrapped__"):
                yield f"{module_name}.{name}", item


def test_imports_go_down_the_layers_only():
    def imports_upward(path):
        return set(imported_rooms(path)) - ALLOWED[room_of(path)] - {room_of(path)}

    assert offenders([path for path in source_files() if room_of(path) not in TOP], imports_upward) == {}


def test_only_what_people_call_on_boxes_imports_by_name_and_so_past_the_layers():
    importing = [path for path in source_files() if 'import_module(f"jaxbox' in path.read_text()]
    assert [relative(path) for path in importing] == ["_box_rows.py"]
    calls = {relative(path) for path in source_files() if "later_module(" in path.read_text()}
    assert calls == {"_box_rows.py", "types.py", "tracking/tracks.py"}


def test_the_first_layer_imports_nothing_of_the_package():
    assert not {room for room in LAYERS[0] for _ in imported_rooms(ROOT / f"{room}.py")}


def test_every_room_has_a_layer():
    rooms = {room_of(path) for path in source_files()}
    assert rooms == set(ALLOWED) | TOP, "a new module, or one that is gone: say in this test where it belongs"


@pytest.mark.parametrize("stage", ["config", "types", "geometry", "xla", "stages", "detector", "tracking"])
def test_below_the_detector_nothing_prints_reads_or_takes_the_time(stage):
    tree = ast.parse("\n".join(path.read_text() for path in source_files() if room_of(path) == stage))
    calls = {
        node.func.id
        for node in ast.walk(tree)
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name)
    }
    imports = {alias.name for node in ast.walk(tree) if isinstance(node, ast.Import) for alias in node.names}
    assert not calls & {"print", "open", "input"}
    # `xla.backend` asks what XLA was told.
    imports -= {"os"} if stage == "xla" else set()
    assert not imports & {"time", "os", "pathlib", "random", "cv2", "scipy"}


@pytest.mark.parametrize("module_name", PUBLIC_MODULES)
def test_exports_exist_are_sorted_and_not_private(module_name):
    module = importlib.import_module(module_name)
    # Constants, which are all capitals, come first.
    assert module.__all__ == sorted(module.__all__, key=lambda name: (not name.isupper(), name))
    assert all(hasattr(module, name) for name in module.__all__)
    assert not [name for name in module.__all__ if name.startswith("_") and name != "__version__"]


@pytest.mark.parametrize("module_name", MODULES)
def test_modules_and_their_public_names_are_documented(module_name):
    module = importlib.import_module(module_name)
    assert module.__doc__
    for name, item in vars(module).items():
        own = getattr(item, "__module__", None) == module_name
        if own and not name.startswith("_") and (inspect.isroutine(item) or inspect.isclass(item)):
            assert inspect.getdoc(item), f"{module_name}.{name} has no docstring"


@pytest.mark.parametrize(
    ("name", "item"), list(public_callables()), ids=lambda value: value if isinstance(value, str) else ""
)
def test_options_are_keyword_only(name, item):
    if inspect.isclass(item) or name in ("jaxbox.detect", "jaxbox.detect_batch"):
        # JAX builds the data types positionally; the config and key of detect are operands too.
        return
    for parameter in inspect.signature(item).parameters.values():
        if parameter.default not in (inspect.Parameter.empty, None, 0):
            assert parameter.kind is inspect.Parameter.KEYWORD_ONLY, f"{name}: {parameter.name}"


def dataclass_fields():
    for name, item in public_callables():
        if inspect.isclass(item) and dataclasses.is_dataclass(item):
            yield name, item


@pytest.mark.parametrize(
    ("name", "item"), list(dataclass_fields()), ids=lambda value: value if isinstance(value, str) else ""
)
def test_every_field_of_a_public_dataclass_is_documented(name, item):
    body = ast.parse(inspect.getsource(item)).body[0].body
    for statement, following in zip(body, [*body[1:], None], strict=True):
        # A sub-config says itself what it is.
        if isinstance(statement, ast.AnnAssign) and not ast.unparse(statement.annotation).endswith("Config"):
            documented = (
                isinstance(following, ast.Expr)
                and isinstance(following.value, ast.Constant)
                and isinstance(following.value.value, str)
            )
            assert documented, f"{name}.{ast.unparse(statement.target)} has no documentation string under it"


def lines_of_body(function):
    documented = ast.get_docstring(function) is not None
    first = function.body[1] if documented and len(function.body) > 1 else function.body[0]
    return function.end_lineno - first.lineno + 1


def test_functions_and_modules_are_short():
    def long_functions(path):
        functions = [node for node in ast.walk(parsed(path)) if isinstance(node, ast.FunctionDef)]
        return [function.name for function in functions if lines_of_body(function) > 60]

    assert offenders(source_files(), long_functions) == {}
    assert [path.name for path in source_files() if path.read_text().count("\n") >= 500] == []


def test_the_version_is_the_same_everywhere():
    citation = (PROJECT / "CITATION.cff").read_text()
    assert f"version: {jaxbox.__version__}\n" in citation
    assert f"## {jaxbox.__version__}" in (PROJECT / "CHANGELOG.md").read_text()


def readme():
    return (PROJECT / "README.md").read_text()


MAX_README_WORDS = 450


def prose(text):
    """The words of a Markdown page: without code, tables, pictures, and the targets of links."""
    text = re.sub(r"^```.*?^```", "", text, flags=re.DOTALL | re.MULTILINE)
    text = re.sub(r"^\|.*$", "", text, flags=re.MULTILINE)
    text = re.sub(r"!\[[^\]]*\]\([^)]*\)", "", text)
    text = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", text)
    return [word for word in text.split() if re.search(r"\w", word)]


def test_the_readme_is_short():
    words = len(prose(readme()))
    assert words <= MAX_README_WORDS, f"{words} words: move some to docs/"


def test_words_of_a_page_are_those_of_its_prose():
    page = "# One two\n\n```bash\nno no\n```\n\n| no | no |\n|---|---|\n\n![no](no.png) [three four](no.md) -"
    assert prose(page) == ["One", "two", "three", "four"]


def test_the_readme_python_example_runs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    examples = re.findall(r"```python\n(.*?)```", readme(), re.DOTALL)
    assert len(examples) == 1
    scope = {}
    exec(compile(examples[0], "README.md", "exec"), scope)
    assert bool(scope["detections"].valid.any())


def test_the_readme_pictures_and_links_exist_and_are_small():
    targets = re.findall(r"\]\(([^)#]+)\)", readme())
    local = [target for target in targets if "://" not in target]
    assert any(target.endswith(".png") for target in local)
    for target in local:
        assert (PROJECT / target).is_file(), target
        assert (PROJECT / target).stat().st_size < 300_000, target


def test_the_readme_names_both_commands():
    assert "pip install . && jaxbox demo" in readme()
    assert "pip install -e '.[test]' && pytest" in readme()


# What exists because of a compiler is in jaxbox.xla alone.

STAGES = sorted((ROOT / "stages").glob("*.py"))
METHOD = {"stages", "geometry", "detector", "tracking"}
"""From the points to the tracks: they say what is computed, and nothing of how a compiler makes it fast."""
COMPUTING = METHOD | {"config", "types", "evaluation", "synthetic"}
"""Those, and all others with functions that are compiled."""

LOOPS = {"while_loop", "fori_loop", "scan", "cond", "switch", "map"}
FOR_A_COMPILER = {"platform_dependent", "optimization_barrier"}
BIT_TRICKS = {
    *("population_count", "clz", "bitcast_convert_type", "view"),
    *("shift_left", "shift_right_logical", "shift_right_arithmetic", "left_shift", "right_shift"),
    *(
        "bitwise_and",
        "bitwise_or",
        "bitwise_xor",
        "bitwise_count",
        "bitwise_left_shift",
        "bitwise_right_shift",
    ),
}
COMPILER_WORDS = re.compile(
    r"\bXLA\b|\bLLVM\b|\bkernels?\b|vectori[sz]|\bfus(?:e|es|ed|ion|ing)\b|\bnative\b|\bcompiler\b"
)
CHUNK_SIZE = re.compile(r"(?:\b|_)(?:CHUNKS?|TILES?|BLOCKS)(?:\b|_)")


def relative(path):
    return str(path.relative_to(ROOT))


@functools.cache
def parsed(path):
    return ast.parse(path.read_text())


def names_in(tree):
    """Names and attributes that a program reads or imports: `scan` of `jax.lax.scan`."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute):
            yield node.attr
        elif isinstance(node, ast.Name):
            yield node.id
        elif isinstance(node, ast.ImportFrom):
            yield from (alias.name for alias in node.names)


def names_of_lax(tree):
    """Names of `jax.lax` that a program reads or imports."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute) and ast.unparse(node.value) in ("jax.lax", "lax"):
            yield node.attr
        elif isinstance(node, ast.ImportFrom) and node.module == "jax.lax":
            yield from (alias.name for alias in node.names)


def bit_tricks(tree):
    """What a program does with the bits of numbers; `&` of truth values is none."""
    yield from set(names_in(tree)) & BIT_TRICKS
    for node in ast.walk(tree):
        if not isinstance(node, ast.BinOp | ast.AugAssign):
            continue
        sides = (node.left, node.right) if isinstance(node, ast.BinOp) else (node.target, node.value)
        of_numbers = any(
            (isinstance(side, ast.Constant) and isinstance(side.value, int))
            or (isinstance(side, ast.BinOp) and is_arithmetic(side.op))
            for side in sides
        )
        if isinstance(node.op, ast.LShift | ast.RShift) or (of_numbers and not is_arithmetic(node.op)):
            yield ast.unparse(node)


def is_arithmetic(operation):
    return not isinstance(operation, ast.BitAnd | ast.BitOr | ast.BitXor)


def words_about(path):
    """Comments and documentation strings of a file."""
    with tokenize.open(path) as file:
        for token in tokenize.generate_tokens(file.readline):
            if token.type == tokenize.COMMENT:
                yield token.string
    for node in ast.walk(parsed(path)):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
            yield str(node.value.value)


def names_in_file(names):
    """A rule: which of some names a file reads or imports."""
    return lambda path: names & set(names_in(parsed(path)))


def constants(tree):
    """Names of a module's constants."""
    for node in tree.body:
        targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
        for target in targets:
            for name in ast.walk(target) if isinstance(target, ast.AST) else ():
                if isinstance(name, ast.Name) and name.id.isupper():
                    yield name.id


def of_rooms(rooms):
    """Source files of some rooms."""
    return [path for path in source_files() if room_of(path) in rooms]


def outside(*places):
    """Source files of the package but those in some rooms, or of a name."""
    return [
        path for path in source_files() if not any(relative(path) == p or room_of(path) == p for p in places)
    ]


def test_loops_and_what_else_is_for_a_compiler_are_in_xla():
    assert offenders(outside("xla"), lambda path: set(names_of_lax(parsed(path))) & LOOPS) == {}
    # It writes the programs of both platforms.
    assert set(offenders(outside("xla"), names_in_file(FOR_A_COMPILER))) == {"run/export.py"}


def test_only_xla_says_what_is_materialized():
    assert offenders(outside("xla"), names_in_file({"materialize"})) == {}


def test_only_xla_and_run_ask_what_a_program_is_built_for():
    assert offenders(outside("xla", "run"), names_in_file({"on_accelerator"})) == {}


def test_bit_tricks_are_in_xla():
    assert offenders(of_rooms(COMPUTING), lambda path: list(bit_tricks(parsed(path)))) == {}


def test_the_method_says_nothing_of_a_compiler():
    def about_a_compiler(path):
        return [words for words in words_about(path) if COMPILER_WORDS.search(words)]

    assert offenders(of_rooms(METHOD), about_a_compiler) == {}


def test_chunk_sizes_are_in_one_table():
    def chunk_sizes(path):
        return [name for name in constants(parsed(path)) if CHUNK_SIZE.search(name)]

    # Those of `io` are of files, those of `cli` of pictures.
    assert set(offenders(outside("io", "cli"), chunk_sizes)) == {"xla/chunks.py"}


@pytest.mark.parametrize(
    ("source", "tricks"),
    [
        ("a & b | (c > 1) & ~d", 0),
        ("x: int | None = a == 1 & b", 1),
        ("found >> 1, found & 1 == 1", 2),
        ("a &= 3\nb <<= 2\nc |= d", 2),
        ("n & (n - 1)", 1),
        ("jax.lax.population_count(a) + jnp.bitwise_and(a, b)", 2),
    ],
)
def test_bit_tricks_are_told_from_truth_values(source, tricks):
    assert len(list(bit_tricks(ast.parse(source)))) == tricks


# Stages.


@pytest.mark.parametrize("path", STAGES, ids=relative)
def test_stages_share_what_is_in_state_and_in_private_modules_only(path):
    modules = {
        (f"{node.module}.{alias.name}" if node.module == "jaxbox.stages" else node.module).split(".")[2]
        for node in ast.walk(parsed(path))
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("jaxbox.stages")
        for alias in node.names
    }
    assert not {name for name in modules if name != "state" and not name.startswith("_")}


@pytest.mark.parametrize("path", STAGES, ids=relative)
def test_stages_pass_every_option_by_its_name(path):
    for node in ast.walk(parsed(path)):
        if isinstance(node, ast.Call):
            assert all(keyword.arg is not None for keyword in node.keywords), ast.unparse(node)
        elif isinstance(node, ast.Dict):
            assert None not in node.keys, ast.unparse(node)
        elif isinstance(node, ast.FunctionDef | ast.Lambda):
            assert node.args.kwarg is None, ast.unparse(node)


def test_no_module_lists_the_names_of_fields():
    def lists_of_fields(path):
        return [name for name in constants(parsed(path)) if name.endswith("_FIELDS")]

    # Those of `io` are of files.
    assert offenders(outside("io"), lists_of_fields) == {}


def test_the_public_modules_at_the_root_are_the_types_and_the_pipeline():
    names = {path.stem for path in ROOT.glob("*.py")}
    assert {name for name in names if not name.startswith("_")} == {"types", "detector"}


def test_an_oracle_reads_nothing_of_what_it_checks():
    rooms = {room for path in (ROOT / "reference").rglob("*.py") for room in imported_rooms(path)}
    assert rooms <= {"reference", "_version", "config", "types"}
