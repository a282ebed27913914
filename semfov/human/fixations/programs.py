"""Programs of eye trackers, and the columns of the tables that they export."""

import re
import unicodedata
from collections.abc import Sequence
from typing import Literal, NamedTuple

Units = Literal["pixels", "fractions"]
"""Unit of the coordinates of a table: pixels, whose centres are at integers, or fractions of the sides of the frame."""

Origin = Literal["top left", "bottom left", "centre", "centre, y up"]
"""Where the coordinates of a table are 0. y points down from the top left and from the centre, else up."""

LENGTHS: dict[str, Units] = {
    **dict.fromkeys(("px", "pixel", "pixels", "pix"), "pixels"),
    **dict.fromkeys(("norm", "normalized", "normalised", "fraction", "fractions"), "fractions"),
}
"""Units of points by the words in the names of columns."""

TIMES = {
    **dict.fromkeys(("s", "sec", "secs", "second", "seconds"), 1000.0),
    **dict.fromkeys(("ms", "msec", "millisecond", "milliseconds"), 1.0),
    **dict.fromkeys(("us", "μs", "usec", "μsec", "microsecond", "microseconds"), 1e-3),
    **dict.fromkeys(("ns", "nsec", "nanosecond", "nanoseconds"), 1e-6),
}
"""Milliseconds of a unit of time by the words in the names of columns."""

_OTHER_UNITS = (
    *("mm", "cm", "m", "in", "inch", "inches"),
    *("deg", "degree", "degrees", "visual degrees", "degrees of visual angle", "dva", "°", "rad"),
    *("min", "mins", "minutes", "h", "hours", "frames", "samples", "%", "percent"),
)
"""Units that are known, but not read."""

# How a name ends in a unit: in brackets, perhaps after the frame, or after an underscore.
_BRACKET = re.compile(r"[\[(]([^\])]*)[\])]\s*$")
_ENDING = re.compile(r"[_ ](px|norm|ms|msec|us|[\u00b5\u03bc]s|ns)$", re.IGNORECASE)  # with both signs of micro
_FRAME = re.compile(r"^(mcs|dacs|ucs|hucs|rcs)\s*")


class Column(NamedTuple):
    """A column of a table, with the frame and unit in its name, as in `Fixation point X [MCS px]`.

    Words in brackets that are no unit are part of the name, as in `x (screen)`.

    Attributes:
        name: as the table has it.
        key: the name without case, spaces, signs, frame and unit.
        frame: `mcs` (the picture), `dacs` (the screen), or nothing.
        unit: such as `px`, `ms` or `μs`, or nothing.

    >>> Column.of("Fixation point X [MCS px]")
    Column(name='Fixation point X [MCS px]', key='fixationpointx', frame='mcs', unit='px')
    """

    name: str
    key: str
    frame: str
    unit: str

    @classmethod
    def of(cls, name: str) -> "Column":
        """Split the name of a column into its key, frame and unit.

        Args:
            name: as the table has it.

        Returns:
            The column.
        """
        end = _BRACKET.search(name) or _ENDING.search(name)
        if end is None:
            return cls(name, key_of(name), "", "")
        frame = ""
        unit = unicodedata.normalize("NFKC", end[1]).lower().strip().removeprefix("in ")  # two signs are micro
        if prefix := _FRAME.match(unit):
            frame = prefix[1]
            unit = unit[prefix.end() :]
        if unit and unit not in (*LENGTHS, *TIMES, *_OTHER_UNITS):
            return cls(name, key_of(name), "", "")
        return cls(name, key_of(name[: end.start()]), frame, unit)

    @property
    def length(self) -> Units | None:
        """Unit of a coordinate or side: pixels if the name has none, None if the unit is unknown."""
        return LENGTHS.get(self.unit) if self.unit else "pixels"

    @property
    def milliseconds(self) -> float | None:
        """Milliseconds in the unit of a duration: 1 if the name has no unit, None if the unit is unknown."""
        return TIMES.get(self.unit) if self.unit else 1.0


