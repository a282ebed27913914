"""Policies, registered by name: each makes the acquisition function for a target on a grid."""

from semfov.gaze.policies.base import POLICIES, Means, ModelPolicy, Policy, Task, named_policy, policy_names, wanted
from semfov.gaze.policies.exploration import (
    KL,
    Accuracy,
    Closer,
    ConfidenceBound,
    Gain,
    Improvement,
    Negentropy,
    Objects,
    Peaks,
    Surprise,
)
from semfov.gaze.policies.search import (
    EntropyLimitMinimisation,
    FovealHits,
    IdealObserver,
    InformationOnPlace,
    Neighbourhood,
    NonPredictive,
    Predictive,
    Random,
)

__all__ = [
    "KL",
    "POLICIES",
    "Accuracy",
    "Closer",
    "ConfidenceBound",
    "EntropyLimitMinimisation",
    "FovealHits",
    "Gain",
    "IdealObserver",
    "Improvement",
    "InformationOnPlace",
    "Means",
    "ModelPolicy",
    "Negentropy",
    "Neighbourhood",
    "NonPredictive",
    "Objects",
    "Peaks",
    "Policy",
    "Predictive",
    "Random",
    "Surprise",
    "Task",
    "named_policy",
    "policy_names",
    "wanted",
]
