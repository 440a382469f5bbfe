"""The rules of the house that a reader cannot check at a glance."""

import ast
import importlib
import subprocess
import sys
from pathlib import Path

import pytest

import holdfast

SOURCE = Path(holdfast.__file__).parent
FILES = {
    ".".join(("holdfast", *path.relative_to(SOURCE).with_suffix("").parts)).removesuffix(
        ".__init__"
    ): path
    for path in sorted(SOURCE.rglob("*.py"))
}
TREES = {name: ast.parse(path.read_text()) for name, path in FILES.items()}

PARTS = {"plants", "controllers", "attacks", "estimators"}
BELOW = {"records", "numerics"}
CORE = {
    *BELOW, "parts", *PARTS, "detectors", "analysis", "loop", "auth", "evaluate", "catalog",
    "campaign", "reach", "testing",
}  # fmt: skip
MAY_IMPORT = {
    "records": set(),
    "numerics": set(),
    "parts": BELOW,
    "plants": {*BELOW, "parts"},
    **{group: {*BELOW, "parts", "plants"} for group in ("controllers", "attacks", "estimators")},
    "detectors": {*BELOW, "parts"},
    **{
        group: {*BELOW, "parts", "plants", "controllers", "estimators", "detectors"}
        for group in ("analysis", "reach")
    },
    "loop": {"records", "parts"},
    "auth": {"records"},
    "evaluate": BELOW,
    "catalog": {*PARTS, "detectors"},
    "testing": {*BELOW, "parts", "plants", "loop"},
    "campaign": CORE - {"auth", "reach", "testing"},
    "report": {"records", "evaluate", "campaign", "reach"},
    "papers": {*CORE, "report"} - {"testing"},
    "shell": {*CORE, "report", "papers"} - {"testing"},
}


def layer(module):
    """The folder or file directly under holdfast that a module belongs to; "" for the package."""
    return (*module.split("."), "")[1]


def imported(module):
    """Every module that an import statement names, wherever it stands."""
    for node in ast.walk(TREES[module]):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{module}: a relative import in line {node.lineno}"
            for alias in node.names:
                name = f"{node.module}.{alias.name}"
                yield name if name in FILES else node.module


def ours(module):
    return {name for name in imported(module) if name.split(".")[0] == "holdfast"}


def test_every_layer_is_in_the_table():
    assert {layer(module) for module in FILES} - {""} <= MAY_IMPORT.keys()


@pytest.mark.parametrize("module", [module for module in FILES if layer(module)])
def test_who_imports_whom(module):
    mine = layer(module)
    allowed = MAY_IMPORT[mine] | {mine}
    for name in ours(module):
        # the package itself holds only the version and the lazy public names
        assert name == "holdfast" or layer(name) in allowed, f"{module} imports {name}"


def test_no_import_cycles():
    edges = {module: ours(module) & FILES.keys() - {"holdfast", module} for module in FILES}
    while edges:
        free = {module for module, names in edges.items() if not names & edges.keys()}
        assert free, f"a cycle among {sorted(edges)}"
        edges = {module: names for module, names in edges.items() if module not in free}


def test_matplotlib_only_in_figures():
    users = {m for m in FILES if any(n.split(".")[0] == "matplotlib" for n in imported(m))}
    assert users <= {
        f"holdfast.report.{name}"
        for name in ("figures", "mode_figures", "paper_figures", "roc_figure", "campaign_figures",
                     "arena_figures")
    }  # fmt: skip


OUTSIDE = {
    "os", "io", "pathlib", "shutil", "tempfile", "socket", "urllib", "http", "requests", "time",
    "datetime", "logging", "sys", "subprocess", "threading", "random", "secrets", "uuid",
}  # fmt: skip
CALLS = {"open", "print", "input", "exec", "eval"}
ATTRIBUTES = {("np", "random"), ("numpy", "random"), ("jax", "debug")}


