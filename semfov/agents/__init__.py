"""Agents and their episodes: a fovea at a photograph, windows of a large picture, and a head that turns."""

from semfov.agents.episode import Episode
from semfov.agents.fovea import FoveaEpisode
from semfov.agents.head import HeadAgent, HeadEpisode
from semfov.agents.windows import WindowEpisode, ZoomAgent

__all__ = ["Episode", "FoveaEpisode", "HeadAgent", "HeadEpisode", "WindowEpisode", "ZoomAgent"]
