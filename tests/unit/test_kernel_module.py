"""Modules of kernels: compiled with headers that are read once, those already compiled left alone.

The headers are a matter of time alone, so what is asked is whether the compiler used them and
whether the kernels still do what they say.
"""

from __future__ import annotations

import threading
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
import warp as wp

import warpfiber.model  # noqa: F401 (starts Warp)
from warpfiber.passes import headers, kernel_module
from warpfiber.passes.executor import load_kernels


def make_sum(added: int, module: str) -> Any:
    """A kernel that adds a constant to every item."""

    @wp.kernel(module=module, enable_backward=False)
    def add(values: wp.array(dtype=wp.int32)):  # type: ignore[valid-type]
        i = wp.tid()
        values[i] = values[i] + wp.static(added)

    return add


@pytest.fixture
def empty_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty cache of Warp."""
    monkeypatch.setattr(wp.config, "kernel_cache_dir", str(tmp_path))
    return tmp_path


def read_by(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Flags for which a thread reads the headers itself, once the shared ones are there."""
    read: list[str] = []
    build = wp._src.build.build_cpu

    def watched(*arguments: Any, **options: Any) -> None:
        before = set(Path(options["pch_dir"]).glob("*.pch"))
        build(*arguments, **options)
        if set(Path(options["pch_dir"]).glob("*.pch")) != before:
            read.append(options["extra_flags"])

    monkeypatch.setattr(wp._src.build, "build_cpu", watched)
    return read


def test_threads_share_the_headers(empty_cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two threads compile four modules with headers that were read once, for their flags alone."""
    headers.precompiled(headers.lean_flags()).result()
    read = read_by(monkeypatch)
    kernels = [make_sum(k, f"warpfiber_test_shared_{k}") for k in range(4)]
    load_kernels(kernels, "cpu")
    assert read == []
    for added, kernel in enumerate(kernels):
        values = wp.zeros(3, dtype=wp.int32, device="cpu")
        wp.launch(kernel, dim=3, inputs=[values], device="cpu")
        assert values.numpy().tolist() == [added] * 3
        assert kernel.module.options["cpu_compiler_flags"] == headers.lean_flags()


def test_own_flags_are_kept() -> None:
    """A module with flags of its own keeps them, whatever is left out of the headers."""
    own = kernel_module.FUSED["cpu_compiler_flags"]
    assert headers.lean_flags(own) == f"{own} {headers.LEAN}"
    assert headers.lean_flags(headers.lean_flags(own)) == headers.lean_flags(own)


def test_module_in_use_stays_as_it_is(empty_cache: Path) -> None:
    """Captured steps hold the code of a module: it is not compiled again with other flags."""
    kernel = make_sum(1, "warpfiber_test_in_use")
    wp.launch(kernel, dim=1, inputs=[wp.zeros(1, dtype=wp.int32, device="cpu")], device="cpu")
    code = dict(kernel.module.execs)
    load_kernels([kernel], "cpu")
    assert kernel.module.execs == code


def test_without_headers(empty_cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where they could not be read a thread does as Warp does."""
    failed: Future[Path | None] = Future()
    failed.set_result(headers._precompile(empty_cache, "--no-such-flag"))
    assert failed.result() is None
    monkeypatch.setattr(kernel_module, "precompiled", lambda flags: failed)
    load_kernels([kernel := make_sum(5, "warpfiber_test_without")], "cpu")
    assert kernel.module.execs


def test_first_run(empty_cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Headers are read ahead where no module was ever compiled, and only there."""
    asked: list[str] = []
    monkeypatch.setattr(kernel_module, "precompiled", asked.append)
    kernel_module.foresee_modules(kernel_module.FUSED)
    own = kernel_module.FUSED["cpu_compiler_flags"]
    assert asked == [headers.lean_flags(), headers.lean_flags(own)]
    module = make_sum(2, "warpfiber_test_first").module
    assert not headers.is_cached(module)
    module.load("cpu", block_dim=headers.BLOCK)
    assert headers.is_cached(module)
    kernel_module.foresee_modules()
    assert len(asked) == 2


def test_thread_takes_a_copy(empty_cache: Path) -> None:
    """A new thread has the headers before it compiles."""
    ready = headers.precompiled(headers.lean_flags())

    def taken() -> set[str]:
        assert threading.current_thread() is not threading.main_thread()
        headers.take_headers(ready)
        folder = Path(wp._src.context.runtime.get_clang_pch_dir())
        return {header.name for header in folder.glob("*.pch")}

    with ThreadPoolExecutor(max_workers=1) as thread:
        have = thread.submit(taken).result()
    folder = ready.result()
    assert folder is not None
    assert {header.name for header in folder.glob("*.pch")} <= have
    assert len(have) >= 1


def test_longest_first() -> None:
    """What has more text, called functions with it, is longer."""

    @wp.func
    def twice(value: wp.int32) -> wp.int32:
        """A function with more text than the kernels above."""
        doubled = value + value
        return doubled

    @wp.kernel(module="warpfiber_test_longer", enable_backward=False)
    def double(values: wp.array(dtype=wp.int32)):  # type: ignore[valid-type]
        values[wp.tid()] = twice(values[wp.tid()])

    @wp.kernel(module="warpfiber_test_longer", enable_backward=False)
    def redouble(values: wp.array(dtype=wp.int32)):  # type: ignore[valid-type]
        values[wp.tid()] = twice(twice(values[wp.tid()]))

    short = make_sum(1, "warpfiber_test_short").module
    # a function of both once: it is compiled once
    text = len(double.adj.source) + len(redouble.adj.source) + len(twice.adj.source)
    assert kernel_module._length(double.module) == text
    assert kernel_module._length(short) < text
