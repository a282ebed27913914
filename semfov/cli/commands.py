"""The subcommands: what each takes, which function runs it, and its help, one screen for each.

A new one has an entry here, and a module with its options and its function. Nothing of it is imported before it is run,
so that help and mistakes need no tensors.
"""

from typing import NamedTuple

from semfov.cli.formats import suffixes_in_words


class Subcommand(NamedTuple):
    """A subcommand.

    Attributes:
        summary: what it does, in the list of commands.
        positional: the setting that has no option before it; None for none.
        positional_help: what it is.
        options: dataclass of its options, as `room.module:Name`.
        function: what runs it, as `room.module:name`; it takes the options, and returns the exit code.
        help: one screen of help, which begins with examples.
        looking: whether it looks at pictures or frames, and shares the words of other programs for its options.
        writes_rows: whether it writes results to standard output with `--out -`; the function then takes the stream.
    """

    summary: str
    positional: str | None
    positional_help: str
    options: str
    function: str
    help: str
    looking: bool = False
    writes_rows: bool = False


_AGENT = """\
  --detector NAME      yolox-nano (default), another name (semfov detectors), mine.onnx, or mine.cfg --weights FILE
  --classes cat,dog    names of the classes, if an ONNX file lacks them; --head and --colour (semfov detectors --help)
  --models FOLDER      models from semfov fit (or FILE.safetensors); --agent recommended (default), published, or raw"""

_LOOKS = """\
  --how KIND           how to look: auto (default; windows in any picture), fovea, windows, or head (in a panorama)
  --passes N           at most N passes of the detector; --shifts N: at most N gaze shifts of a fovea
  --seconds S          at most S seconds for a picture; --white auto: thermal or 12 bits; --bands 4,3,2: for a TIFF"""

_OUTPUT = f"""\
  --out FILE           {suffixes_in_words()}; - is stdout
  --out FOLDER         results and figures of each picture (NAME.png: the figure of one); --draw scanpath,animation or
                       none; with a fovea also views,belief, and in a search belief_bars
  --report PAGE.html   a page in which to step through the looks; --looks prints them; --quiet: only errors
  --crops FOLDER       a JPEG of each object; --labels FOLDER: labels in YOLO's format
  --workers N          number of processes (or --scheduler tcp://HOST:8786, a Dask cluster); --device cuda; --half

If one of several pictures cannot be read, it is reported and skipped, and the exit code is 1. If a command with --out
was stopped, run it again: it continues with the pictures that are left. --help-all: all options."""

_PICTURES = "photographs, large pictures, or folders of them (none: one that comes with semfov)"
_DETECTOR = "the detector: a name or a file, as for semfov.load_detector"

