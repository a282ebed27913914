"""Put the pages of the site together.

Pages come from where they are read without a site, too: the README is the home page, and what pages link to elsewhere
in the repository becomes a page under `repository/`. The reference is made from the public surface, tutorials are
executed, and names of the package in the text become links to where they are explained.
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
_INTERNALS = """# Inside

What pages of this site name and what is not public: it may change with any version.
"""


class Stage:
    """The pages in the folder that is rendered.

    Args:
        folder: where to; what is there is replaced.
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
        """The pages of `docs` and the home page, and what they lead to.

        Raises:
            LookupError: a page links to a file that is not there, or names something that does not exist.
        """
        shutil.rmtree(self.folder, ignore_errors=True)
        files = [path for kind in ("*.md", "*.png", "*.css") for path in DOCS.rglob(kind)]
        asked = [path.relative_to(ROOT).as_posix() for path in files if path.name != "results.template.md"]
        self._asked = [*asked, *HOME]
        self._follow()

    def finish(self) -> None:
        """What other pages lead to, the reference, and what pages name beyond it.

        Raises:
            LookupError: as for `repository`.
        """
        self._follow()
        for module, text in pages().items():
            self.write(f"api/{module}.md", text)
        inside = "\n\n".join(f"::: {place}\n    options:\n      heading_level: 3" for place in sorted(self.internals))
        self.write("api/internals.md", f"{_INTERNALS}\n{inside}\n")

    def page(self, text: str, file: str) -> str:
        """A page with its links and names leading to places on the site; `file` is where it lies in the repository."""
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
                self.missing.append(f"{file} links to {match[2]}, which is not there")
                return match[0]
            if not re.match("docs/tutorials/.*py$", wanted):
                self._asked.append(wanted)
            here = posixpath.dirname(place_of(file)) or "."
            return f"{match[1]}{posixpath.relpath(place_of(wanted), here)}{hash_}{anchor}{match[3]}"

        if file == "CHANGELOG.md":  # it names what is no more, too
            return _LINK.sub(moved, text)
        try:
            return self.names.link(_LINK.sub(moved, text), self.internals)
        except LookupError as error:
            self.missing.append(f"{file}: {error}")
            return text


def place_of(file: str) -> str:
    """Where a file of the repository is on the site.

    >>> place_of("docs/guides/gaze.md"), place_of("examples/own_policy.py")
    ('guides/gaze.md', 'repository/examples/own_policy.py.md')
    """
    if file in HOME:
        return HOME[file]
    if file.startswith("docs/"):
        return re.sub(r"^docs/(tutorials/\w+)\.py$", r"\1.md", file).removeprefix("docs/")
    shown = Path(file).suffix in LANGUAGES and Path(file).suffix != ".md"
    return f"repository/{file}.md" if shown else f"repository/{file}"
