"""The profile of a step says which functions its time goes into."""

import importlib
from types import ModuleType

import jax
import jax.numpy as jnp
import pytest

from jaxsafe.simulation.geometry import mag_norm


@pytest.fixture
def hot_spots(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend("benchmarks")
    return importlib.import_module("hot_spots")


def test_a_kernel_counts_for_the_innermost_function_of_jaxsafe(hot_spots: ModuleType) -> None:
    program = jax.jit(jax.vmap(mag_norm)).lower(jnp.ones((8, 3))).compile()

    owners = set(hot_spots.owners(program.as_text()).values())

    assert "simulation.geometry.mag_norm" in owners
    assert all(owner.startswith("simulation.geometry.") for owner in owners)


def test_the_time_of_a_step_is_that_of_its_functions(hot_spots: ModuleType) -> None:
    row = hot_spots.hot_spots("docking2d", num_envs=4, repeats=1)

    spent = row["spent_us"]
    assert sum(spent.values()) == pytest.approx(row["profiled_us"], abs=0.01 * len(spent))
    assert any(name.startswith("simulation.") and value > 0.0 for name, value in spent.items())
