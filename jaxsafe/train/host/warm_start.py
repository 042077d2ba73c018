"""What a training starts from: the agent of a run or of a policy file."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from jaxsafe.agents.policy_file import find_policy, is_single, read_policy, with_networks
from jaxsafe.schema import yaml12
from jaxsafe.schema.convert import to_data
from jaxsafe.schema.errors import ConfigError

OPTIONS = ("actor", "critic", "features", "critic_sees_totals", "cost_critic")
"""Options of the agent that decide which parameters it has and what they mean."""


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
            raise ConfigError(
                f"from: no run in {source!r} (a directory with config.yaml) and no policy file"
            )
        content = yaml12.read(file)
        training = content.get("training") if isinstance(content, dict) else None
        agent = with_networks(training.get("agent")) if isinstance(training, dict) else None
        if not isinstance(agent, dict):
            raise ConfigError(f"from: {file} is not that of a run")
    return {f"agent.{name}": agent[name] for name in OPTIONS if name in agent}
