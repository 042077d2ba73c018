"""Training with PPO: one seed as a pure function, or a whole run in a directory.

`jaxsafe.train(env, agent, hyperparameters, key, num_updates)` trains one seed as a pure function,
see `jaxsafe.train.train.train`. `jaxsafe.train("docking2d", seeds=10)` does what `jaxsafe train`
does: it trains all seeds of a run, evaluates them and keeps everything in a directory.
"""

from jaxsafe.schema.callable_package import make_callable

make_callable(
    __name__,
    # As in `__main__.py`, the code that trains a whole run stands on a higher floor.
    "jaxsafe.runs.training",
    Agent="jaxsafe.agents.agent",
    PPO="jaxsafe.train.hyperparameters",
    TrainState="jaxsafe.train.ppo",
    resolve="jaxsafe.train.host.options",
)
