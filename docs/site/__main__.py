"""Build the site from the repository, without a network and with warnings as errors: `python -m docs.site`.

Pages are put together in `build/pages` and become HTML in `build/site`, by Zensical. `mkdocs.yml` is its configuration;
Material for MkDocs, which it succeeds, reads the same file.
"""

import argparse
import re
import subprocess
import sys
import time

from docs.site.stage import ROOT, Stage
from docs.site.tutorials import tutorials

PAGES = ROOT / "build" / "pages"
SITE = ROOT / "build" / "site"
_COMPLAINT = re.compile(r"(?im)^.*(?:warning|griffe:|error).*$")
"""What is said of docstrings, too, which the strict mode lets pass."""


def build(*, run: bool) -> None:
    """Put the pages together and render them.

    Args:
        run: execute the tutorials.

    Raises:
        LookupError: a page leads to what is not there.
        ValueError: a tutorial warned, or rendering did.
    """
    began = time.monotonic()
    stage = Stage(PAGES)
    stage.repository()
    for name, text in tutorials(PAGES / "tutorials", stage.page, run=run).items():
        stage.write(f"tutorials/{name}.md", text)
    stage.finish()
    print(f"pages: {time.monotonic() - began:.0f} s")
    call = [sys.executable, "-m", "zensical", "build", "--clean", "--strict"]
    done = subprocess.run(call, cwd=ROOT, capture_output=True, text=True, check=False)
    said = re.sub(r"\x1b\[[0-9;]*m", "", done.stdout + done.stderr)
    if done.returncode or _COMPLAINT.search(said):
        raise ValueError(f"the site has warnings\n{said}")
    print(f"written: {SITE / 'index.html'}, {time.monotonic() - began:.0f} s in all")


def main() -> int:
    """The command."""
    parser = argparse.ArgumentParser(prog="python -m docs.site", description=__doc__.splitlines()[0])
    parser.add_argument("--skip-tutorials", action="store_true", help="show them without what they print and draw")
    try:
        build(run=not parser.parse_args().skip_tutorials)
    except (LookupError, ValueError) as error:
        print(error, file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
