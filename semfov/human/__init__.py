"""What people looked at: whether recordings of their fixations are read as they were made."""

from semfov.human.content import CONTENT_PICTURES, FEWEST_PICTURES, content_suspicions

__all__ = ["CONTENT_PICTURES", "FEWEST_PICTURES", "content_suspicions"]
