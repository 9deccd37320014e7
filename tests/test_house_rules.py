"""The architecture's rules, read from the source: who imports whom, where kernels live, sizes.

Nothing is imported from the package: the rules hold even where a module cannot be loaded.
"""

from __future__ import annotations

import ast
import re
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "warpfiber"

# A room imports only rooms of a smaller rank, and itself. Rooms of one rank are siblings: they do
# not know each other.
ROOMS = (
    {"scene", "model"},
    {"laws"},
    {"placement", "passes"},
    {"build", "methods", "output"},
    {"simulation"},
    {"summary", "stopping", "restart", "recording", "trial"},
    {"job", "checking", "progress"},
    {"__main__"},
)
RANK = {room: rank for rank, rooms in enumerate(ROOMS) for room in rooms}
# The public names of the package are loaded on first use from any room.
FACADE = "__init__"
LAZY = {"h5py", "pxr", "matplotlib", "mpl_toolkits", "tqdm", "scipy", "fiberoripy"}
LAZY_ROOMS = {"output", "progress"}
FOREIGN = {"tests", "tools", "scenes"}
KERNEL_ROOM = "passes"  # the only one with `@wp.kernel` and `wp.launch`
FEWEST_FILES = 40
MOST_LINES = 400


def _files(*folders: str) -> list[Path]:
    found = [path for folder in folders for path in (ROOT / folder).rglob("*.py")]
    return sorted(path for path in found if "__pycache__" not in path.parts)


PACKAGE_FILES = _files("warpfiber")
ALL_FILES = _files("warpfiber", "tests", "tools", "scenes")
DEVICE_FILES = [path for path in PACKAGE_FILES if path.parent.name in ("laws", "passes")]


def _name(path: Path) -> str:
    return str(path.relative_to(ROOT))


