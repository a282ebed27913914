"""Agents and their episodes: a fovea at a photograph, windows of a large picture, and a head that turns."""

from semfov.agents.head import HeadAgent
from semfov.agents.windows import ZoomAgent

__all__ = ["HeadAgent", "ZoomAgent"]