SUBCOMMANDS = {
    "search": Subcommand(
        summary="search pictures for a class, and decide whether it is there",
        positional="pictures",
        positional_help=_PICTURES,
        options="cli.options:SearchOptions",
        function="cli.search:look_at",
        looking=True,
        writes_rows=True,
        help=f"""\
semfov search: is it there, and where?

  semfov search kitchen.jpg --target cup
  semfov search photos/ --target "wine glass" --out found.csv
  semfov search harbour.tif --target person --passes 16 --report harbour.html
  semfov search kitchen.jpg --target cup --models mymodels

usage: semfov search [PICTURE ...] --target CLASS [options]

  PICTURE              pictures of any size, folders (--recursive: subfolders, too), patterns (none: an example)
  --target CLASS       class to search for (semfov detectors NAME lists them)
  --embeddings FILE    word vectors; the target may then be a description, such as "something to drink from"
{_AGENT}
{_LOOKS}
  --confirm P          least probability for found; --stop-below P: stop if the chance of a new hit is below P
  --closer N           at most N closer looks; --prior P: share of the pictures that hold the class (default: 0.5)
  --start 5,5          first cell of a fovea as column,row, or its number; --seed N: for a random one
{_OUTPUT}
""",
    ),
    "find": Subcommand(
        summary="find all objects of one class, of several or of all",
        positional="pictures",
        positional_help=_PICTURES,
        options="cli.options:FindOptions",
        function="cli.search:look_at",
        looking=True,
        writes_rows=True,
        help=f"""\
semfov find: all objects, and how many

  semfov find harbour.tif --target person
  semfov find flight/*.jpg --target person,car --passes 16 --out boxes.json
  semfov find street.jpg --out street.coco.json
  semfov find BIG.jpg --models mymodels --report page.html
  semfov find orthophoto.tif --target car --out cars.geojson      (pip install "semfov[geo]")

usage: semfov find [PICTURE ...] [--target CLASS,CLASS] [options]

  PICTURE              pictures of any size, folders (--recursive: subfolders, too), patterns (none: an example)
  --target CLASSES     a class, or several with commas (default: all classes)
{_AGENT}
{_LOOKS}
  --min-gain N         in a large picture, stop if a look is expected to show fewer new objects than N (default 0.01)
  --score-threshold P  least probability of a listed object (default 0.5; without fitted models, least score 0.3)
  --batch N            look at N windows at once
{_OUTPUT}
""",
    ),
    "explore": Subcommand(
        summary="learn what is where, without a target",
        positional="pictures",
        positional_help=_PICTURES,
        options="cli.options:ExploreOptions",
        function="cli.search:look_at",
        looking=True,
        writes_rows=True,
        help=f"""\
semfov explore: what is where

  semfov explore street.jpg
  semfov explore street.jpg --shifts 10 --report street.html
  semfov explore harbour.tif --seconds 20 --out harbour.json
  semfov explore panorama.jpg --how head

usage: semfov explore [PICTURE ...] [options]

  PICTURE              pictures of any size, folders (--recursive: subfolders, too), patterns (none: an example)
{_AGENT}
{_LOOKS}
  --min-gain N         stop if a look is expected to show fewer new objects than N (default 0.01), with a fovea, to
                       label fewer additional cells correctly than N (default 0.1)
  --start 5,5          first cell of a fovea as column,row, or its number; --seed N: for a random one
{_OUTPUT}
""",
    ),
    "gaze": Subcommand(
        summary="predict where people look",
        positional="pictures",
        positional_help=_PICTURES,
        options="cli.options:GazeOptions",
        function="cli.gaze:predict_gaze",
        help="""\
semfov gaze: where people look in a picture that they view freely

  semfov gaze poster.jpg --report poster.html
  semfov gaze drafts/*.png --people 30 --seconds 5 --out drafts.csv
  semfov gaze poster.jpg --areas logo:10,20,200,80 price:300,40,420,90 --out map.png
  semfov gaze before.png after.png --compare --areas areas.json --report drafts.html

usage: semfov gaze [PICTURE ...] [options]

  PICTURE              photographs, or folders of them (none: one that comes with semfov)
  --detector NAME      the detector whose features are read: yolox-nano (default), yolov3-tiny, nanodet-plus-m-1.5x
  --weights FILE       its weights, if they are not downloaded
  --model FILE         a model for your own detector or of your own fixations, from semfov fit
  --quality best       six passes of the detector instead of one (quick): also windows and a mirror image
  --panorama           pictures of 360°, whose left and right edge meet
  --people N           number of simulated viewers (default 15); --seed N: other viewers
  --seconds S          time for which each views a picture (default 3)
  --out FILE           scanpaths as .csv; for one picture the density as .npy or .tif, or a heat map as .png
  --out FOLDER         scanpaths, a table of the pictures, and a heat map of each
  --report PAGE.html   a page with heat map, areas and scanpaths, in which to step through the fixations
  --areas NAME:L,T,R,B areas of interest: left, top, right and bottom edge in pixels; or a .json file with
                       {"logo": [10, 20, 200, 80]}, or for several pictures {"before.png": {"logo": …}, …}
  --compare            two pictures side by side: both maps on one scale, and what differs (default: a page,
                       semfov-compare.html)

If a command with --out was stopped, run it again: it continues with the pictures that are left. The models were fitted
to adults who looked at photographs for 3 to 5 seconds without a task. A warning says if a picture is unlike these
photographs, such as a page, a chart, a drawing or an upright picture. --help-all: all options.
""",
    ),
    "live": Subcommand(
        summary="search or explore a video, a camera or a network stream",
        positional="source",
        positional_help="video file, or address",
        options="cli.options:LiveOptions",
        function="cli.live:look_live",
        looking=True,
        help=f"""\
semfov live: one look at each frame of a video, a camera or a network stream

  semfov live --camera 0 --target cup
  semfov live holiday.mp4 --target bicycle --out seen
  semfov live rtsp://192.168.1.20/stream --target person
  semfov live holiday.mp4                             explore, without a target

usage: semfov live [VIDEO | FOLDER | URL | --camera N] [--target CLASS | --find CLASSES] [options]

  VIDEO, FOLDER, URL   a video file, a folder of frames, or an address such as rtsp://… that OpenCV can open
  --camera N           number of a camera; Ctrl-C ends it
  --target CLASS       class to search for (default: explore)
  --find CLASSES       find all objects of these classes, separated by commas
  --how KIND           how to look: auto (default; windows in any frame), fovea, or windows
  --frames N           number of frames (default: the whole video; a camera until Ctrl-C)
  --rate R             rate at which evidence fades, per second (0: never; default: 2.5 for a fovea, 0.75 for windows)
  --confirm P          least probability for found; --stop-below P: least chance of a hit for a closer look
  --closer N           at most N closer looks in the time until half of the evidence has faded
  --prior P            share of the frames that hold the target (default: 0.5)
{_AGENT}
  --start 5,5          first cell as column,row, or its number; --seed N draws it
  --out FILE           video to write (.mp4 or .avi), with gaze and belief, or windows and objects
  --out FOLDER         likewise, as a video in this folder

Videos need OpenCV: pip install opencv-python-headless. --help-all lists all options.
""",
    ),
    "compare": Subcommand(
        summary="compare semfov with slicing on your own pictures, over passes and seconds",
        positional="pictures",
        positional_help=_PICTURES,
        options="cli.options:CompareOptions",
        function="cli.compare:compare",
        help=f"""\
semfov compare: what semfov finds in a given time, compared with slices of the same pictures

  semfov compare flight/ --with sahi --target person
  semfov compare flight/ --with sahi,ranked --target person --annotations instances.json
  semfov compare BIG.jpg --with sahi --models mymodels --passes 32 --slice 640 --out compared

usage: semfov compare [PICTURE ...] [--with sahi,ranked] [options]

  PICTURE              pictures of any size, folders (--recursive: those in them too), patterns (none: a sheet)
  --with WAYS          sahi: the whole picture and all its slices (default); ranked: the slices with the highest scores
                       of the whole picture first
  --target CLASSES     a class, or several with commas (default: all classes)
  --annotations FILE   the true boxes, in COCO's format; without it, the objects found in all slices count as true
{_AGENT}
  --passes N           at most N passes of the detector for a picture (default 24)
  --slice N            side of a slice in pixels (default: of the detector's input); --overlap S (default 0.2)
  --out FOLDER         compare.html, compare.csv and compare.png (default: the folder semfov-compare)
  --quiet              only errors; --device cuda; --white auto and --bands 4,3,2 as for semfov find

SAHI need not be installed: semfov cuts the slices by SAHI's rule, and merges their objects. Seconds are measured on
this machine. --help-all: all options.
""",
    ),
    "demo": Subcommand(
        summary="write a page of what semfov does, in seconds and without a picture or a network",
        positional=None,
        positional_help="",
        options="cli.options:DemoOptions",
        function="cli.demo:make_demo",
        help="""\
semfov demo: what semfov does, as a page

  semfov demo
  semfov demo --out first.html

usage: semfov demo [--out FILE.html]

  --out FILE           the page to write (default: semfov-demo.html), one file that loads nothing from elsewhere
  --quiet              only errors

The page shows a search for a dog, all people on a sheet of five photographs with each window that was looked at, where
people look, and a stream. All are computed when you run the command, with the detector and the photographs in the
package: nothing is downloaded. Below each is the command for a picture of your own.
""",
    ),
    "app": Subcommand(
        summary="a page in the browser on which to try all this out, and to look yourself",
        positional="detector",
        positional_help=_DETECTOR,
        options="cli.options:AppOptions",
        function="cli.app:serve",
        help=f"""\
semfov app: try the agent on a page in the browser

  semfov app                                           (pip install "semfov[app]")
  semfov app yolox-nano --port 8000
  semfov app --models mymodels

usage: semfov app [DETECTOR] [options]

{_AGENT.partition(chr(10))[2]}
  --host ADDRESS       address to serve the page on (default 127.0.0.1: only for this machine; others need the token in
                       the printed address)
  --port N             its port (default: the first free one from 7860 on)

Press Look to search the photograph on the page. Or open a picture of your own, and find all objects, search for a
class, explore, or predict where people look. Or look yourself: the picture is sharp around your pointer, and each click
is a look. Nothing is sent elsewhere; pictures are deleted after an hour, and at the end. Ctrl-C ends the command.
""",
    ),
    "mcp": Subcommand(
        summary="let a language model search, find and look in the pictures of a folder",
        positional="folder",
        positional_help="the folder with the pictures",
        options="cli.options:McpOptions",
        function="cli.mcp:serve",
        help=f"""\
semfov mcp: tools for language models, by the Model Context Protocol

  semfov mcp PICTURES                                  (pip install "semfov[mcp]")

usage: semfov mcp FOLDER [options]

  FOLDER               the folder with the pictures (default: this one); files outside are refused, also by links
{_AGENT}

A program with a language model starts this command, and talks to it on standard input and output:

  {{"mcpServers": {{"semfov": {{"command": "semfov", "args": ["mcp", "PICTURES"]}}}}}}

The tools are pictures, search, find, look (a crop, as a picture), where_people_look and check. Each answer has places,
probabilities, the passes used, and how many objects are still to be expected. Nothing is written or sent elsewhere.
""",
    ),
    "check": Subcommand(
        summary="say what is suspicious in a file of fixations",
        positional="files",
        positional_help="files of fixations",
        options="cli.options:CheckOptions",
        function="human.check:check_fixations",
        help="""\
semfov check: is a file of fixations what it seems to be?

  semfov check people.csv
  semfov check tobii.tsv recordings/*.asc
  semfov check fixations.csv --size 1600,1200 --picture scene.mp4      (for Pupil Cloud, whose tables have neither)
  semfov check fixations.csv --picture PICTURES      (also compares the fixations with the pictures)

usage: semfov check FILE [FILE ...] [options]

  FILE                 a table of fixations, as semfov, Tobii, Pupil Labs, PsychoPy, PyGaze, Gazepoint, pymovements or
                       EyeLink Data Viewer write it, an ASC file of EyeLink, or JSON of COCO-Search18 or OSIE
  --picture FOLDER     the pictures, or one picture (kitchen.jpg): their sizes are compared with those in the file, or
                       used if the file has none
  --picture NAME       the picture's name, if the file has none; likewise --subject NAME, and --size W,H (of the frame)
  --quiet              only errors

The command reports wrong frames, units, origins and axes, letterboxes, repetitions, blinks and implausible durations.
With five pictures or more it also compares the fixations with where people look in them, and recognises y upwards,
mirrored pictures, a wrong size on the screen, wrong names and a shifted calibration (--rules-alone: without this). The
exit code is 1 if anything is suspicious. --help-all: all options.
""",
    ),
    "fit": Subcommand(
        summary="fit all models to your own detector",
        positional="model",
        positional_help=_DETECTOR,
        options="fit.settings:FitDetectorConfig",
        function="fit.detector:fit_folder",
        help="""\
semfov fit: fit all models to your own detector

  semfov fit mine.onnx --data.root PHOTOS --data.annotations instances.json --out mymodels
  semfov search PHOTO.jpg --target cup --models mymodels
  semfov find BIG.jpg --models mymodels
  semfov fit mine.onnx --gaze.fixations people.csv --gaze.pictures PHOTOS        where people look, for semfov gaze

usage: semfov fit MODEL [--data.root FOLDER --data.annotations FILE] [options]

  MODEL                    the detector: a name or a file, as for semfov.load_detector
  --data.root FOLDER       photographs for the fit; a few dozen with boxes are enough to begin with
  --data.annotations FILE  their boxes in COCO's format (none: the photographs in the package, as a trial)
  --data.limit N           use only N photographs
  --detector.classes LIST  names of the detector's classes, "[cat,dog]", if its file lacks them
  --out FOLDER             folder for the models (default mymodels)
  --holdout N              hold out one in N photographs, on which each model is compared with raw scores
  --columns N, --rows N    cells of the fovea's grid (default 10 × 10), also in searches with these models
  --gaze.fixations FILES   fixations of people, in a format that semfov check reads; without photographs, only the gaze
                           model is fitted. --gaze.pictures FOLDERS: the folder of the pictures of each file
  --windows false          fit no models for large pictures (they need about 50 photographs)
  --workers N              number of processes (default: one for each core)

The command writes the models, a report with figures, and a manifest. The agent uses a model only if it is better than
raw scores on the held-out photographs. If the command was stopped, run it again: it continues. --help-all: all options.
""",
    ),
    "detectors": Subcommand(
        summary="list detectors, or the classes of one",
        positional="name",
        positional_help="detector, or folder of models",
        options="cli.options:DetectorsOptions",
        function="cli.detectors:show",
        help="""\
semfov detectors: the detectors that have a name, or the classes of one

  semfov detectors                 names, licences, sizes, which are on this machine, and which have fitted models
  semfov detectors yolox-nano      the classes that it knows
  semfov detectors mine.onnx --try kitchen.jpg
  semfov detectors mine.onnx --head yolov8 --classes cat,dog --colour bgr --remember

usage: semfov detectors [NAME] [options]

  NAME                 name or file of a detector, as for semfov.load_detector, or a folder of models
  --try PHOTO          compare the bare detector's boxes with the objects that semfov lists, and warn of a damaged file
  --head, --colour     the form of an ONNX file's outputs, and the order of its colours; --logits, --input-size N,
                       --per-class (suppression of boxes)
  --classes cat,dog    names of its classes, or a file with one name in each line
  --remember           write these settings to a file, mine.json for mine.onnx, which every command reads
  --weights FILE       weights of a .cfg; --device cuda

Weights of yolox-nano, the default, are in the package. Others are downloaded at the first use, to $SEMFOV_CACHE or
the user's cache folder. A detector without shipped models needs --agent raw, or semfov fit first.
""",
    ),
}
"""The subcommands by name, in the order of the list of commands."""

