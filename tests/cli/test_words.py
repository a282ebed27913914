"""What the command is told: help, version, and mistakes that are refused in one line before anything is loaded."""

import importlib
import json
import re
import signal
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

import semfov
from semfov.cli import agent, jobs, live, options, search, sources, start
from semfov.cli.commands import SUBCOMMANDS
from semfov.cli.main import _completion, _in_command_words, _options_of, main
from semfov.cli.outcome import table_lines
from semfov.cli.results import kind_of
from semfov.errors import DataError, InputError
from semfov.fit.settings import FitDetectorConfig
from semfov.runs import arguments
from semfov.runs.arguments import usual_form
from semfov.runs.command import make_parser
from tests import small

REFUSED = {
    "search --target zebr": "target: unknown class 'zebr'; did you mean 'zebra'?",
    "search --target mug": "target: unknown class 'mug'; did you mean 'cup'?",
    "search --target qqq": "airplane and 75 more; `semfov detectors NAME` lists them",
    "search --target cup,fork": "target: expected one class, got cup and fork; --how fovea searches for any of them,",
    "search --target cup,frok": "target: unknown class 'frok'; did you mean 'fork'?",
    "search --target cup,qqq": "target: unknown class 'qqq'; known: person",
    "search": "target: expected a class, --target cup, got none; `semfov detectors yolox-nano` lists them",
    "find --target cup,zebr": "target: unknown class 'zebr'; did you mean 'zebra'?",
    "find --start 5,5": "start: expected none for find",
    "find --start 47": "start: expected none for find",
    "search nosuch.jpg --target cup": "picture: no such file or folder: nosuch.jpg; check the path",
    "explore film.mp4": "picture: expected photographs; `semfov live` takes videos, got film.mp4",
    "explore http://example.org/a.jpg": "on this machine, got 'http://example.org/a.jpg'; download it first",
    "find rtsp://camera/1": "on this machine, got 'rtsp://camera/1'; `semfov live` takes streams",
    "find - --target cup": "got -; standard input is not read: write the picture to a file",
    "explore FOLDER": "and --recursive also searches the folders in it, got none",
    "search nosuch.jpg cup": "picture: no such file or folder: nosuch.jpg; check the path",
    "search zebr nosuch.jpg": "picture: expected a file or folder (a class is given by --target zebr), got zebr",
    "find nosuch --target cup": "picture: expected a file or folder (a class is given by --target nosuch)",
    "find --classes cup": "classes: expected none for yolox-nano, which has its own; `semfov find --target CLASS`",
    "find --device nosuch": "device: expected one that PyTorch has here (cpu",
    "find --device meta": "device: expected one that PyTorch has here (cpu",
    "live": "source: expected a video, an address or --camera 0, got none",
    "live a.mp4 --target cup,fork": "target: expected one class, got cup and fork; --find cup,fork takes several",
    "live a.mp4 --target cup,frok": "target: unknown class 'frok'; did you mean 'fork'?\n",
    "live a.mp4 --target qqq": "`semfov detectors NAME` lists them",
    "live nosuch.mp4": "source: nosuch.mp4: no such file; check the path",
    "live a.mp4 --camera 0": "camera: expected a video or a camera, not both, got 0",
    "live a.mp4 --out a.json": "out: expected a folder, or a file that ends in .mp4 or .avi, got a.json",
    "live --camera -1": "camera: expected a whole number from 0",
    "live --camera 0 --rate -1": "rate: expected a number from 0",
    "live --camera 0 --frames 0": "frames: expected a whole number from 1",
    "search --target cup --passes 0": "passes: expected a whole number from 1 to 1,000,000, got 0",
    "search --target cup --shifts -1": "shifts: expected a whole number from 0 to 10,000, got -1",
    "search --target cup --seconds -1": "seconds: expected a number from 0, got -1",
    "search --target cup --confirm 50": "confirm: expected a probability from 0 to 1, got 50",
    "search --target cup --stop-below -1": "stop_below: expected a probability from 0 to 1, got -1",
    "search --target cup --seed -1": "seed: expected a whole number from 0",
    "search --target cup --out a.xls": "a file that ends in .png, .pdf, .svg, .coco.json, .json, .jsonl, .csv",
    "search --target cup --report a.pdf": "report: expected a file that ends in .html or .htm, got a.pdf",
    "search --target cup --draw scanpath": "draw: expected --out FOLDER beside --draw, got none",
    "search --target cup --detector yolo": "unknown detector 'yolo'; did you mean 'yolov3'",
    "search --target cup --detector nosuch.onnx": "detector: no such file: nosuch.onnx; check the path",
    "search --target cup --detector yolov3-tiny --weights a.onnx": "a detector of its own, --detector FILE, got a.onnx",
    "search --target cup --detector my.weights": "weights only; give 'x.cfg' with --weights my.weights",
    "compare --out a.html": "out: expected a folder, for compare.html, compare.csv and compare.png, got a.html",
    "fit my.pt": "yolo export model=my.pt format=onnx",
    "search --target cup --detector my.pt": "read as 'torchvision:MODEL' with --weights my.pt and --classes",
    "detectors yolo": "unknown detector 'yolo'; did you mean 'yolov3'",
    "detectors yolox": "unknown detector 'yolox'; did you mean 'yolox-s' or 'yolox-tiny' or 'yolox-nano'",
    "fit": "model: expected the name or the file of a detector, got none",
}

