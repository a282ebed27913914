"""Build the site from the repository, without a network and with warnings as errors: `python -m docs.site`.

The pages are assembled in `build/pages`. Zensical renders them to HTML in `build/site`. Its configuration is
`mkdocs.yml`, which its predecessor, Material for MkDocs, can read as well. With `REPOSITORY_URL` in the
environment, each page links to it.
"""

import argparse
import os
import re
import subprocess
import sys
import time
from pathlib import Path

from docs.site.llms import contents
from docs.site.search_index import put_pages_first
from docs.site.stage import ROOT, Stage
from docs.site.tutorials import tutorials
from semfov.version import __version__

PAGES = ROOT / "build" / "pages"
SITE = ROOT / "build" / "site"
_COMPLAINT = re.compile(r"(?im)^.*(?:warning|griffe:|error).*$")
"""Matches all messages, among them complaints about docstrings, which the strict mode ignores."""


def render(folder: Path) -> subprocess.CompletedProcess[str]:
    """Render the pages by the `mkdocs.yml` of a folder; the foot of each page has version and licence."""
    call = [sys.executable, "-m", "zensical", "build", "--clean", "--strict"]
    settings = {**os.environ, "SITE_FOOT": f"semfov {__version__}, MIT licence"}
    return subprocess.run(call, cwd=folder, env=settings, capture_output=True, text=True, check=False)


def build(*, run: bool) -> None:
    """Assemble the pages and render them.

    Args:
        run: execute the tutorials.

    Raises:
        LookupError: a page has a broken link, or names something that does not exist.
        ValueError: a tutorial or the rendering gave a warning.
    """
    began = time.monotonic()
    stage = Stage(PAGES)
    stage.repository()
    for name, text in tutorials(PAGES / "tutorials", stage.page, run=run).items():
        stage.write(f"tutorials/{name}.md", text)
    stage.finish()
    stage.write("llms.txt", contents((ROOT / "mkdocs.yml").read_text(encoding="utf-8"), PAGES))
    print(f"pages: {time.monotonic() - began:.0f} s")
    done = render(ROOT)
    output = re.sub(r"\x1b\[[0-9;]*m", "", done.stdout + done.stderr)
    if done.returncode or _COMPLAINT.search(output):
        raise ValueError(f"expected the site to build without warnings, got\n{output}")
    put_pages_first(SITE / "search.json")
    print(f"written: {SITE / 'index.html'}, {time.monotonic() - began:.0f} s in all")


def main() -> int:
    """Run the command and return its exit code."""
    parser = argparse.ArgumentParser(prog="python -m docs.site", description=__doc__.splitlines()[0])
    parser.add_argument(
        "--skip-tutorials", action="store_true", help="do not execute the tutorials; show them without output"
    )
    try:
        build(run=not parser.parse_args().skip_tutorials)
    except (LookupError, ValueError) as error:
        print(error, file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
