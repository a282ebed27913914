"""What people looked at: their fixations in pictures, and whether recordings of them are read as they were made."""

from semfov.human.content import CONTENT_PICTURES, FEWEST_PICTURES, content_suspicions

__all__ = ["CONTENT_PICTURES", "FEWEST_PICTURES", "content_suspicions"]