WRONG_USE = {
    "find . --out=": "out: expected the name of a file or folder, got an empty one",
    "search --target cup --target dog": "target: expected once, got it again; where it takes several, as a,b",
    "find . --passes 1 --passes 2": "passes: expected once, got it again\n",
    "app --detector yolov3-tiny": "the detector has no option before it: semfov app DETECTOR",
    "fit --detector mine.onnx": "the model has no option before it: semfov fit MODEL",
    "find --picture a.jpg": "unknown option --picture; the picture has no option before it: semfov find PICTURE",
    "search --image a.jpg --target cup": "the picture has no option before it: semfov search PICTURE",
    "find . --imgsz 640": "unknown option --imgsz; did you mean --input-size?",
    "detect a.jpg": "unknown command 'detect'; did you mean 'find'?",
    "saliency a.jpg": "unknown command 'saliency'; did you mean 'gaze'?",
    "analyze a.jpg": "unknown command 'analyze'; did you mean 'find'?",
    "gaze a.jpg --aoi logo:0,0,9,9": "unknown option --aoi; did you mean --areas?",
    "find . --min-conf 0.5": "unknown option --min-conf; did you mean --score-threshold?",
    "find . --output-dir runs": "unknown option --output-dir; did you mean --out?",
    "find . --save-conf": "unknown option --save-conf; did you mean --out?",
    "find . --slice-height 256": "unknown option --slice-height; semfov chooses the windows",
    "find . conf=0.3": "unknown option --conf; did you mean --score-threshold?",
    "find . passes=8": "expected --passes 8, got passes=8",
    "find . score-threshold=0.5": "expected --score-threshold 0.5, got score-threshold=0.5",
    "find . conf-thres=0.3": "unknown option --conf-thres; did you mean --score-threshold?",
    f"find . conf={'0' * 300}": "unknown option --conf; did you mean --score-threshold?",
    "find . --obb": "unknown option --obb; boxes are upright, as the detector's are",
    "find --input a.jpg": "the picture has no option before it: semfov find PICTURE",
    "find -i a.jpg": "unknown option -i; the picture has no option before it: semfov find PICTURE",
    "live -i a.mp4": "unknown option -i; the source has no option before it: semfov live SOURCE",
    "find . -o a.csv": "unknown option -o; did you mean --out?",
    "search a.jpg -t cup": "unknown option -t; did you mean --target?",
    "gaze a.jpg -n 5": "unknown option -n; did you mean --people?",
    "search a.jpg --for cup": "unknown option --for; did you mean --target?",
    "search a.jpg --fovea-size 64": "unknown option --fovea-size; --how fovea looks with a fovea",
    "gaze a.jpg --viewing-distance 60": "unknown option --viewing-distance; the fitted model has its own",
    "gaze a.jpg --overlay-alpha 0.5": "unknown option --overlay-alpha; the map keeps the picture's colours",
    "find . --no-save": "unknown option --no-save; --help-all lists all options",
    "find . --exclude-classes cat": "what is transparent in a picture is left out",
    "find source=.": "unknown option --source; the picture has no option before it: semfov find PICTURE",
    "gaze a.jpg --n-fixations 5": "unknown option --n-fixations; --seconds says how long a viewer looks",
    "live a.mp4 --vid-stride 2": "unknown option --vid-stride; each frame is looked at",
    "gaze a.jpg --quality fast": "quality: expected 'quick' or 'best', got 'fast'",
    "gaze a.jpg --quality bst": "got 'bst'; did you mean 'best'?",
    "compare . --with slicing": "with: expected some of 'sahi', 'ranked', got 'slicing'",
    "compare . --report a.html": " has compare.html, compare.csv and compare.png",
    "compare . --wth sahi": "unknown option --wth; did you mean --with?",
    "compare . --with": "--with: expected a value, got none",
    "serch a.jpg": "unknown command 'serch'; did you mean 'search'?",
    "count a.jpg": "unknown command 'count'; did you mean 'find'?",
    "--target cup": "expected a command before --target: search, find",
    "FOLDER --target cup": "try `semfov search FOLDER --target CLASS`",
    "search --targt cup": "unknown option --targt; did you mean --target?",
    "find --closer 3": "unknown option --closer; it is one of `semfov search` and `semfov live`",
    "explore a.jpg --target cup": "unknown option --target; it is one of `semfov search` and `semfov find` and",
    "explore --frames=3": "unknown option --frames; it is one of `semfov live`",
    "find . --conf 0.5": "unknown option --conf; did you mean --score-threshold?",
    "search --target cup --conf 0.5": "unknown option --conf; did you mean --confirm?",
    "gaze a.jpg --target cup": "unknown option --target; it is one of `semfov search` and `semfov find`",
    "search --xyz": "unknown option --xyz; --help-all lists all options",
    "find --iou 0.5": "unknown option --iou; the detector leaves out what overlaps a better box; in Python semfov.load",
    "find --nms": "unknown option --nms; the detector leaves out what overlaps a better box; in Python",
    "find --no-nms": "unknown option --no-nms; the detector leaves out what overlaps a better box; in Python",
    "compare . --nms-threshold 0.5": "unknown option --nms-threshold; the detector leaves out what overlaps",
    "find --agnostic-nms": "boxes of all classes suppress each other, unless --per-class is given",
    "find --export a.csv": "unknown option --export; did you mean --out?",
    "search --target cup --no-closer": "unknown option --no-closer; use --closer 0\n",
    "find --no-closer": "unknown option --no-closer; --closer is one of `semfov search` and `semfov live`\n",
    "find --no-recursive": "unknown option --no-recursive; leave --recursive out\n",
    "search --target cup --disable-draw": "unknown option --disable-draw; use --draw none\n",
    "fit my.onnx --data coco.yaml": "error: data: no such file: coco.yaml; check the path\n",
    "fit my.onnx --data FOLDER": "data: expected --data.root, --data.annotations and others, or a file of them",
    "fit my.onnx --gaze people.csv": "gaze: expected --gaze.fixations, --gaze.pictures and others, or a file of them",
    "find --oat 3": "unknown option --oat; --help-all lists all options",
    f"find . --{'x' * 300}": "x; --help-all lists all options",
    "fit my.onnx --data --device cpu": "error: --data: expected a value, got none\n",
    "fit my.onnx --data nosuch.json": "error: data: no such file: nosuch.json; check the path\n",
    "fit my.onnx --data [1]": "data: expected --data.root, --data.annotations and others, or a file of them",
    f"fit my.onnx --data {'1' * 5000}": "data: expected --data.root, --data.annotations and others, or a file of them",
    "fit my.onnx -i a.jpg": "unknown option -i; --help-all lists all options",
    "search . --target cup --no-confirm": "unknown option --no-confirm; leave --confirm out\n",
    "find . --no-stream": "unknown option --no-stream; --help-all lists all options",
    "find . --no-augment": "unknown option --no-augment; --help-all lists all options",
    "search . --target cup --no-tta": "unknown option --no-tta; --help-all lists all options",
    "search . --target cup --wait-for 3": "unknown option --wait-for; --help-all lists all options",
    "search --target": "--target: expected a value, got none",
    "search --passes many --target cup": "passes: expected a whole number from 1 to 1,000,000, got 'many'",
    "search --target cup --start 5;5": "start: expected a cell as column,row (5,5) or as its number (47), got '5;5'",
    "search --sensor wide": "sensor: expected 'published' or 'published-narrow' or",
    "search --agent recomended": "or 'raw', got 'recomended'; did you mean 'recommended'?",
    "search --draw portrait": "draw: expected some of 'scanpath', 'views', 'belief', 'belief_bars', 'animation'",
    "find . --resume": "unknown option --resume; the same command goes on where it stopped",
    "find . --mask roi.png": "unknown option --mask; what is transparent in a picture is left out",
    "find . --min-size 20": "unknown option --min-size; --out FILE.csv has all boxes",
    "find . --top 3": "unknown option --top; --out FILE.csv has all objects, to sort by their scores",
    "gaze a.jpg --top 3": "unknown option --top; the places are printed by their shares, the largest first",
    "find . --wandb": "unknown option --wandb; nothing is logged elsewhere; a tracker takes the file that --out writes",
    "gaze a.jpg --colormap jet": "unknown option --colormap; the map keeps the picture's colours",
    "diff a.jpg b.jpg": "unknown command 'diff'; did you mean 'gaze --compare'?",
    "app --share": "unknown option --share; did you mean --host?",
    "export yolox-nano": "unknown command 'export'; the page of detectors",
    "resume": "unknown command 'resume'; the same command goes on where it stopped",
    "live a.mp4 b.mp4": "unexpected argument 'b.mp4'",
}


