"""HTML pages on which a reader steps through episodes in a browser."""

import sys

from semfov.attribute_words import Room
from semfov.report import gaze as _gaze  # noqa: F401 (predictions are drawn there)
from semfov.report.page import page_html, write_page

__all__ = ["page_html", "write_page"]

sys.modules[__name__].__class__ = Room
