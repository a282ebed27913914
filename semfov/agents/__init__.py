"""Agents for scenes larger than a detector's input: windows of a large picture, and a head that turns."""

from semfov.agents.head import HeadAgent
from semfov.agents.windows import ZoomAgent

__all__ = ["HeadAgent", "ZoomAgent"]