@pytest.fixture(autouse=True)
def _nothing_is_loaded(monkeypatch):
    for module in (agent, live, jobs):
        monkeypatch.setattr(module, "make_agent", lambda options: pytest.fail("the agent was loaded"))


@pytest.mark.parametrize("command", REFUSED)
def test_wrong_values_are_refused_in_one_line(command, tmp_path, capsys):
    assert main(command.replace("FOLDER", str(tmp_path)).split()) == 1
    error = capsys.readouterr().err
    assert error.startswith("error: ")
    assert REFUSED[command] in error
    assert error.count("\n") == 1


@pytest.mark.parametrize("command", WRONG_USE)
def test_wrong_use_is_refused_in_one_line_with_exit_code_2(command, tmp_path, capsys):
    try:
        code = main(command.replace("FOLDER", str(tmp_path)).split())
    except SystemExit as stopped:
        code = stopped.code
    assert code == 2
    error = capsys.readouterr().err
    assert WRONG_USE[command].replace("FOLDER", str(tmp_path)) in error
    assert error.startswith("error: ")
    assert error.count("\n") == 1


@pytest.mark.parametrize("words", [[], ["--help"], ["help"], ("help",)])
def test_alone_it_lists_its_commands(words, capsys):
    assert main(words) == 0
    printed = capsys.readouterr().out
    assert all(re.search(rf"^  {name} ", printed, re.M) for name in (*SUBCOMMANDS, "completion"))
    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"semfov {semfov.__version__}\n"


