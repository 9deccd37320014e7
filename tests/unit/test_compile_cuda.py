"""The reader of CUDA machine code in tools/compile_cuda.py, on kernels whose cost is known."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import warp as wp

from warpfiber.passes.clock import make_clock

TOOL = Path(__file__).parents[2] / "tools" / "compile_cuda.py"


def _tool() -> ModuleType:
    spec = importlib.util.spec_from_file_location("compile_cuda", TOOL)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["compile_cuda"] = module
    spec.loader.exec_module(module)
    return module


tool = _tool()
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
    monkeypatch.setattr(tool, "kernels", lambda _: [("scale", "plain", scale)])
    costs, failures = tool.compile_all((80, 90), Path("nowhere"))
    assert not costs
    assert failures == ["scale (float32 plain): 0 files for 2 architectures"]


def test_every_pass_is_compiled_in_both_precisions() -> None:
    from warpfiber.passes.cells import ListFeatures, make_cell_kernels
    from warpfiber.passes.chain_blocks import make_end_kernels
    from warpfiber.passes.check_sweeps import CheckFeatures, make_check_sweeps
    from warpfiber.passes.contact_verdict import make_contact_verdict
    from warpfiber.passes.list_bound import make_list_bound
    from warpfiber.passes.row_count import RowFeatures, make_row_count
    from warpfiber.passes.rows import make_row_kernels

    features = ListFeatures((True, True, True))
    listed = make_cell_kernels("float32", features) | make_row_kernels("float32", features)
    contact = {
        *make_row_count("float32", RowFeatures()),
        *make_check_sweeps("float32", CheckFeatures()),
        *make_list_bound("float32"),
        *make_contact_verdict(),
        *make_end_kernels("float32"),
        *("pair_motion fill_rows dual_begin dual_lists dual_step dual_balance fold_sums".split()),
        *("rod_response rod_apply chain_moves chain_response chain_apply".split()),
        *("lay_on take_off note_load keep_load set_pace".split()),
    }
    names = {kernel for kernel, _, _ in tool.kernels("float32")}
    assert names == {
        *("clock_step node_sweep pair_sweep measure_fibers measure_pairs measure_terms".split()),
        *("step_begin chain_step carry_fibers largest_error step_end take_back".split()),
        *("rod_maps rod_step".split()),
        *("bond_sweep bond_drift keep_memory carry_memory capsule_pairs".split()),
        *("measure_bonds".split()),
        *("move_walls sum_pushes meter_walls steer_wall sum_grips meter_grips".split()),
        *("bond_losses contact_energy measure_layers drag_moments contact_moments".split()),
        *listed,
        *contact,
    }
    assert tool.PRECISIONS == ("float32", "float64")
    assert make_clock("float32", False, False) in [made for *_, made in tool.kernels("float32")]
