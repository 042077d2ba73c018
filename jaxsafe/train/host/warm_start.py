"""The agent of the run or of the policy file that a training starts from."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from jaxsafe.agents.policy_file import (
    PRETRAINED,
    find_policy,
    is_single,
    meant_policy,
    read_policy,
    with_networks,
)
from jaxsafe.schema.convert import to_data
from jaxsafe.schema.errors import ConfigError
from jaxsafe.schema.user_modules import import_modules
from jaxsafe.train.host.run_config import read_content

OPTIONS = (
    "actor",
    "critic",
    "features",
    "controller",
    "critic_sees_totals",
    "cost_critic",
    "cost_names",
)
"""Options of the agent that decide which parameters it has, and what these mean."""


def agent_options(source: str) -> dict[str, Any]:
    """Return the options of the agent that a training must share with what it starts from.

    Args:
        source: a run directory, a policy file, or `pretrained/` and the name of a task.

    Returns:
        The options by dotted path, for instance `{"agent.features": {"type": "approach"}}`.

    Raises:
        ConfigError: there is no such run or policy.
    """
    if is_single(source):
        agent = to_data(read_policy(find_policy(source)).agent)
    else:
        file = Path(source) / "config.yaml"
        if not file.is_file():
            meant = meant_policy(source) or ""
            hint = f". Did you mean {meant!r}?" if meant.startswith(PRETRAINED) else ""
            raise ConfigError(
                f"from: no run in {source!r} (a directory with config.yaml) "
                f"and no policy file{hint}"
            )
        content = read_content(Path(source))
        # The environment names the modules in which the agent's parts are too.
        import_modules(content["environment"].get("imports", []), f"{file}: environment")
        agent = with_networks(content["training"].get("agent"))
        if not isinstance(agent, dict):
            raise ConfigError(f"from: {file} has no agent")
    return {f"agent.{name}": agent[name] for name in OPTIONS if name in agent}