@pytest.mark.parametrize("name", ["gaze", "live", "search"])
def test_help_tells_that_the_output_may_be_a_file_or_a_folder(name, capsys):
    main([name, "--help"])
    assert {"FILE", "FOLDER"} <= {*re.findall(r"^  --out (\w+)", capsys.readouterr().out, re.M)}


@pytest.mark.parametrize("name", SUBCOMMANDS)
def test_help_is_one_screen_with_options_that_exist(name, capsys):
    """Its examples come first, and --help-all lists every option of the short help."""
    assert main([name, "--help"]) == 0
    short = capsys.readouterr().out
    lines = short.splitlines()
    assert len(lines) <= 30
    assert max(map(len, lines)) <= 120
    assert lines[2].startswith(f"  semfov {name}")
    assert main([name, "--help-all"]) == 0
    whole = capsys.readouterr().out
    usage = short.partition("\nusage:")[2].partition("\n\nWeights")[0]
    named = set(re.findall(r"--[a-z][\w.-]*", usage)) - {"--help-all"}
    assert [option for option in named if f"--{option[2:].replace('-', '_')}" not in whole] == []
    assert re.findall(r"\w+_(?!\w)", whole) == []  # such as with_, which only Python needs


def test_options_may_have_dashes_or_underscores(tmp_path, capsys):
    for words in (["--stop-below", "0.2"], ["--stop_below=0.2"], ["--stop-below=0.2"]):
        with pytest.raises(SystemExit) as stopped:
            main(["search", *words, "--print-config"])
        assert stopped.value.code == 0
        assert "stop_below: 0.2" in capsys.readouterr().out
    parser = make_parser(_options_of("search"), "", ("pictures", "pictures"))
    assert parser.parse_args(["a.jpg", "b.jpg"]).pictures == ["a.jpg", "b.jpg"]


