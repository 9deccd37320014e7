"""The reader of CUDA machine code in tools/compile_cuda.py, on kernels whose cost is known."""

from __future__ import annotations

import ast
import importlib
import inspect
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import warp as wp

from warpfiber.laws.contact_compliance import LAWS
from warpfiber.passes.clock import make_clock

TOOLS = Path(__file__).parents[2] / "tools"
PASSES = Path(__file__).parents[2] / "warpfiber" / "passes"
# Factories of kernels that only the CPU runs: they hold explicit vectors, or work in sequence.
CPU_ONLY = {
    *("make_native_bond_sweep make_native_capsule_pairs make_native_node_sweep".split()),
    *("make_native_pair_sweep make_near_pairs make_search_kernels make_sort_kernels".split()),
    *("make_native_prune make_native_chain make_chain_relaxation make_rod_relaxation".split()),
    *("crew_kernels meet_kernel look_kernel stealing_kernel make_native_strays".split()),
    *("make_native_rod_step make_native_rod_apply make_native_row_fill make_native_check".split()),
}
# What a flag of this name may be, where it is more than whether something is there.
CHOICES: dict[str, set[Any]] = {
    "lubrication": {"none", "paper", "shifted"},
    "closure": {"none", "paper", "consistent"},
    "pairs": {"none", "closest", "arms"},
    "law": set(LAWS),
}
# "filled", "picked": by vectors, which CUDA has not
NO_FLAGS = {"name", "module", "native", "chi", "axis", "filled", "picked"}


def _module(name: str) -> ModuleType:
    """A module of tools/, whose files import each other as scripts do."""
    sys.path.insert(0, str(TOOLS))
    try:
        return importlib.import_module(name)
    finally:
        sys.path.remove(str(TOOLS))


tool = _module("compile_cuda")
listed = _module("cuda_variants")
pytestmark = pytest.mark.skipif(
    sys.platform == "darwin", reason="Warp for macOS comes without a CUDA compiler"
)


@wp.kernel(module="unique", enable_backward=False, grid_stride=False)
def scale(factor: wp.float32, values: wp.array(dtype=wp.float32)):  # type: ignore[valid-type]
    i = wp.tid()
    values[i] = factor * values[i]


@wp.kernel(module="unique", enable_backward=False, grid_stride=False)
def pick(places: wp.array(dtype=wp.int32), values: wp.array(dtype=wp.float32)):  # type: ignore[valid-type]
    """An array of the thread that is indexed by data cannot live in registers."""
    i = wp.tid()
    row = wp.vector(length=64, dtype=wp.float32)
    for k in range(64):
        row[places[k]] = values[k]
    values[i] = row[places[i]]


@pytest.fixture(scope="module")
def cubin(tmp_path_factory: pytest.TempPathFactory) -> Any:
    folder = tmp_path_factory.mktemp("cubin")

    def compiled(kernel: Any) -> Path:
        paths = wp.compile_aot_module(kernel.module, arch=80, module_dir=folder, use_ptx=False)
        return Path(paths[0])

    return compiled


def test_a_kernel_that_fits_has_no_frame(cubin: Any) -> None:
    cost = tool.read_cost(cubin(scale), "scale", "", 80)
    assert cost.frame == 0
    assert 2 <= cost.registers <= 32
    assert tool.frame_faults([cost]) == []


def test_a_kernel_that_does_not_fit_is_a_fault(cubin: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    cost = tool.read_cost(cubin(pick), "pick", "", 80)
    assert cost.frame >= 64 * 4
    (fault,) = tool.frame_faults([cost])
    assert "pick" in fault and str(cost.frame) in fault
    monkeypatch.setitem(tool.FRAMES, "pick", (cost.frame, "its array is indexed by data"))
    assert tool.frame_faults([cost]) == []


def test_what_is_no_cubin_is_refused() -> None:
    with pytest.raises(ValueError, match="ELF"):
        tool.CudaElf(b"PTX, not ELF" + bytes(100))


def test_a_kernel_without_cubin_is_a_failure(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(wp, "compile_aot_module", lambda *_, **__: [])
    monkeypatch.setattr(tool, "_modules", lambda: [("scale", "float32", scale)])
    costs, failures = tool.compile_all((80, 90), Path("nowhere"))
    assert not costs
    assert failures == ["scale (float32): 0 files for 2 architectures"]


def _factories() -> set[str]:
    """Names of all functions of the passes that make kernels."""
    found = set()
    for path in PASSES.glob("*.py"):
        for node in ast.parse(path.read_text()).body:
            if not isinstance(node, ast.FunctionDef):
                continue
            inner = [n for n in ast.walk(node) if isinstance(n, ast.FunctionDef) and n is not node]
            if any("wp.kernel" in ast.unparse(d) for n in inner for d in n.decorator_list):
                found.add(node.name)
    return found


def test_every_kernel_that_cuda_runs_is_compiled() -> None:
    """In both precisions, where it has one."""
    named: dict[str, set[str]] = {}
    for precision, (factory, _) in listed.variants():
        named.setdefault(factory.__name__, set()).add(precision)
    assert set(named) | CPU_ONLY == _factories()
    assert not set(named) & CPU_ONLY
    assert all(names in ({"float32", "float64"}, {""}) for names in named.values())
    made = [kernel for *_, kernel in listed.kernels()]
    assert make_clock("float64", True, True) in made
    assert {kernel.module.name for kernel in made} == {
        row[2].module.name for row in tool._modules()
    }


def _flags(factory: Any, arguments: tuple[Any, ...], precise: bool) -> dict[str, Any]:
    """Value of every flag of one variant; of features every field."""
    bound = inspect.signature(factory).bind(*(["float32"] if precise else []), *arguments)
    bound.apply_defaults()
    flags: dict[str, Any] = {}
    for name, value in bound.arguments.items():
        fields = getattr(value, "__dataclass_fields__", {})
        flags |= {field: getattr(value, field) for field in fields} or {name: value}
    return {name: value for name, value in flags.items() if name not in NO_FLAGS}


def test_every_flag_takes_each_of_its_values() -> None:
    """A choice each of its words; else there is something in one variant, nothing in another."""
    seen: dict[tuple[str, str], set[Any]] = {}
    for precision, (factory, arguments) in listed.variants():
        for name, value in _flags(factory, arguments, bool(precision)).items():
            if isinstance(value, tuple):
                value = any(number is not False for number in value)
            elif not isinstance(value, str):
                value = value not in (False, None, -1)
            seen.setdefault((factory.__name__, name), set()).add(value)
    assert len(seen) > 60
    for (factory, name), values in seen.items():
        wanted = CHOICES[name] if {str} & set(map(type, values)) else {True, False}
        assert values == wanted, (factory, name, wanted - values)


def test_table_is_aligned() -> None:
    costs = [tool.Cost("scale", "float32", 80, 8, 0, 3000), tool.Cost("k", "a b c", 90, 9, 40, 1)]
    first, *lines = tool.table(costs)
    assert {len(line) for line in lines} == {len(first)}
    assert [line.split()[-3:] for line in lines] == [["8", "0", "3.0"], ["9", "40", "0.0"]]
