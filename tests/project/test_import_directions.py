"""Imports follow the data's one way: kernels_cl <- gi_core <- {bake_jobs, server}; and what is installed is complete."""

import ast
import fnmatch
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PACKAGES = ("server", "gi_core", "kernels_cl", "bake_jobs")
MAY_IMPORT = {
    "kernels_cl": {"kernels_cl"},
    "gi_core": {"gi_core", "kernels_cl"},
    "bake_jobs": {"bake_jobs", "gi_core"},
    "server": {"server", "gi_core"},
}
# Light libraries only, so that a server starts quickly and installs small.
NEVER_IN_GI_CORE = {"trimesh", "embreex", "fastapi", "starlette", "uvicorn", "scipy", "shapely", "typer", "pyproj", "mapbox_earcut"}
# The one command line may reach into the baker, and pictures of errors to its judge, inside the function that needs it.
LAZY_CALLERS = {("server/cli.py", "bake_jobs"), ("server/preview_error.py", "bake_jobs")}
CODE_SUFFIXES = {".py"}
NOT_DATA = {".pyc", ".pyo"}


def modules(package):
    return sorted((ROOT / package).rglob("*.py"))


def imports(path, root):
    """(module, whether it stands inside a function) for every absolute import; relative ones are resolved."""
    tree = ast.parse(path.read_text())
    package = path.relative_to(root).parent.parts

    def walk(node, lazy):
        for child in ast.iter_child_nodes(node):
            inside = lazy or isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda)
            if isinstance(child, ast.Import):
                yield from ((alias.name, lazy) for alias in child.names)
            elif isinstance(child, ast.ImportFrom):
                base = package[: len(package) - child.level + 1] if child.level else ()
                yield ".".join((*base, *([child.module] if child.module else []))), lazy
            else:
                yield from walk(child, inside)

    yield from walk(tree, False)


def wrong_imports(path, root=ROOT):
    package = path.relative_to(root).parts[0]
    where = path.relative_to(root).as_posix()
    for module, lazy in imports(path, root):
        top = module.split(".")[0]
        if top in PACKAGES and top not in MAY_IMPORT[package] and not (lazy and (where, top) in LAZY_CALLERS):
            yield f"{where} imports {module}"
        if package in ("gi_core", "kernels_cl") and top in NEVER_IN_GI_CORE:
            yield f"{where} imports {module}"


@pytest.mark.parametrize("package", PACKAGES)
def test_imports_follow_the_arrows(package):
    found = modules(package)
    assert found
    assert [wrong for path in found for wrong in wrong_imports(path)] == []


def test_the_check_sees_every_kind_of_import(tmp_path):
    """A check that can't fail holds nothing."""
    cases = {
        "gi_core/a.py": ("import scipy.spatial", 1),
        "gi_core/b.py": ("def f():\n    from trimesh import Trimesh", 1),
        "gi_core/c.py": ("if True:\n    try:\n        import server.app\n    except ImportError:\n        pass", 1),
        "gi_core/d.py": ("from . import sector\nfrom kernels_cl import source\nimport numpy", 0),
        "bake_jobs/e.py": ("from server import cli", 1),
        "kernels_cl/f.py": ("from gi_core import grid", 1),
        "server/cli.py": ("def f():\n    import bake_jobs.runner", 0),
        "server/g.py": ("def f():\n    import bake_jobs.runner", 1),
        "server/routes/h.py": ("from ..app import x\nfrom ...bake_jobs import y", 1),
    }
    for name, (text, expected) in cases.items():
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
        assert len(list(wrong_imports(path, tmp_path))) == expected, name
    (tmp_path / "server/cli.py").write_text("import bake_jobs.runner")
    assert list(wrong_imports(tmp_path / "server/cli.py", tmp_path))


@pytest.fixture(scope="module")
def setuptools_table():
    with (ROOT / "pyproject.toml").open("rb") as file:
        return tomllib.load(file)["tool"]["setuptools"]


def test_every_package_is_listed(setuptools_table):
    found = {init.parent.relative_to(ROOT).as_posix().replace("/", ".") for p in PACKAGES for init in (ROOT / p).rglob("__init__.py")}
    assert set(setuptools_table["packages"]) == found
    for package in PACKAGES:
        for path in modules(package):
            assert (path.parent / "__init__.py").exists(), f"{path} would not be installed"


def test_every_data_file_is_installed(setuptools_table):
    patterns = setuptools_table["package-data"]
    checked = 0
    for package in PACKAGES:
        for path in sorted((ROOT / package).rglob("*")):
            if not path.is_file() or path.suffix in CODE_SUFFIXES | NOT_DATA:
                continue
            checked += 1
            name = path.relative_to(ROOT / package).as_posix()
            assert any(fnmatch.fnmatchcase(name, pattern) for pattern in patterns.get(package, [])), f"{package}/{name} is not package data"
    assert checked >= 10


def test_every_pattern_of_data_files_finds_one(setuptools_table):
    for package, patterns in setuptools_table["package-data"].items():
        for pattern in patterns:
            assert list((ROOT / package).glob(pattern)), f"{package}: nothing matches {pattern}"