@pytest.mark.parametrize(
    ("command", "former", "present"),
    [
        ("search", "--give-up", "--stop-below"),
        ("find", "--least", "--score-threshold"),
        ("explore", "--worth", "--min-gain"),
        ("live", "--give_up", "--stop-below"),
    ],
)
def test_earlier_names_of_options_are_taken_with_a_note(command, former, present, capsys):
    for words in ([former, "0.25"], [f"{former}=0.25"]):
        with pytest.raises(SystemExit) as stopped:
            main([command, *words, "--print-config"])
        assert stopped.value.code == 0
        printed = capsys.readouterr()
        assert f"{present[2:].replace('-', '_')}: 0.25" in printed.out
        assert printed.err == f"note: {former} is called {present} now; the earlier name will go\n"


@pytest.mark.parametrize(
    ("command", "text", "printed", "note"),
    [
        ("find", "least: 0.9", "score_threshold: 0.9", "least is called score_threshold now"),
        ("search", "give_up: 0.25\ntarget: cup", "stop_below: 0.25", "give_up is called stop_below now"),
        ("search", "stop-below: 0.25", "stop_below: 0.25", ""),
        ("compare", "with: [ranked]", "with:\n- ranked", ""),
        ("compare", "with_: [ranked]", "with:\n- ranked", ""),
    ],
)
def test_files_of_settings_have_names_of_options_and_earlier_ones(command, text, printed, note, tmp_path, capsys):
    (tmp_path / "settings.yaml").write_text(text)
    with pytest.raises(SystemExit) as stopped:
        main([command, "--config", str(tmp_path / "settings.yaml"), "--print-config"])
    assert stopped.value.code == 0
    told = capsys.readouterr()
    assert printed in told.out
    assert told.err == (f"note: {note}; the earlier name will go\n" if note else "")


_TWICE = "score_threshold: expected once, got it again as 'score_threshold'"


@pytest.mark.parametrize(
    ("command", "text", "refusal"),
    [
        ("search", "detector: [a]", "detector: expected a name, got \"['a']\""),
        ("search", "report: [x]", "report: expected the name of a file or folder, got \"['x']\""),
        ("search", "pases: 4", "unknown setting 'pases' in a file; did you mean --passes?"),
        ("search", "1: x", "unknown setting '1' in a file; --help-all lists all options"),
        ("fit", "data: [3]", "data: expected settings by name, or a file of them, got [3]"),
        ("fit", "data: {1: x}", "data: expected settings by name, or a file of them, got {1: 'x'}"),
        ("fit", "data: {rot: x}", "unknown setting 'data.rot' in a file; did you mean --data.root?"),
        ("fit", "data: none.yaml", "data: no file of settings: none.yaml; check the path"),
        ("find", "least: 0.9\nscore_threshold: 0.3", _TWICE),
        ("find", "score-threshold: 0.9\nscore_threshold: 0.3", _TWICE),
    ],
)
def test_files_of_settings_with_something_else_or_a_setting_twice_are_refused(command, text, refusal, tmp_path, capsys):
    (tmp_path / "settings.yaml").write_text(text)
    with pytest.raises(SystemExit) as stopped:
        main([command, "--config", str(tmp_path / "settings.yaml")])
    assert stopped.value.code == 2
    assert f"error: {refusal}\n" in capsys.readouterr().err


