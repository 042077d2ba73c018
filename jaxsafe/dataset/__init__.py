"""Data for offline reinforcement learning: steps that policies have taken, with costs by name."""

from jaxsafe.dataset.collect import Dataset, collect, collect_from_each, random_policy
from jaxsafe.dataset.files import load_dataset, save_dataset, save_minari

__all__ = [
    "Dataset",
    "collect",
    "collect_from_each",
    "load_dataset",
    "random_policy",
    "save_dataset",
    "save_minari",
]
