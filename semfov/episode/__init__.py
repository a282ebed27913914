"""Episodes: the loop of active perception, where its looks come from, and the state between two looks."""

from semfov.episode.looks import EpisodeLook, LiveLooks, Looks, StoredLooks
from semfov.episode.loop import Step, rollout
from semfov.episode.memory import Forgetting
from semfov.episode.stopwatch import STAGES

__all__ = [
    "STAGES",
    "EpisodeLook",
    "Forgetting",
    "LiveLooks",
    "Looks",
    "Step",
    "StoredLooks",
    "rollout",
]
