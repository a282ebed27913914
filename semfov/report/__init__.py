"""HTML pages on which a reader steps through episodes in a browser."""

from semfov.report import gaze as _gaze  # noqa: F401 (predictions are drawn there)
from semfov.report.episode import episode_data
from semfov.report.page import page_html, write_page
from semfov.report.zoom import zoom_data

__all__ = ["episode_data", "page_html", "write_page", "zoom_data"]
