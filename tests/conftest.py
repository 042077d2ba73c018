"""Settings for all tests: two devices, one thread each, and compiled programs kept between runs.

Tests compile far more than they run. So LLVM optimises nothing, which takes up to half of the time
that compilation takes. What must hold bit for bit of programs that are compiled otherwise is
checked in a process without these flags (`own_process`). XLA's older emitter of kernels takes less
time too. Only some versions can choose it, and others stop at an unknown flag.
"""

import gc
import os
from collections.abc import Iterator
from importlib.metadata import version
from pathlib import Path

import pytest

from jaxsafe.devices.seed_mapper import accelerator_installed, claim_cores

emitter = " --xla_cpu_use_fusion_emitters=false" * version("jaxlib").startswith("0.10.")
os.environ.setdefault(
    "XLA_FLAGS",
    f"--xla_force_host_platform_device_count=2 --xla_backend_optimization_level=0{emitter}",
)
claim_cores()

import jax  # noqa: E402

_cache = Path(
    os.environ.get("JAXSAFE_TEST_CACHE", Path(__file__).parent.parent / ".pytest_cache" / "jax")
)
# XLA tunes programs by measuring them, so the programs of another process may round otherwise.
if accelerator_installed():
    _cache /= os.environ.get("PYTEST_XDIST_WORKER", "main")
jax.config.update("jax_compilation_cache_dir", str(_cache))
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)


MAX_MAPS = 40_000
"""Memory maps of a process at which its compiled programs are given up. Linux allows 65,530."""


def pytest_collection_finish() -> None:
    """Leave the modules and tests that stay to the end out of every garbage collection."""
    gc.collect()
    gc.freeze()


@pytest.fixture(autouse=True, scope="module")
def few_memory_maps() -> Iterator[None]:
    """Give compiled programs up before a process has too many memory maps.

    Each program has some, and a long run of one process ended in a segmentation fault.
    """
    yield
    maps = Path("/proc/self/maps")
    if maps.exists() and maps.read_text().count("\n") > MAX_MAPS:
        jax.clear_caches()


@pytest.fixture(scope="session")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the directory of a finished training run that nobody interrupted."""
    from tiny_run import TINY

    from jaxsafe.commands.train import main

    run = tmp_path_factory.mktemp("runs") / "whole"
    assert main([*TINY, f"out={run}"]) == 0
    return run


@pytest.fixture
def x64() -> Iterator[None]:
    """Use double precision in one test. Environments are built inside it."""
    with jax.enable_x64(True):
        yield
