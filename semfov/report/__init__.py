"""HTML pages on which a reader steps through episodes in a browser."""

import sys

from semfov.report import gaze as _gaze  # noqa: F401 (predictions are drawn there)
from semfov.report.page import page_html, write_page
from semfov.words import Room

__all__ = ["page_html", "write_page"]

sys.modules[__name__].__class__ = Room
