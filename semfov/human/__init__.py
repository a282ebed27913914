"""Fixations of people in pictures, checks of their recordings, and measures that compare scanpaths."""

from semfov.human.content import CONTENT_PICTURES, FEWEST_PICTURES, content_suspicions

__all__ = ["CONTENT_PICTURES", "FEWEST_PICTURES", "content_suspicions"]
