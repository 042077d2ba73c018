"""Options of a training run that takes seconds and still does everything."""

TINY = [
    "env=docking2d", "seeds=3", "steps=1280", "episodes=6", "eval_episodes=4", "log_every=4",
    "env.terminal.timeout.limit=40",
    "ppo.num_envs=4", "ppo.num_steps=16", "ppo.num_epochs=2", "agent.hidden=[8]", "checkpoint_every=320", "eval_every=320",
]  # fmt: skip
