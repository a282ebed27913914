"""Agents and their episodes, for each kind of look: a fovea, windows of a picture, and a head that turns."""

from semfov.agents.head import HeadAgent
from semfov.agents.windows import ZoomAgent

__all__ = ["HeadAgent", "ZoomAgent"]
