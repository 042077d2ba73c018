"""The ids under which Gymnasium finds the tasks; the environments themselves load when one is made."""

from gymnasium.envs.registration import register, registry

IDS = {
    "jaxsafe/Rejoin2D-v0": "rejoin2d",
    "jaxsafe/Rejoin3D-v0": "rejoin3d",
    "jaxsafe/Docking2D-v0": "docking2d",
    "jaxsafe/Docking3D-v0": "docking3d",
    "jaxsafe/Docking2DOriented-v0": "docking2d_oriented",
}
"""Tasks by Gymnasium id."""


def register_ids() -> None:
    """Tell Gymnasium of the tasks; once is enough.

    Without `max_episode_steps`: the tasks end by themselves, and a second clock would truncate what they terminate.
    """
    for name, task in IDS.items():
        if name not in registry:
            register(
                name,
                entry_point="jaxsafe.adapters.gymnasium:GymEnv",
                vector_entry_point="jaxsafe.adapters.gymnasium:GymVectorEnv",
                kwargs={"task": task},
            )