def test_the_file_of_a_yolo_data_set_is_refused_with_what_converts_it(tmp_path, capsys):
    path = tmp_path / "coco.yaml"
    for names in ("names: [person]", "names:\n  0: person"):
        path.write_text(f"path: coco\ntrain: images/train\nval: images/val\n{names}\n")
        with pytest.raises(SystemExit) as stopped:
            main(["fit", "mine.onnx", "--data", str(path)])
        assert stopped.value.code == 2
        error = capsys.readouterr().err
        assert error.startswith("error: data: expected --data.root, --data.annotations and others")
        assert "supervision.DetectionDataset.from_yolo(" in error
        assert error.count("\n") == 1


@pytest.mark.parametrize("name", ["-a.jpg", "-x=y.jpg"])
def test_a_file_whose_name_begins_with_a_dash_is_no_option(name, tmp_path, monkeypatch, capsys):
    (tmp_path / name).touch()
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as stopped:
        main(["find", name])
    assert stopped.value.code == 2
    assert capsys.readouterr().err == f"error: unknown option {name}; write the file of this name as ./{name}\n"


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("data.yaml", "limt: 3\n", "unknown setting 'data.limt' in a file; did you mean --data.limit?\n"),
        ("data.json", '{"limt": 3}', "unknown setting 'data.limt' in a file; did you mean --data.limit?\n"),
        ("data.yaml", "root: photographs\nlimit: [3\nids: 4\n", "line 3, column 4"),
        ("data.yaml", b"root: \xff\n", "expected --data.root, --data.annotations and others, or a file of them"),
        ("data.csv", "limit: 3\n", "or a file of them (.yaml, .json), got "),
    ],
)
def test_a_mistake_in_the_file_of_a_group_is_told(name, text, message, tmp_path, capsys):
    path = tmp_path / name
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(SystemExit) as stopped:
        main(["fit", "mine.onnx", "--data", str(path)])
    assert stopped.value.code == 2
    error = capsys.readouterr().err
    assert error.startswith("error: ")
    assert message in error
    assert error.count("\n") == 1


def test_a_table_for_a_group_of_settings_is_refused_unread(tmp_path, monkeypatch, capsys):
    path = tmp_path / "people.csv"
    path.write_text("viewer,picture,x,y\n1,a.jpg,3,4\n")
    monkeypatch.setattr(arguments, "load_yaml", lambda text: pytest.fail("the table was read"))
    with pytest.raises(SystemExit) as stopped:
        main(["fit", "mine.onnx", "--gaze", str(path)])
    assert stopped.value.code == 2
    assert f"or a file of them (.yaml, .json), got {str(path)!r}" in capsys.readouterr().err


def test_settings_of_a_group_may_be_too_long_for_the_name_of_a_file(capsys):
    with pytest.raises(SystemExit) as stopped:
        main(["fit", "mine.onnx", "--print-config", "--data", json.dumps({"limit": 3, "root": "r" * 260})])
    assert stopped.value.code == 0
    assert "limit: 3\n" in capsys.readouterr().out


@pytest.mark.parametrize("text", ["limit: 3\n", '{"limit": 3}', "limit: null\n"])
def test_a_group_of_settings_may_stand_in_a_file_of_its_own(text, tmp_path, capsys):
    path = tmp_path / "data.yaml"
    path.write_text(text)
    values = ["--data", str(path)] if text.endswith("\n") else [f"--data={text}"]
    with pytest.raises(SystemExit) as stopped:
        main(["fit", "mine.onnx", *values, "--print-config"])
    assert stopped.value.code == 0
    assert ("limit: null" if "null" in text else "limit: 3") in capsys.readouterr().out


def test_detectors_are_listed_with_licence_and_models(capsys):
    assert main(["detectors"]) == 0
    printed = capsys.readouterr().out
    models = "search, closer looks, explore, large pictures, gaze"
    assert re.search(rf"^yolov3-tiny +35 MB .*{models} +public", printed, re.M)
    assert re.search(r"^yolox-tiny +20 MB .* none +Apache", printed, re.M)
    assert main(["detectors", "yolox-nano"]) == 0
    printed = capsys.readouterr().out
    assert "yolox-nano knows 80 classes:" in printed
    assert "wine glass" in printed


