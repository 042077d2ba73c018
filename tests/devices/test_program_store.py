"""Programs in files: found by what they are made from, refused if anything else can be in them."""

import itertools
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any
from unittest.mock import Mock

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tiny_run import TINY, logs

import jaxsafe
from jaxsafe.devices import program_store
from jaxsafe.devices.background_compile import CompiledInBackground
from jaxsafe.devices.program_store import (
    compile_anew,
    only_installed_code,
    program_file,
    read,
    save,
)

PACKAGE = Path(jaxsafe.__file__).parent


@pytest.fixture
def installed(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """Return an empty directory of programs, for code that counts as installed."""
    monkeypatch.setattr(program_store, "only_installed_code", lambda: True)
    monkeypatch.setattr(program_store, "_directory", lambda: tmp_path)
    return tmp_path


NEW = itertools.count(1.0 + time.time() % 1.0)
"""Numbers that make programs new ones. Those in JAX's cache cannot be stored."""


def stored(path: Path, function: Callable[[jax.Array], Any] = lambda x: x) -> Path:
    new = next(NEW)
    lowered = jax.jit(lambda x: function(new * x)).lower(jnp.arange(3.0))
    compiled, is_new = compile_anew(lowered)
    assert is_new
    save(path, lowered, compiled, lowered.out_info)
    return path


def test_a_program_that_was_stored_is_not_traced(installed: Path) -> None:
    traces = []
    new = next(NEW)

    @jax.jit
    def traced(x: jax.Array) -> jax.Array:
        traces.append(x)
        return new * x

    x = jnp.arange(3.0)
    first = CompiledInBackground(traced, x, made_from="2 x")
    file = program_file("2 x", (x,))
    assert file is not None
    expected = first(x)
    while not file.exists():
        time.sleep(0.01)
    jax.clear_caches()
    again = CompiledInBackground(traced, x, made_from="2 x")
    np.testing.assert_array_equal(again(x), expected)
    assert len(traces) == 1
    assert again.result_shapes == first.result_shapes
    assert again.footprint() == first.footprint() > 0
    assert [*installed.iterdir()] == [file]


def test_a_stored_program_that_cannot_be_used_is_compiled_again(
    installed: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    x = jnp.arange(3.0)
    file = program_file("3 x", (x,))
    assert file is not None
    stored(file)
    fault = Mock(side_effect=RuntimeError("another processor"))
    monkeypatch.setattr(program_store.serialize_executable, "deserialize_and_load", fault)
    again = CompiledInBackground(jax.jit(lambda x: 3.0 * x), x, made_from="3 x")
    np.testing.assert_array_equal(again(x), 3.0 * x)
    fault.assert_called_once()


def test_other_words_shapes_and_surroundings_are_other_programs(
    installed: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    x = jnp.arange(3.0)
    names = {
        program_file("a", (x,)),
        program_file("b", (x,)),
        program_file("a", (jnp.arange(4.0),)),
        program_file("a", (jnp.arange(3),)),
    }
    monkeypatch.setattr(program_store, "_surroundings", lambda: "another source")
    names.add(program_file("a", (x,)))
    assert len(names) == 5
    assert None not in names


def test_a_source_that_changed_changes_the_surroundings(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source = tmp_path / "dynamics.py"
    source.write_text("MEAN_MOTION = 0.001027")
    monkeypatch.setattr(program_store, "PACKAGE", tmp_path)
    surroundings = program_store._surroundings.__wrapped__
    before = surroundings()
    assert surroundings() == before
    source.write_text("MEAN_MOTION = 0.001028")
    assert surroundings() != before


def test_a_module_of_the_user_keeps_programs_from_being_stored(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    own = ModuleType("my_parts")
    monkeypatch.setattr(sys, "modules", {"__main__": sys.modules["jaxsafe"], "numpy": np})
    assert only_installed_code()
    monkeypatch.setitem(sys.modules, "my_parts", own)
    for place in (tmp_path / "my_parts.py", PACKAGE.with_name("jaxsafe_mine.py")):
        own.__file__ = str(place)
        assert not only_installed_code()
    for place in ("_ops.py", os.path.join(jax.__file__, "inside_an_archive.py")):
        own.__file__ = place
        assert only_installed_code()
        program_store._surroundings.__wrapped__()
    for place in (None, "<stdin>"):
        main = ModuleType("__main__")
        main.__file__ = place
        monkeypatch.setattr(sys, "modules", {"__main__": main})
        assert not only_installed_code()


def test_a_file_that_is_not_whole_is_no_program(tmp_path: Path) -> None:
    file = stored(tmp_path / "program")
    assert read(file) is not None
    content = file.read_bytes()
    for spoilt in (content[:-1], content[:20], b"", content[:-1] + bytes([content[-1] ^ 1])):
        file.write_bytes(spoilt)
        assert read(file) is None
    assert read(tmp_path / "missing") is None


def test_a_program_in_the_cache_of_jax_is_not_stored() -> None:
    """XLA writes a file of such a program, but it cannot be called."""
    before = jax.config.jax_persistent_cache_min_compile_time_secs  # pyright: ignore[reportAttributeAccessIssue]
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    try:
        found = []
        new = next(NEW)
        for _ in range(2):
            lowered = jax.jit(lambda x: new - x).lower(jnp.arange(3.0))
            found.append(compile_anew(lowered)[1])
            jax.clear_caches()
        assert found == [True, False]
    finally:
        jax.config.update("jax_persistent_cache_min_compile_time_secs", before)


def test_a_program_that_calls_another_library_than_lapack_is_not_stored(tmp_path: Path) -> None:
    def printed(x: jax.Array) -> jax.Array:
        jax.debug.print("{}", x)
        return x

    assert not stored(tmp_path / "program", printed).exists()


def test_a_process_that_has_traced_nothing_runs_a_program_with_lapack(tmp_path: Path) -> None:
    """JAX registers LAPACK's functions when it lowers them. Unknown functions crash."""
    file = stored(tmp_path / "program", lambda x: jnp.linalg.qr(x[:, None]))
    code = (
        "import numpy as np; from pathlib import Path; from jaxsafe.devices import program_store; "
        f"program = program_store.read(Path({str(file)!r})).load(); "
        "q, r = program(np.arange(3, dtype=np.float32)); "
        "assert r.shape == (1, 1); np.testing.assert_allclose(q.T @ q, 1.0, rtol=1e-6)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_the_programs_used_longest_ago_go_first(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(program_store, "MAX_PROGRAMS", 2)
    for age, name in ((30, "first"), (20, "second")):
        file = stored(tmp_path / name)
        used = file.stat().st_mtime - age
        os.utime(file, (used, used))
    read(tmp_path / "first")
    stored(tmp_path / "third")
    assert sorted(file.name for file in tmp_path.iterdir()) == ["first", "third"]


@pytest.mark.thorough
def test_a_second_run_takes_its_programs_and_a_changed_source_does_not(tmp_path: Path) -> None:
    """A run with stored programs is bit for bit the run that compiled them."""
    copy = tmp_path / "sources" / "jaxsafe"
    for name in ("jaxsafe", "configs"):
        shutil.copytree(PACKAGE.parent / name, copy.parent / name)
    environment = {
        **os.environ,
        "PYTHONPATH": str(copy.parent),
        "JAX_COMPILATION_CACHE_DIR": str(tmp_path / "cache"),
    }

    def trained(name: str) -> dict[str, list[dict[str, Any]]]:
        call = [sys.executable, "-m", "jaxsafe.train", *TINY, f"out={name}"]
        subprocess.run(call, cwd=tmp_path, env=environment, check=True, capture_output=True)
        return logs(tmp_path / name)

    def programs() -> set[str]:
        return {file.name for file in (tmp_path / "cache" / "programs").iterdir()}

    (tmp_path / "cache").mkdir()
    first = trained("first")
    before = programs()
    assert len(before) == 5
    assert trained("second") == first
    assert programs() == before
    source = copy / "train" / "shuffle.py"
    source.write_text(source.read_text().replace("ROUNDS = 24", "ROUNDS = 23"))
    assert trained("third") != first
    assert programs() > before