def key_of(name: str) -> str:
    """Compute the key of a column's name: its letters and digits, in lower case.

    >>> key_of("Fixation point X")
    'fixationpointx'
    """
    return re.sub(r"[^a-z0-9]", "", name.lower())


class Program(NamedTuple):
    """The columns of a program's table, each by its possible keys (`Column.key`).

    Attributes:
        name: of the program.
        point: keys of x and y.
        frames: frames that x and y may have.
        units: unit of x and y where their names have none.
        origin: from where x and y are counted.
        duration: keys of the duration.
        time: unit of the duration where its name has none.
        picture: keys of the picture's name.
        subject: keys of the person's name.
        trial: keys of a trial.
        number: keys of a fixation's number.
        width: keys of the width of the frame.
        height: keys of its height.
        filter: keys of the column that tells fixations from other lines.
        beginnings: how its fields begin in the lines of fixations, in lower case.
        needs: further keys that tell the table from others.
        lacks: keys that it does not have.
    """

    name: str
    point: tuple[str, str]
    frames: tuple[str, ...] = ("",)
    units: Units = "pixels"
    origin: Origin = "top left"
    duration: tuple[str, ...] = ("duration",)
    time: str = "ms"
    picture: tuple[str, ...] = ()
    subject: tuple[str, ...] = ()
    trial: tuple[str, ...] = ()
    number: tuple[str, ...] = ()
    width: tuple[str, ...] = ()
    height: tuple[str, ...] = ()
    filter: tuple[str, ...] = ()
    beginnings: tuple[str, ...] = ()
    needs: tuple[str, ...] = ()
    lacks: tuple[str, ...] = ()

    def fits(self, columns: Sequence[Column]) -> bool:
        """Tell whether this program wrote a table, by its columns.

        Args:
            columns: of the table.

        Returns:
            Whether it has what the program's tables have, and nothing that they lack.
        """
        keys = {column.key for column in columns}
        has_points = all(self.of_point(key, columns) for key in self.point)
        return has_points and keys.issuperset(self.needs) and keys.isdisjoint(self.lacks)

    def of_point(self, key: str, columns: Sequence[Column]) -> list[Column]:
        """Return the columns of x or of y, in any unit.

        Args:
            key: of x or y.
            columns: of the table.

        Returns:
            Those in a frame of the program.
        """
        return [column for column in columns if column.key == key and column.frame in self.frames]


_TRUE = ("true", "1")
_TOBII = Program(
    "Tobii",
    point=("fixationpointx", "fixationpointy"),
    duration=("gazeeventduration", "eyemovementeventduration"),
    subject=("participantname",),
    trial=("recordingname",),
)
_PRO_LAB = _TOBII._replace(
    name="Tobii Pro Lab",
    picture=("presentedstimulusname", "presentedmedianame", "recordingmedianame"),
    number=("eyemovementtypeindex",),
    filter=("eyemovementtype",),
    beginnings=("fixation",),
)
_CLOUD = Program(
    "Pupil Cloud",
    point=("fixationx", "fixationy"),
    subject=("recordingid",),
    trial=("sectionid",),
    number=("fixationid",),
    needs=("fixationid",),
)
_PLAYER = Program("Pupil Player", point=("normposx", "normposy"), units="fractions", origin="bottom left")
_BEGAZE = Program(
    "SMI BeGaze",
    ("fixationpositionx", "fixationpositiony"),
    duration=("eventduration", "fixationduration"),
    picture=("stimulus", "stimulusname"),
    subject=("participant", "participantname", "subject"),
    trial=("trial", "trialname"),
    filter=("category",),
    beginnings=("fixation", "visual intake"),
)