def test_an_agent_without_models_is_not_made_from_a_folder():
    from semfov.cli.options import SearchOptions

    with pytest.raises(InputError, match="agent: expected recommended or published with --models FOLDER, got raw"):
        make_agent(SearchOptions(agent="raw", models="mymodels"))


make_agent = agent.make_agent


@pytest.mark.parametrize(("program", "changes"), [("/usr/bin/semfov", True), ("study.py", False)])
def test_ctrl_c_while_the_command_is_imported_ends_in_one_line(program, changes, monkeypatch):
    """The package sets a handler first, but only if it is imported by the command."""
    monkeypatch.setattr(sys, "argv", [program])
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        importlib.reload(start)
        assert (signal.getsignal(signal.SIGINT) is start._leave) == changes
    finally:
        signal.signal(signal.SIGINT, before)


def test_texts_of_options_are_read(tmp_path):
    (tmp_path / "names.txt").write_text("cup\ntin can\n")
    named = options.SearchOptions(detector="torchvision:ssd", classes=(str(tmp_path / "names.txt"),))
    assert agent.detector_options(named)["classes"] == agent.detector_classes(named) == ("cup", "tin can")
    assert agent.several_classes("Cups, fork", ("cup", "fork")) == ["cup", "fork"]
    assert [options.white_of(text) for text in ("300,3000", "4095", "auto")] == [(300.0, 3000.0), 4095.0, "auto"]
    shown = sources._shown_by(options.PictureOptions(white="300,3000", bands="4,3,2"))
    assert shown == {"white": (300.0, 3000.0), "bands": (4, 3, 2)}
    assert [kind_of(Path(name)) for name in ("a.json", "a.coco.json", "runs/one")] == [".json", ".coco.json", None]
    assert table_lines([["name", "size"], ["a", "12"]]) == ["name  size", "a     12"]
    wide = "\N{CJK UNIFIED IDEOGRAPH-72AC}" * 3  # two columns of a terminal each
    assert table_lines([[wide, "1"], ["cafe\u0301", "2"]]) == [f"{wide}  1", "cafe\u0301    2"]
    assert [search._worth_starting(2, tasks, 0.5, 4.0) for tasks in (7, 99)] == [1, 2]


def test_a_damaged_picture_does_not_tell_whether_processes_pay(monkeypatch):
    """The first picture that can be looked at does; a damaged one takes no time."""
    clock = iter([10.0, 10.0, 10.1, 10.1, 14.1])
    monkeypatch.setattr(search.time, "process_time", lambda: next(clock))
    measured = []

    def worth(workers, tasks, seconds, start):
        measured.append((workers, tasks, seconds, start))
        return 1

    monkeypatch.setattr(search, "_worth_starting", worth)
    monkeypatch.setattr(search, "run_tasks", lambda *_, **__: iter(()))
    options = SimpleNamespace(workers=None, scheduler=None, quiet=True)
    outcomes = [DataError("a.png: damaged"), "seen", "not asked for here", "nor this"]
    job = SimpleNamespace(several=True, options=options, sources=range(4), outcome=lambda number: outcomes[number])
    assert [number for number, _ in search._outcomes(job, [0, 1, 2, 3])] == [0, 1]
    assert measured == [(None, 2, pytest.approx(4.0), 10.0)]


def test_messages_name_options_as_the_command_does():
    for message, names, told in (
        ("use how='windows' or stop_below=0.1, or find_all", ["how", "stop_below"],
         "use --how windows or --stop-below 0.1, or `semfov find`"),
        ("give its path as weights=", ["weights"], "give its path as --weights"),
        ("recursive=True, or classes=cat,dog", ["recursive", "detector.classes"],
         "--recursive, or --detector.classes cat,dog"),
        ("name them by columns={…} or give size=", ["size"],
         "give them these names in its first line (`semfov check` takes --columns x=THEIRS,y=THEIRS, too) or give "
         "--size"),
    ):  # fmt: skip
        assert _in_command_words(message, names) == told


