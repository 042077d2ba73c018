"""Agents: what they see, their networks and distributions, policy files, and pilots."""

from jaxsafe.agents.agent import Agent
from jaxsafe.agents.distributions import Categorical, Gaussian, Joint
from jaxsafe.agents.features import (
    ApproachFeatures,
    DockingFeatures,
    FarApproachFeatures,
    FarDirectionsFeatures,
    FarOrientedFeatures,
    Features,
    PlainFeatures,
    RejoinFeatures,
)
from jaxsafe.agents.networks import GRU, MLP, Directional, Network
from jaxsafe.agents.pilot import Pilot
from jaxsafe.agents.policy_file import SavedPolicy, load_policy, read_policy, save_policy
from jaxsafe.agents.trained_policy import TrainedPolicy, TrainedRecurrentPolicy

__all__ = [
    "GRU",
    "MLP",
    "Agent",
    "ApproachFeatures",
    "Categorical",
    "Directional",
    "DockingFeatures",
    "FarApproachFeatures",
    "FarDirectionsFeatures",
    "FarOrientedFeatures",
    "Features",
    "Gaussian",
    "Joint",
    "Network",
    "Pilot",
    "PlainFeatures",
    "RejoinFeatures",
    "SavedPolicy",
    "TrainedPolicy",
    "TrainedRecurrentPolicy",
    "load_policy",
    "read_policy",
    "save_policy",
]
