"""Assemble the pages of the site.

The sources are the same files that people read in the repository. The README is the home page. Files of the repository
that a page links to become pages under `repository/`. The reference is generated from the list of public names, the
tutorials are executed, and names of the package in the text become links to the reference.
"""

import posixpath
import re
import shutil
from pathlib import Path

from docs.api import pages
from docs.site.names import Names

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
HOME = {"README.md": "index.md", "CHANGELOG.md": "changelog.md", "CONTRIBUTING.md": "contributing.md"}
LANGUAGES = {".py": "python", ".sh": "sh", ".yaml": "yaml", ".yml": "yaml", ".txt": "text", ".toml": "toml", "": "text"}
_LINK = re.compile(r"(\]\()([^()\s]+)(\))")
_FENCE = re.compile(r"(?ms)^( *```.*?^ *```$)")
_INTERNALS = """# Internals

Classes and functions that pages of this site mention, but that are not public. They may change with any version.
"""


class Stage:
    """The folder of pages that is rendered.

    Args:
        folder: the folder. Its content is replaced.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.names = Names()
        self.internals: set[str] = set()
        self.missing: list[str] = []
        self._asked: list[str] = []
        self._done: set[str] = set()

    def write(self, place: str, text: str) -> None:
        """Write one page."""
        path = self.folder / place
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")

    def repository(self) -> None:
        """Write the pages of `docs`, the home page, and all files that they link to.

        Raises:
            LookupError: a page links to a file that does not exist, or names something that does not exist.
        """
        shutil.rmtree(self.folder, ignore_errors=True)
        files = [path for kind in ("*.md", "*.png", "*.css") for path in DOCS.rglob(kind)]
        self._asked = [*(path.relative_to(ROOT).as_posix() for path in files), *HOME]
        self._follow()

    def finish(self) -> None:
        """Write the files that other pages link to, the reference, and the page of internals.

        Raises:
            LookupError: a page links to a file that does not exist, or names something that does not exist.
        """
        self._follow()
        for module, text in pages().items():
            self.write(f"api/{module}.md", text)
        inside = "\n\n".join(f"::: {place}\n    options:\n      heading_level: 3" for place in sorted(self.internals))
        self.write("api/internals.md", f"{_INTERNALS}\n{inside}\n")

    def page(self, text: str, file: str) -> str:
        """Convert the links and names of a page to links on the site.

        Args:
            text: the page in Markdown.
            file: its path in the repository.

        Returns:
            The page with links on the site.
        """
        parts = _FENCE.split(text)
        return "".join(part if number % 2 else self._prose(part, file) for number, part in enumerate(parts))

    def _follow(self) -> None:
        while self._asked:
            file = self._asked.pop()
            if file not in self._done:
                self._done.add(file)
                self._put(file)
        if self.missing:
            raise LookupError("\n".join(self.missing))

    def _put(self, file: str) -> None:
        source, place = ROOT / file, place_of(file)
        if source.suffix == ".md":
            self.write(place, self.page(source.read_text(encoding="utf-8"), file))
        elif place.endswith(".md"):
            code = source.read_text(encoding="utf-8").rstrip()
            self.write(place, f"# {file}\n\n````{LANGUAGES[source.suffix]}\n{code}\n````\n")
        else:
            target = self.folder / place
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(source, target)

    def _prose(self, text: str, file: str) -> str:
        def moved(match: re.Match[str]) -> str:
            address, hash_, anchor = match[2].partition("#")
            if not address or re.match(r"[a-z]+:", address):
                return match[0]
            wanted = posixpath.normpath(posixpath.join(posixpath.dirname(file), address))
            if (ROOT / wanted).is_dir():
                wanted = f"{wanted}/index.md"
            if not (ROOT / wanted).is_file():
                self.missing.append(f"{file} links to {match[2]}, which does not exist")
                return match[0]
            if not re.match("docs/tutorials/.*py$", wanted):
                self._asked.append(wanted)
            here = posixpath.dirname(place_of(file)) or "."
            return f"{match[1]}{posixpath.relpath(place_of(wanted), here)}{hash_}{anchor}{match[3]}"

        if file == "CHANGELOG.md":  # it may mention names that were removed
            return _LINK.sub(moved, text)
        try:
            return self.names.link(_LINK.sub(moved, text), self.internals)
        except LookupError as error:
            self.missing.append(f"{file}: {error}")
            return text


def place_of(file: str) -> str:
    """Return the path on the site of a file in the repository.

    Args:
        file: path in the repository.

    Returns:
        The path of its page, relative to the root of the site.

    >>> place_of("docs/guides/gaze.md"), place_of("examples/own_policy.py")
    ('guides/gaze.md', 'repository/examples/own_policy.py.md')
    """
    if file in HOME:
        return HOME[file]
    if file.startswith("docs/"):
        return re.sub(r"^docs/(tutorials/\w+)\.py$", r"\1.md", file).removeprefix("docs/")
    shown = Path(file).suffix in LANGUAGES and Path(file).suffix != ".md"
    return f"repository/{file}.md" if shown else f"repository/{file}"