@cache
def _tree(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"), str(path))


def _room(path: Path) -> str:
    parts = path.relative_to(PACKAGE).parts
    return parts[0].removesuffix(".py")


def _imports(tree: ast.Module) -> Iterator[tuple[str, int, bool]]:
    """(module, line, whether it runs when the file is imported) of every import."""
    later = [
        node
        for node in ast.walk(tree)
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
        or (isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING")
    ]
    inside = {id(node) for holder in later for node in ast.walk(holder)}
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            if node.level > 0:  # stays in its room (`..` would not: see the test of it)
                continue
            module = node.module or ""
            # `from warpfiber import laws` names the room second
            names = [f"{module}.{alias.name}" for alias in node.names]
            names = names if module == "warpfiber" else [module]
        else:
            continue
        for name in names:
            yield name, node.lineno, id(node) not in inside


def test_the_rules_see_the_package() -> None:
    assert len(PACKAGE_FILES) >= FEWEST_FILES
    assert {_room(path) for path in PACKAGE_FILES} - {FACADE} == set(RANK)


@pytest.mark.parametrize("path", PACKAGE_FILES, ids=_name)
def test_rooms_import_only_rooms_below(path: Path) -> None:
    room = _room(path)
    if room == FACADE:
        return
    wrong = []
    for module, line, _ in _imports(_tree(path)):
        first, *rest = module.split(".")
        if first != "warpfiber":
            continue
        other = rest[0] if rest else FACADE
        allowed = other == room or (other in RANK and RANK[other] < RANK[room])
        if not allowed:
            wrong.append(f"line {line}: {room} must not import {module}")
    assert not wrong, wrong


@pytest.mark.parametrize("path", ALL_FILES, ids=_name)
def test_relative_imports_stay_in_their_room(path: Path) -> None:
    levels = [n.level for n in ast.walk(_tree(path)) if isinstance(n, ast.ImportFrom)]
    assert max(levels, default=0) <= (0 if PACKAGE in path.parents else 1)


@pytest.mark.parametrize("path", PACKAGE_FILES, ids=_name)
def test_package_imports_nothing_beside_it(path: Path) -> None:
    wrong = [(m, line) for m, line, _ in _imports(_tree(path)) if m.split(".")[0] in FOREIGN]
    assert not wrong, wrong


@pytest.mark.parametrize("path", PACKAGE_FILES, ids=_name)
def test_heavy_packages_are_imported_inside_functions(path: Path) -> None:
    found = [
        (module, line, at_import)
        for module, line, at_import in _imports(_tree(path))
        if module.split(".")[0] in LAZY
    ]
    early = [entry for entry in found if entry[2]]
    assert not early, early
    assert not found or _room(path) in LAZY_ROOMS, found


@pytest.mark.parametrize("path", _files("warpfiber/scene"), ids=_name)
def test_scene_needs_the_standard_library_only(path: Path) -> None:
    allowed = sys.stdlib_module_names | {"warpfiber"}
    wrong = [(m, line) for m, line, _ in _imports(_tree(path)) if m.split(".")[0] not in allowed]
    assert not wrong, wrong


@pytest.mark.parametrize("path", _files("tests/reference"), ids=_name)
def test_restatement_needs_numpy_only(path: Path) -> None:
    allowed = sys.stdlib_module_names | {"numpy"}
    wrong = []
    for module, line, _ in _imports(_tree(path)):
        own = module.startswith("tests.reference")
        if not own and module.split(".")[0] not in allowed:
            wrong.append((module, line))
    assert not wrong, wrong


@pytest.mark.parametrize("path", [p for p in DEVICE_FILES if p.parent.name == "laws"], ids=_name)
def test_laws_know_no_arrays_of_the_host(path: Path) -> None:
    wrong = [(m, line) for m, line, _ in _imports(_tree(path)) if m.split(".")[0] == "numpy"]
    assert not wrong, wrong


def _attributes(tree: ast.AST, names: set[str]) -> list[tuple[str, int]]:
    """(name, line) of every `wp.<name>` in code."""
    return [
        (node.attr, node.lineno)
        for node in ast.walk(tree)
        if isinstance(node, ast.Attribute)
        and isinstance(node.value, ast.Name)
        and node.value.id in ("wp", "warp")
        and node.attr in names
    ]


@pytest.mark.parametrize("path", PACKAGE_FILES, ids=_name)
def test_kernels_and_launches_live_in_passes(path: Path) -> None:
    if _room(path) == KERNEL_ROOM:
        return
    kernels = _attributes(_tree(path), {"kernel"})
    assert not kernels, kernels
    launches = _attributes(_tree(path), {"launch", "launch_tiled", "capture_launch"})
    assert not launches, launches


@pytest.mark.parametrize("path", PACKAGE_FILES, ids=_name)
def test_no_atomics(path: Path) -> None:
    names = {n.attr for n in ast.walk(_tree(path)) if isinstance(n, ast.Attribute)}
    assert not [name for name in names if name.startswith("atomic_")]


def _kernels(tree: ast.Module) -> Iterator[ast.FunctionDef]:
    for node in ast.walk(tree):
        if not isinstance(node, ast.FunctionDef):
            continue
        for mark in node.decorator_list:
            call = mark.func if isinstance(mark, ast.Call) else mark
            if isinstance(call, ast.Attribute) and call.attr == "kernel":
                yield node


def _globals(tree: ast.Module) -> set[str]:
    """Names that the module binds at its top level."""
    names: set[str] = set()
    for node in tree.body:
        if isinstance(node, ast.Import | ast.ImportFrom):
            names |= {(alias.asname or alias.name).split(".")[0] for alias in node.names}
        elif isinstance(node, ast.FunctionDef | ast.ClassDef):
            names.add(node.name)
        else:
            names |= {
                n.id
                for n in ast.walk(node)
                if isinstance(n, ast.Name) and isinstance(n.ctx, ast.Store)
            }
    return names


@pytest.mark.parametrize("path", DEVICE_FILES, ids=_name)
def test_no_kernel_argument_is_named_like_a_module_variable(path: Path) -> None:
    # Warp would hash the kernel with the value of that variable: one compilation per value.
    tree = _tree(path)
    taken = _globals(tree)
    wrong = [
        f"{kernel.name}({arg.arg})"
        for kernel in _kernels(tree)
        for arg in kernel.args.args
        if arg.arg in taken
    ]
    assert not wrong, wrong


@pytest.mark.parametrize("path", DEVICE_FILES, ids=_name)
def test_factory_kernels_have_a_module_of_their_own(path: Path) -> None:
    # A factory kernel in a shared module makes Warp rebuild that module for every new variant.
    text = path.read_text(encoding="utf-8")
    if list(_kernels(_tree(path))):
        assert "unique" in text
        assert '"enable_backward": False' in text or "enable_backward=False" in text


@pytest.mark.parametrize("path", ALL_FILES, ids=_name)
def test_files_are_short_and_say_what_they_are(path: Path) -> None:
    lines = path.read_text(encoding="utf-8").count("\n")
    assert lines < MOST_LINES, f"{lines} lines: split it along a noun"
    assert ast.get_docstring(_tree(path)), "no file docstring"


@pytest.mark.parametrize("path", PACKAGE_FILES, ids=_name)
def test_public_functions_have_a_docstring(path: Path) -> None:
    """Host functions and classes that other files can use say what they do."""
    tree = _tree(path)
    holders: list[ast.Module | ast.ClassDef] = [tree]
    holders += [n for n in tree.body if isinstance(n, ast.ClassDef)]
    wrong = [
        f"{node.name} (line {node.lineno})"
        for holder in holders
        if not (isinstance(holder, ast.ClassDef) and holder.name.startswith("_"))
        for node in holder.body
        if isinstance(node, ast.FunctionDef | ast.ClassDef)
        and not node.name.startswith("_")
        and ast.get_docstring(node) is None
    ]
    assert not wrong, wrong


# Spelled in halves, so that this file passes its own rule.
UNFINISHED = re.compile(r"\b(TO" + r"DO|FIX" + r"ME|XX" + r"X)\b")
WORKPLACE = re.compile(r"/(wo" + r"rk|tm" + r"p)/|shared/" + "spec|wa" + "iting for issue")
VAGUE = re.compile(r"^class \w*(Manager|Handler|Helper|Base|Utils?)\b", re.MULTILINE)
TEXT_SUFFIXES = {".py", ".toml", ".md", ".csv", ".json", "", ".cfg", ".yml"}


def _texts() -> list[Path]:
    folders = ("warpfiber", "tests", "tools", "scenes", ".ci", ".github", "docs")
    found = [p for folder in folders for p in (ROOT / folder).rglob("*") if p.is_file()]
    found += [p for p in ROOT.iterdir() if p.is_file()]
    skipped = {"__pycache__", "results"}
    return sorted(p for p in found if p.suffix in TEXT_SUFFIXES and not skipped & set(p.parts))


def test_names_of_test_files_are_unique() -> None:
    """Files of tests are modules without a package: two of a name are not collected together."""
    names = [path.name for path in (ROOT / "tests").rglob("test_*.py")]
    assert len(names) > 100 and len(names) == len(set(names))


def test_no_words_of_the_workplace() -> None:
    wrong = []
    for path in _texts():
        text = path.read_text(encoding="utf-8", errors="replace")
        for pattern in (UNFINISHED, WORKPLACE):
            wrong += [f"{_name(path)}: {match.group(0)}" for match in pattern.finditer(text)]
    assert not wrong, wrong


@pytest.mark.parametrize("path", PACKAGE_FILES, ids=_name)
def test_classes_are_nouns_of_the_theory(path: Path) -> None:
    assert not VAGUE.findall(path.read_text(encoding="utf-8"))


def _raises_rule(source: str) -> list[str]:
    tree = ast.parse(source)
    return [
        arg.arg
        for kernel in _kernels(tree)
        for arg in kernel.args.args
        if arg.arg in _globals(tree)
    ]


def test_the_argument_rule_can_fail() -> None:
    head = "import warp as wp\nreach = 1\n\ndef make():\n    @wp.kernel(module='unique')\n"
    assert _raises_rule(head + "    def sweep(reach: float): pass\n") == ["reach"]
    assert _raises_rule(head + "    def sweep(range: float): pass\n") == []


def test_the_import_rule_can_fail() -> None:
    tree = ast.parse("import h5py\ndef f():\n    from pxr import Usd\nfrom warpfiber import laws\n")
    assert list(_imports(tree)) == [
        ("h5py", 1, True),
        ("warpfiber.laws", 4, True),
        ("pxr", 3, False),
    ]