def test_options_are_written_as_in_other_commands():
    given = ["--stop-below", "0.2", "--looks", "--draw", "path,views", "--config", "a.yaml", "--config", "b.yaml"]
    usual = ["--config", "a.yaml", "--config", "b.yaml", "--stop_below", "0.2", "--looks=true", "--draw=[path,views]"]
    known = ["--stop_below", "--looks", "--draw", "--config"]
    assert usual_form(given, options.SearchOptions, known) == usual
    assert usual_form(["--looks", "--looks"], options.SearchOptions, known) == ["--looks=true", "--looks=true"]


@pytest.mark.parametrize(
    "given",
    [
        "--passes 3 --config {file}",
        "--config {file} --passes 3",
        "a.jpg --config={file} --passes=3",
        "--passes 3 a.jpg --config {file}",
    ],
)
def test_what_is_typed_wins_over_a_file_of_settings_wherever_it_stands(given, tmp_path):
    file = tmp_path / "settings.yaml"
    file.write_text("passes: 2\nclasses: [cup]\npictures: [b.jpg]\n")
    parser = make_parser(options.SearchOptions, None, ("pictures", "pictures"))
    words = usual_form(given.format(file=file).split(), options.SearchOptions, parser._option_string_actions)
    parsed = parser.parse_args(words)
    assert parsed.passes == 3
    assert [str(picture) for picture in parsed.pictures] == ["a.jpg" if "a.jpg" in given else "b.jpg"]


@pytest.mark.parametrize("first", ["group", "part"])
def test_an_option_wins_over_the_file_of_its_group(first, tmp_path):
    file = tmp_path / "data.yaml"
    file.write_text("limit: 7\nmin_instances: 4\n")
    pair = [["--data", str(file)], ["--data.limit", "3"]]
    given = [word for words in (pair if first == "group" else pair[::-1]) for word in words]
    parser = make_parser(FitDetectorConfig, None)
    parsed = parser.parse_args(usual_form(given, FitDetectorConfig, parser._option_string_actions))
    assert (parsed.data.limit, parsed.data.min_instances) == (3, 4)


@pytest.mark.parametrize(
    "given",
    [
        "--areas logo:1,2,3,4 price:5,6,7,8 --people 3 a.jpg b.jpg",
        "a.jpg --areas logo:1,2,3,4 price:5,6,7,8 b.jpg --people 3",
        "a.jpg b.jpg --people 3 --areas logo:1,2,3,4 price:5,6,7,8",
        "--people 3 a.jpg --areas logo:1,2,3,4 price:5,6,7,8 -- b.jpg",
    ],
)
def test_pictures_may_stand_before_between_and_after_options(given):
    parser = make_parser(options.GazeOptions, None, ("pictures", "pictures"))
    parsed = parser.parse_args(usual_form(given.split(), options.GazeOptions, parser._option_string_actions))
    assert [str(picture) for picture in parsed.pictures] == ["a.jpg", "b.jpg"]
    assert (parsed.areas, parsed.people) == ("logo:1,2,3,4 price:5,6,7,8", 3)


@pytest.mark.parametrize("item", ["--sensor.settings.fovea 80", "--sensor.settings.fovea=80"])
def test_an_item_of_a_dictionary_keeps_its_value_beside_words(item):
    parser = make_parser(FitDetectorConfig, None, ("model", "a detector"))
    given = f"my.onnx --columns 3 {item} --rows 2".split()
    parsed = parser.parse_args(usual_form(given, FitDetectorConfig, parser._option_string_actions))
    assert str(parsed.model) == "my.onnx"
    assert (parsed.columns, parsed.rows, parsed.sensor.settings) == (3, 2, {"fovea": 80})


def test_a_shell_completes_commands_and_options():
    lines = _completion("fish", {"find": ["stop_below"]}).splitlines()
    assert lines == [
        'complete -c semfov -n __fish_use_subcommand -a "find"',
        'complete -c semfov -n "__fish_seen_subcommand_from find" -l stop-below',
    ]


def test_half_precision_on_a_processor_is_told(monkeypatch):
    loaded = small.agent(small.Coloured())
    monkeypatch.setattr(loaded, "half", lambda: loaded)
    monkeypatch.setattr(agent, "_load_agent", lambda *given: loaded)
    with pytest.warns(UserWarning, match="half: numbers of 16 bits make a processor several times slower"):
        assert make_agent(options.FindOptions(half=True)) is loaded
