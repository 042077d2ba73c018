"""Training.

`jaxsafe.train(env, agent, hyperparameters, key, num_updates)` trains one seed as a pure function,
see `jaxsafe.train.train.train`. `python -m jaxsafe.train` trains all seeds of a run, evaluates them
and keeps everything in a directory.
"""

from jaxsafe.schema.callable_package import make_callable

make_callable(
    __name__,
    "jaxsafe.train.train",
    Agent="jaxsafe.agents.agent",
    PPO="jaxsafe.train.ppo",
    TrainState="jaxsafe.train.ppo",
    resolve="jaxsafe.train.host.options",
)