_SUMMARIES = {name: command.summary for name, command in SUBCOMMANDS.items()}
_SUMMARIES["completion"] = "let bash, zsh or fish complete commands and options"

OVERVIEW = f"""\
semfov: active perception with any detector, in photographs, large pictures, scenes, video and cameras

  semfov demo                                       a page of four tasks, in seconds, without a picture
  semfov search kitchen.jpg --target cup            is there a cup, and where?
  semfov find harbour.tif --target person           all people in a large picture, and how many
  semfov explore street.jpg --report street.html    what is where, as a page with every look
  semfov gaze poster.jpg --report poster.html       where people look, and in what order
  semfov live --camera 0 --target cup               one look at each frame, until Ctrl-C
  semfov compare flight/ --with sahi                what semfov finds over seconds, beside slices
  semfov fit mine.onnx --data.root PHOTOS --data.annotations instances.json
  semfov detectors                                  detectors that can be named, and their licences

Commands:
{chr(10).join(f"  {name:11} {summary}" for name, summary in _SUMMARIES.items())}

`semfov COMMAND --help` shows a screen, `semfov COMMAND --help-all` every option, and `semfov --version` the version.
`semfov completion bash >> ~/.bashrc` lets the shell complete commands and options (also zsh and fish).
Without a picture, search, find, explore and gaze take one that comes with semfov: try `semfov search --target boat`.
Others are example:market, example:lifeboat, example:aeroplane, example:farm and example:sheet.
"""
"""The help of the command itself."""