@pytest.mark.parametrize(
    "module", [module for module in FILES if layer(module) in {*CORE, "papers"}]
)
def test_core_is_pure(module):
    found = {name for name in imported(module) if name.split(".")[0] in OUTSIDE}
    assert not found, f"{module} imports {found}"
    for node in ast.walk(TREES[module]):
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
            assert node.func.id not in CALLS, f"{module} line {node.lineno}: {node.func.id}()"
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
            pair = (node.value.id, node.attr)
            assert pair not in ATTRIBUTES, f"{module} line {node.lineno}: {'.'.join(pair)}"


def bases(node):
    return [base.id if isinstance(base, ast.Name) else ast.unparse(base) for base in node.bases]


def test_parts_are_final():
    """A class is abstract, in parts.py, or derives from one of those alone and has no heirs."""
    classes = {
        (module, node.name): bases(node)
        for module, tree in TREES.items()
        for node in ast.walk(tree)
        if isinstance(node, ast.ClassDef)
    }
    abstract = {"Plant", "Controller", "Attack", "Estimator", "Detector"}
    found = {name for (module, name) in classes if module == "holdfast.parts"}
    assert found == {*abstract, "InvalidValue"}
    final = {key: parents for key, parents in classes.items() if abstract & set(parents)}
    assert len(final) > 10
    for (module, name), parents in final.items():
        assert len(parents) == 1, f"{module}.{name} derives from {parents}"
    names = {name for _, name in final}
    for (module, name), parents in classes.items():
        heirs = {parent.split(".")[-1] for parent in parents} & names
        assert not heirs, f"{module}.{name} derives from the final {heirs}"


@pytest.mark.parametrize("name", holdfast.__all__)
def test_public_names_exist(name):
    assert getattr(holdfast, name) is not None


def test_unknown_names_are_refused():
    with pytest.raises(AttributeError, match="no attribute 'Klaman'"):
        holdfast.Klaman  # noqa: B018


def test_the_command_line_does_not_wait_for_jax():
    code = (
        "import sys, holdfast.shell.cli; "
        "print([m for m in ('jax', 'scipy', 'matplotlib', 'xarray') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


BENCHMARKS = sorted((Path(__file__).parents[1] / "benchmarks").glob("*.py"))


@pytest.mark.parametrize("path", BENCHMARKS, ids=lambda path: path.stem)
def test_benchmarks_ask_for_what_there_is(path):
    """Nobody runs them every day: what they import must not have moved away."""
    for node in ast.walk(ast.parse(path.read_text("utf-8"))):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("holdfast"):
            module = importlib.import_module(node.module)
            for alias in node.names:
                if not hasattr(module, alias.name):
                    importlib.import_module(f"{node.module}.{alias.name}")


def public(node):
    return not node.name.startswith("_")


@pytest.mark.parametrize("module", FILES)
def test_public_things_have_docstrings(module):
    tree = TREES[module]
    missing = [] if ast.get_docstring(tree) else ["the module"]
    kinds = (ast.FunctionDef, ast.ClassDef)
    for node in filter(public, (n for n in tree.body if isinstance(n, kinds))):
        inner = node.body if isinstance(node, ast.ClassDef) else []
        for part in [node, *filter(public, (n for n in inner if isinstance(n, kinds)))]:
            if not ast.get_docstring(part):
                missing.append(part.name)
    assert not missing, f"{module}: no docstring on {missing}"


def test_every_part_has_a_builder():
    """A module of a concrete part has `build`, or is used by one that has."""
    for group in ("controllers", "attacks", "estimators", "detectors"):
        for module in FILES:
            if layer(module) == group and any(
                isinstance(node, ast.ClassDef) and not node.name.startswith("_")
                and set(bases(node)) & {"Controller", "Attack", "Estimator", "Detector"}
                for node in TREES[module].body
            ):  # fmt: skip
                held = importlib.import_module(module)
                assert hasattr(held, "build") or module == "holdfast.attacks.window", module
