"""The profile of a step says which functions its time goes into.

A program from JAX's cache does not know where it was traced, so a process without one checks this.
"""

import jax
import jax.numpy as jnp
import pytest
from own_process import check_as_compiled_by_commands

from jaxsafe.simulation.geometry import mag_norm


@pytest.fixture(autouse=True)
def benchmarks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend("benchmarks")


def a_kernel_counts_for_the_innermost_function_of_jaxsafe() -> None:
    from hot_spots import owners

    program = jax.jit(jax.vmap(mag_norm)).lower(jnp.ones((8, 3))).compile()

    found = set(owners(program.as_text()).values())

    assert "simulation.geometry.mag_norm" in found
    assert all(owner.startswith("simulation.geometry.") for owner in found)


def test_a_kernel_counts_for_the_innermost_function_of_jaxsafe() -> None:
    check_as_compiled_by_commands(a_kernel_counts_for_the_innermost_function_of_jaxsafe)


def the_time_of_a_step_is_that_of_its_functions() -> None:
    from hot_spots import hot_spots

    row = hot_spots("docking2d", num_envs=4, repeats=1)

    spent = row["spent_us"]
    assert sum(spent.values()) == pytest.approx(row["profiled_us"], abs=0.01 * len(spent))
    assert any(name.startswith("simulation.") and value > 0.0 for name, value in spent.items())


def test_the_time_of_a_step_is_that_of_its_functions() -> None:
    check_as_compiled_by_commands(the_time_of_a_step_is_that_of_its_functions)