# From the particular to the general: a table of pictures or surfaces has the columns of a plain one, too.
PROGRAMS = (
    _TOBII._replace(
        name="Tobii Pro Lab",
        point=("mappedx", "mappedy"),
        picture=("snapshot",),
        number=("mappedindex",),
        filter=("mappedtype",),
        beginnings=("fixation",),
    ),
    _PRO_LAB._replace(
        frames=("mcs",),
        width=("presentedmediawidth",),
        height=("presentedmediaheight",),
        needs=("presentedmediawidth", "presentedmediaheight"),
    ),
    _PRO_LAB._replace(frames=("dacs", ""), width=("recordingresolutionwidth",), height=("recordingresolutionheight",)),
    _TOBII._replace(
        name="Tobii Studio",
        frames=("mcs", ""),
        picture=("medianame",),
        number=("fixationindex",),
        width=("mediawidth",),
        height=("mediaheight",),
        filter=("gazeeventtype",),
        beginnings=("fixation",),
        needs=("gazeeventtype",),
    ),
    _PRO_LAB._replace(frames=("mcs",)),
    _CLOUD._replace(
        filter=("fixationdetectedinreferenceimage",),
        beginnings=_TRUE,
        needs=("fixationdetectedinreferenceimage",),
    ),
    _CLOUD._replace(filter=("fixationdetectedonsurface",), beginnings=_TRUE, needs=("fixationdetectedonsurface",)),
    _CLOUD,
    _PLAYER._replace(number=("fixationid",), filter=("onsurf",), beginnings=_TRUE, needs=("onsurf", "fixationid")),
    _PLAYER._replace(number=("id",), needs=("dispersion",), lacks=("onsurf",)),
    Program(
        "PsychoPy",
        ("averagegazex", "averagegazey"),
        origin="centre, y up",
        time="s",
        subject=("sessionid",),
        needs=("duration",),
    ),
    Program(
        "Gazepoint",
        ("fpogx", "fpogy"),
        units="fractions",
        duration=("fpogd",),
        time="s",
        picture=("medianame", "mediaid"),
        subject=("user", "username"),
        number=("fpogid",),
        filter=("fpogv",),
        beginnings=_TRUE,
    ),
    _BEGAZE,
    _BEGAZE._replace(point=("visualintakepositionx", "visualintakepositiony")),  # of glasses
    _BEGAZE._replace(point=("positionx", "positiony"), needs=("fixationstart", "fixationduration")),  # up to version 3
    Program(
        "SMI IDF Event Detector",
        ("locationx", "locationy"),
        time="us",
        picture=("stimulus",),
        subject=("participant",),
        trial=("trial",),
        width=("calibrationareawidth",),
        height=("calibrationareaheight",),
        needs=("eventtype",),
    ),
    Program(
        "REMoDNaV",
        ("startx", "starty"),
        time="s",
        filter=("label",),
        beginnings=("fixa",),
        needs=("onset", "label", "amp"),
    ),
    Program(
        "I2MC",
        ("xpos", "ypos"),
        duration=("fixdur",),
        subject=("participant",),
        trial=("trial",),
        needs=("fixstart", "fixdur"),
    ),
    Program("PyGaze", ("endx", "endy"), needs=("starttime", "endtime"), lacks=("startx",)),
    Program(
        "pymovements",
        ("locationx", "locationy"),
        picture=("stimulus", "image", "imageid", "textid"),
        subject=("subjectid", "participantid", "subject"),
        trial=("trialid", "trial"),
        filter=("name",),
        beginnings=("fixation",),
        needs=("onset", "offset"),
    ),
    Program(
        "iMotions",
        ("fixationx", "fixationy"),
        duration=("fixationduration",),
        picture=("sourcestimuliname", "stimulusname", "stimulus", "image", "picture"),
        subject=("respondentname", "respondent"),
        number=("fixationindex", "fixationindexbystimulus"),
        needs=("fixationduration",),
    ),
    Program(
        "EyeLink Data Viewer",
        ("currentfixx", "currentfixy"),
        duration=("currentfixduration",),
        picture=("image", "imagename", "imagefile", "picture", "stimulus", "currentfixcomponentimagefile"),
        subject=("recordingsessionlabel", "datafile"),
        trial=("trialindex", "triallabel"),
    ),
)
"""Programs whose tables are read; of two that fit a table, the first is taken."""


def program_of(columns: Sequence[Column]) -> Program | None:
    """Return the program that wrote a table.

    Args:
        columns: of the table.

    Returns:
        The program; None where no program has such columns.
    """
    return next((program for program in PROGRAMS if program.fits(columns)), None)
