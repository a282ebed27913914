"""What all records share: looks, words, tables, drawings, files and notebooks."""

import csv
import dataclasses
import io
import json
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
import torch
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from PIL import Image

from semfov import Detections, DirichletBelief, Flat, Grid, Objects, Panorama, Scanpath
from semfov.data.large import open_large
from semfov.decision import CloseUp, Decision
from semfov.detection import Placement
from semfov.head.views import Views
from semfov.io.storage import read, write_file
from semfov.io.tables import csv_text
from semfov.paths import FoveaMoment, HeadPath, Record, WindowMoment, ZoomPath
from semfov.paths.fovea import moment_look
from semfov.paths.head import head_looks
from semfov.paths.stimulus import Stimulus, reduced_copy
from semfov.paths.windows import looks_at_windows
from semfov.viz import plot_belief, plot_belief_bars, plot_episode, plot_foveated_strip, plot_semantic_map
from semfov.viz.style import FOUND, TARGET
from semfov.zoom import Lattice
from semfov.zoom.looks import Window, WindowLook
from tests import small
from tests.refusals import refused, unusable

CLASSES = ("background", "cup", "cat")
BOX = torch.tensor([1.0, 2, 9, 10])


def looks(count):
    """Detections of looks: none in the first, and one more in each of the others."""
    generator = torch.Generator().manual_seed(0)
    made = []
    for number in range(count):
        corner = torch.rand(1, number, 2, generator=generator) * 10
        scores = torch.rand(1, number, 3, generator=generator).softmax(-1)
        order = scores[..., 1:].amax(-1).argsort(descending=True)[0]
        boxes = torch.cat([corner, corner + 5], -1)
        made.append(Detections(boxes[:, order], scores[:, order], torch.ones(1, number, dtype=torch.bool)))
    return tuple(made)


def scanpath():
    grid, cells = Grid(4, 3, (80, 60)), torch.tensor([0, 6, 11])
    generator = torch.Generator().manual_seed(1)
    return small.scanpath(
        grid,
        cells,
        CLASSES,
        looks(3),
        ({"detect": 0.5}, {"detect": 0.25}, {"detect": 0.125}),
        target=1,
        probabilities=torch.rand(3, 12, 3, generator=generator).softmax(-1),
        values=torch.rand(3, 12, generator=generator),
        found=True,
        decision=Decision("found", 0.9, 6, BOX, 0.8),
        closer=(CloseUp(1, 1, 6, BOX, 0.8, 0.9),),
        ending="decision",
    )


def zoom_path():
    lattice = Lattice.over((400, 300), (100, 100))
    windows = [
        Window.on(lattice, (0, 0, 0)),
        Window.on(lattice, (1, 16, 8)),
        Window.around(lattice, (10.0, 20.5, 60.0, 80.0)),
    ]
    window_looks = tuple(
        WindowLook(window, seen, torch.arange(seen.mask.shape[1]) % 2 == 1, torch.tensor([0.3, 0.1 * number]), None)
        for number, (window, seen) in enumerate(zip(windows, looks(3), strict=True))
    )
    objects = Objects(BOX[None] * 2, torch.tensor([0.7]), torch.tensor([1]), torch.tensor([2]))
    return ZoomPath(
        lattice=lattice,
        classes=CLASSES,
        target=1,
        looks=looks_at_windows(window_looks, lattice, (float("inf"), 0.1 + 0.2, 0.75)),
        candidates=objects,
        decision=Decision("found", 0.9, None, BOX, 0.8),
        closer=(CloseUp(None, 1, None, BOX, 0.8, 0.9, index=2),),
        ending="decision",
    )


def head_path(world=None):
    views = Views(Panorama(torch.rand(3, 64, 128), (40, 30)) if world is None else world)
    maps = torch.rand(3, len(views.world.scene), generator=torch.Generator().manual_seed(2))
    values = (float("inf"), 0.5, 0.25)
    return HeadPath(
        views=views,
        classes=CLASSES,
        target=2,
        looks=head_looks(views, (205, 217, 30), looks(3), maps, (0.2, 0.5, 1.25), values),
        maps=maps,
        duration=12.5,
        ending="passes",
    )


def moment():
    grid = Grid(4, 2, (40, 20))
    belief = DirichletBelief(torch.rand(1, 8, 3, generator=torch.Generator().manual_seed(3)) + 1)
    return FoveaMoment(
        classes=CLASSES,
        target=1,
        decision=Decision("undecided", 0.25),
        number=7,
        grid=grid,
        looks=(moment_look(grid, 7, 5, looks(3)[2], belief.probability(1)[0], {"open": 0.25, "detect": 0.5}),),
        probability=belief.probability(1)[0],
        visited=torch.zeros(8, dtype=torch.bool),
        next_cell=3,
    )


def window_moment():
    path = zoom_path()
    made = {each.name: getattr(path, each.name) for each in dataclasses.fields(path) if each.init}
    return WindowMoment(**{**made, "number": 7, "ending": None, "next_window": path.window_looks[1].window})


def timed(record, seconds):
    """A record whose looks end at these times."""
    looks = zip(record.looks, seconds, strict=True)
    return replace(record, looks=tuple(replace(look, seconds=time) for look, time in looks))


RECORDS = [scanpath, zoom_path, head_path, moment, window_moment]
PATHS = RECORDS[:3]
WORDS = {
    "scanpath": (
        "“cup” found after 2 gaze shifts and 1 closer look (probability 0.90, 0.80 at this place)",
        "A closer look confirmed the target.",
    ),
    "zoom_path": ("cup: found (there with probability 0.90) in 3 looks", "A closer look confirmed the target."),
    "head_path": (
        "3 cats found in 1.2 s of eye and head: 3 looks, 1 turn of the head",
        "All 3 passes were used.",
    ),
    "moment": ("cup: undecided, p 0.25", None),
    "window_moment": ("cup: found, p 0.90 (there 0.80)", "A closer look confirmed the target."),
}


def same(a, b):
    """Whether two values of any type, also nested ones, are equal to the bit."""
    if isinstance(a, torch.Tensor):
        return a.dtype == b.dtype and a.shape == b.shape and torch.equal(a.nan_to_num(7.0), b.nan_to_num(7.0))
    if isinstance(a, np.ndarray):
        return a.dtype == b.dtype and np.array_equal(a, b, equal_nan=True)
    if dataclasses.is_dataclass(a):
        compared = [field.name for field in dataclasses.fields(a) if field.compare or field.name == "box"]
        return type(a) is type(b) and all(same(getattr(a, name), getattr(b, name)) for name in compared)
    if isinstance(a, Views):
        return all(
            same(getattr(a, name), getattr(b, name)) for name in ("fields", "fovea", "poses", "gaze", "gaze_cell")
        )
    if isinstance(a, tuple):
        return len(a) == len(b) and all(same(x, y) for x, y in zip(a, b, strict=True))
    return type(a) is type(b) and a == b


@pytest.mark.parametrize("make", RECORDS)
def test_every_record_has_words_rows_and_a_notebook_view(make):
    record = make()
    described, why = WORDS[make.__name__]
    assert isinstance(record, Record)
    assert record.describe() == described
    assert record.target_name in described
    if why is not None:
        assert record.why_it_ended() == why
        assert record.summary() == f"{described}. {why}"
    first = repr(record).splitlines()[0]
    assert first.startswith(f"{type(record).__name__}: ")
    assert first == f"{type(record).__name__}: {record.summary()}"
    assert str(record).splitlines()[0] == record.summary()  # what `print` shows
    rows = record.rows()
    json.dumps(rows, allow_nan=False)
    assert record.to_frame().to_dict("records")[0].keys() == rows[0].keys()
    assert isinstance(record.to_frame(), pd.DataFrame)
    assert all(row.keys() == set(record.to_frame("objects").columns) for row in record.object_rows())
    shown = record._repr_html_()
    assert shown.startswith("<")
    assert "cup" in shown or "cat" in shown


def test_closer_looks_are_counted_as_looks_are(tmp_path):
    """Their `index` is that of `record[index]`, and their `number` from 1 as in tables."""
    path = zoom_path()
    (look,) = path.closer
    assert (look.index, look.number) == (path[look.index].index, path[look.index].number) == (2, 3)
    file = tmp_path / "record.safetensors"
    path.save(file)
    assert ZoomPath.load(file).closer[0].index == 2


@pytest.mark.parametrize("make", RECORDS)
def test_records_are_told_apart_without_their_tensors(make):
    """Two are the same where they are one object, also in lists and sets."""
    record, same = make(), make()
    assert record != same
    assert same in [record, same]
    assert len({record, same, record}) == 2
    assert record.detections[0] != same.detections[0]
    assert record[0] != same[0]
    assert Decision("found", 0.5, box=BOX) == Decision("found", 0.5, box=BOX.clone())
    assert Decision("found", 0.5, box=BOX) != Decision("found", 0.6, box=BOX)


def test_a_first_look_that_is_close_enough_is_not_called_a_closer_look():
    path = zoom_path()
    whole = dataclasses.replace(path.closer[0], index=0)
    first = dataclasses.replace(path, closer=(whole,))
    assert first.why_it_ended() == "The first look shows the target closely enough."
    doubt = dataclasses.replace(first, decision=Decision("undecided", 0.5))
    assert doubt.why_it_ended().endswith(" is worth a pass, but the target is too probable to call it absent.")
    both = dataclasses.replace(doubt, closer=(whole, *path.closer))
    assert both.why_it_ended() == "The target is too probable to call it absent."


def test_an_undecided_search_says_what_found_takes():
    """Of a place where closer looks decide, otherwise of the picture; also where a limit ended it."""
    path = replace(zoom_path(), decision=Decision("undecided", 0.67, confirm=0.7402), ending="passes")
    doubt = "It is probably there, but no place is sure: none reached probability 0.74 (1 looked at closely)."
    assert path.summary().startswith(
        f"cup: undecided (there with probability 0.67) in 3 looks (the limit of passes=). {doubt} Best place: box "
    )
    assert path.words.ended == f"All 3 passes were used. {doubt}"
    assert path.plot(image=torch.zeros(3, 300, 400)).axes[0].get_title().replace("\n", " ").endswith(doubt)
    rare = replace(path, decision=replace(path.decision, probability=0.66))
    assert rare.words.lack().startswith("It may be there, but no place is sure: none reached")
    by_presence = replace(path, closer=(), ending="decision")
    assert by_presence.words.lack() == (
        "It is probably there, but no place is sure: to call it found takes probability 0.74, and a look that shows it."
    )
    by_score = replace(path, closer=(), unseen=None)
    assert by_score.words.lack() == "To call it found takes score 0.74, and a look that shows it."
    assert path.to_dict()["confirm"] == 0.7402
    for known in ({"decision": None}, {"decision": Decision("absent", 0.3, confirm=0.74)},
                  {"decision": Decision("undecided", 0.61)}):  # fmt: skip
        assert replace(path, **known).words.lack() == ""


def test_a_file_keeps_what_found_takes(tmp_path):
    path = replace(zoom_path(), decision=Decision("undecided", 0.61, confirm=0.74))
    path.save(tmp_path / "now.safetensors")
    assert type(path).load(tmp_path / "now.safetensors").decision.confirm == 0.74


def seen(record, score, place):
    """A record of a search whose surest candidate has a score, and whose closer look has a probability."""
    candidates = replace(record.candidates, scores=torch.full_like(record.candidates.scores, score))
    closer = tuple(replace(look, place=place) for look in record.closer)
    return replace(record, candidates=candidates, closer=closer)


@pytest.mark.parametrize(
    ("outcome", "probability", "score", "place", "told"),
    [
        ("undecided", 0.98, 0.49, 0.49, "no cup clearly seen: undecided (there with probability 0.98)"),
        ("undecided", 0.98, 0.51, 0.49, "cup: undecided (there with probability 0.98)"),
        ("undecided", 0.98, 0.49, 0.51, "cup: undecided (there with probability 0.98)"),
        ("absent", 0.42, 0.1, 0.1, "cup: probably absent (there with probability 0.42)"),
        ("absent", 0.1, 0.1, 0.1, "cup: probably absent (there with probability 0.10)"),
        ("absent", 0.0951, 0.1, 0.1, "cup: probably absent (there with probability 0.10)"),
        ("absent", 0.09, 0.1, 0.1, "cup: absent (there with probability 0.09)"),
    ],
)
def test_a_verdict_says_first_that_nothing_was_clearly_seen(outcome, probability, score, place, told):
    record = seen(zoom_path(), score, place)
    assert record.closer
    assert len(record.candidates.of(record.sought))
    decided = replace(record, decision=Decision(outcome, probability), ending="decision")
    assert decided.describe() == f"{told} in 3 looks"


def test_what_the_probability_assumes_is_said_where_it_matters():
    """The odds 99 with the share 0.9, whose odds are 9, are 11 at one half; 2 to 3 are then 2 to 27."""
    undecided = replace(zoom_path(), decision=Decision("undecided", 0.99), assumed=0.9)
    assert undecided.probability_at(0.5) == pytest.approx(11 / 12)
    absent = replace(undecided, decision=Decision("absent", 0.4), ending="decision", closer=())
    assert absent.words.assumption() == (
        "This assumes that 90 % of your pictures hold it; if half of them did, it would be 0.07 after these looks."
    )
    assert absent.summary().endswith(f" {absent.words.assumption()}")
    sure = replace(absent, assumed=0.99999)
    assert "99.9 % of your pictures" in sure.words.assumption()
    assert "0.02 % of your frames" in replace(moment(), assumed=0.0002).words.assumption()
    silent = [
        undecided,  # 0.99 and 0.92 say the same
        replace(absent, assumed=0.5),
        replace(absent, assumed=None),
        replace(absent, decision=None),
        replace(absent, decision=replace(zoom_path().decision, probability=0.4)),
    ]
    assert [record.words.assumption() for record in silent] == [""] * len(silent)


@pytest.mark.parametrize("assumed", [2e-7, 3.5e-12, 0.25, 1 - 2e-7])
def test_rare_and_sure_shares_are_read_again_from_tables(assumed):
    record = replace(zoom_path(), prior=assumed, assumed=assumed)
    written = record.to_dict()["assumed"]
    assert written == pytest.approx(assumed, rel=1e-3, abs=0)
    assert 1 - written == pytest.approx(1 - assumed, rel=1e-3, abs=0)
    in_csv = float(csv_text([[written]]))
    assert record.probability_at(in_csv) == pytest.approx(record.decision.probability, rel=1e-3)


@pytest.mark.parametrize("make", [scanpath, zoom_path, moment, window_moment])
def test_files_and_json_keep_what_the_probability_assumes(make, tmp_path):
    record = replace(make(), prior=0.25, assumed=0.25)
    record.save(tmp_path / "record.safetensors")
    again = type(record).load(tmp_path / "record.safetensors")
    assert (again.prior, again.assumed) == (0.25, 0.25)
    assert again.probability_at(0.5) == record.probability_at(0.5)
    assert {"prior": 0.25, "assumed": 0.25}.items() <= record.to_dict().items()
    for share in (0, 1, None):
        refused("prior: expected a share above 0 and below 1", record.probability_at, share)
    for unknown in (replace(record, assumed=None), replace(record, decision=None)):
        refused("record: expected a search by models with the shares of their fit", unknown.probability_at, 0.5)


@pytest.mark.parametrize("make", RECORDS)
def test_every_record_is_written_as_tables_and_as_json(make, tmp_path):
    """Read back by the modules csv and json, and by pandas."""
    record = make()
    for table, rows in (("looks", record.rows()), ("objects", record.object_rows())):
        text = record.to_csv(tmp_path / "table.csv", table)
        assert (tmp_path / "table.csv").read_text(encoding="utf-8") == text
        read_back = list(csv.DictReader(io.StringIO(text)))
        assert [list(row) for row in read_back] == [list(row) for row in rows]
        assert [row["x"] for row in read_back] == [str(row["x"]) for row in rows]
        if rows:
            np.testing.assert_array_equal(pd.read_csv(tmp_path / "table.csv").y, [row["y"] for row in rows])
    values = json.loads(record.to_json(tmp_path / "record.json"))
    assert values == json.loads((tmp_path / "record.json").read_text(encoding="utf-8"))
    assert values == json.loads(json.dumps(record.to_dict()))
    assert [row["class"] for row in values["objects"]] == [row["class"] for row in record.object_rows()]
    assert (len(values["looks"]), values["target"]) == (len(record), record.target_name)
    if record.decision is not None and record.decision.box is not None:
        box = [values[edge] for edge in ("x1", "y1", "x2", "y2")]
        assert box == record.decision.box.tolist()
        assert (values["x"], values["y"]) == record.found_at == ((box[0] + box[2]) / 2, (box[1] + box[3]) / 2)
    refused("table: expected looks or objects, got people", record.to_csv, table="people")


def test_a_table_of_objects_has_every_column_of_its_rows(monkeypatch):
    """A new one needs no list of columns; without objects the table has a head all the same."""
    record = zoom_path()
    usual = record.object_rows()
    monkeypatch.setattr(type(record), "object_rows", lambda self: [{**row, "colour": "red"} for row in usual])
    head, *lines = record.to_csv(table="objects").splitlines()
    assert head.split(",") == [*usual[0], "colour"]
    assert [line.split(",")[-1] for line in lines] == ["red"] * len(usual)
    monkeypatch.setattr(type(record), "object_rows", lambda self: [])
    assert record.to_csv(table="objects").strip().split(",") == [*usual[0]]


@pytest.mark.parametrize("make", RECORDS)
def test_looks_are_taken_by_number_and_shown_and_drawn_on_a_given_picture(make):
    record = make()
    assert [record[number] for number in range(len(record))] == list(record)
    assert record[-1] is record.looks[-1]
    with pytest.raises(IndexError):
        record[len(record)]
    record = make()
    width, height = record.size
    red = torch.linspace(0, 1, width).expand(height, width)
    picture = torch.stack([red, red, red])
    for look, view in zip(record, record.look_views(open_large(picture)), strict=True):
        assert view.boxes.shape == look.detections.boxes[0].shape
        x1, _, x2, _ = look.region
        inside = record.around is None or x2 <= width
        if inside:
            assert float(view.pixels.mean()) == pytest.approx(((x1 + x2 - 1) / 2) / (width - 1), abs=0.03)
    record = make()
    assert isinstance(record.plot(image=torch.rand(3, 60, 80)), Figure)
    refused("image: expected the photograph", record.plot)


@pytest.mark.parametrize(
    ("name", "call"),
    [("people.csv", "to_csv"), ("a.JSON", "to_json"), ("a.html", "report"), ("a.png", r"plot\(\).savefig")],
)
def test_a_record_is_not_saved_under_the_name_of_another_file(name, call, tmp_path):
    refused(rf"path: .* use record\.{call}\('.*{name}'\)", scanpath().save, tmp_path / name)
    assert list(tmp_path.iterdir()) == []


def test_a_table_without_objects_has_its_columns():
    table = replace(head_path(), score_threshold=1.5).to_frame("objects")
    assert (len(table), table.columns.tolist()) == (0, list(head_path().object_rows()[0]))


@pytest.mark.parametrize("make", RECORDS)
def test_the_table_has_the_looks_and_its_first_columns_are_those_of_every_kind(make):
    """Brought objects are counted by the looks that objects name; the clock never goes back."""
    record = make()
    rows, others = record.rows(), [list(other().rows()[0]) for other in RECORDS]
    shared = [name for name in rows[0] if all(name in columns for columns in others)]
    assert all(columns[: len(shared)] == shared for columns in others)
    assert {"look", "x", "y", "seen", "seconds", "value", "brought"} <= set(shared)
    assert [*rows[0]] == [*shared, *record.looks[0].more]
    found = record.object_rows()
    for row, look in zip(rows, record, strict=True):
        assert (row["look"], row["value"]) == (look.number, look.value and pytest.approx(look.value, rel=1e-3))
        place = [row[name] for name in ("x", "y", "x1", "y1", "x2", "y2")]
        assert place == pytest.approx([*look.fixation, *look.region], abs=0.005)
        assert row["detections"] == int(look.detections.mask.sum())
        assert row["brought"] == sum(each["look"] == look.number == look.index + 1 for each in found)
        best = look.detections.scores[0, :, 1:].max() if row["detections"] else None
        assert row["score"] == (None if best is None else pytest.approx(float(best), rel=1e-3))
    times = [look.seconds for look in record if look.seconds is not None]
    assert times == sorted(times)
    assert len(times) in (0, len(record))


def test_the_clock_of_an_episode_adds_up_the_times_of_a_fovea():
    assert [look.seconds for look in scanpath()] == [0.5, 0.75, 0.875]
    assert [look.seconds for look in head_path()] == [0.2, 0.5, 1.25]
    assert [look.seconds for look in timed(zoom_path(), (0.1, 0.2, 0.4))] == [0.1, 0.2, 0.4]


@pytest.mark.parametrize("make", [scanpath, zoom_path, head_path])
def test_the_first_look_was_not_chosen_by_a_value(make):
    first, *others = make()
    assert first.value is None
    assert all(look.value is not None for look in others)


@pytest.mark.parametrize(
    ("record", "word"),
    [
        (scanpath(), "probability"),
        (replace(scanpath(), ending="detection"), "belief"),
        (replace(scanpath(), closer=(), ending="shifts", assumed=None), "belief"),
        (replace(scanpath(), closer=(), ending="shifts", assumed=0.5), "probability"),
        (zoom_path(), "probability"),
        (replace(zoom_path(), closer=(), ending="detection"), "score"),
        (replace(zoom_path(), closer=(), ending="passes"), "score"),
        (replace(zoom_path(), closer=(), ending="passes", unseen=(0.0, 0.0)), "probability"),
        (head_path(), "probability"),
    ],
)
def test_a_record_tells_what_the_number_of_its_decision_is(record, word):
    assert record.words.decided_by == word
    if record.decision is not None:
        values = record.to_dict()
        number = values["probability" if word == "probability" else "score"]
        assert number == pytest.approx(record.decision.probability, rel=1e-3)
        assert values["score" if word == "probability" else "probability"] is None
        assert word == "probability" or values["place_probability"] is None


@pytest.mark.parametrize("make", [zoom_path, head_path])
def test_beliefs_over_cells_are_drawn_of_a_fovea_alone(make):
    drawn = plot_belief, plot_belief_bars, plot_episode, plot_foveated_strip, plot_semantic_map
    for plot in drawn:
        refused(f'how="fovea".*{make().how}', plot, make())


@pytest.mark.parametrize("make", RECORDS)
def test_every_record_is_saved_and_loaded(make, tmp_path):
    record = make()
    file = tmp_path / "a.safetensors"
    record.save(file)
    loaded = type(record).load(file)
    for field in dataclasses.fields(record):
        assert same(getattr(record, field.name), getattr(loaded, field.name)), field.name
    assert repr(loaded) == repr(record)
    assert loaded.rows() == record.rows()
    loaded.save(tmp_path / "b.safetensors")
    assert (tmp_path / "b.safetensors").read_bytes() == file.read_bytes()
    closer = (CloseUp(0, 1, 5, BOX, 0.8, 0.9, index=0),) if make is moment else ()
    bare = replace(record, target=None, decision=None, closer=closer, ending=None)
    bare.save(file)
    again = type(record).load(file)
    assert again.summary() == bare.summary()
    assert same(again.closer, bare.closer)


@pytest.mark.parametrize("make", PATHS)
def test_rows_and_fixations_match_the_looks(make):
    record = make()
    rows = record.rows()
    assert len(rows) == len(record) == 3
    assert [row["detections"] for row in rows] == [0, 1, 2]
    assert [row["seen"] for row in rows] == [None, *(CLASSES[int(d.labels[0, 0])] for d in record.detections[1:])]
    fixations = record.as_fixations("a.jpg")
    assert fixations.points == pytest.approx(np.array([[row["x"], row["y"]] for row in rows]), abs=0.005)
    assert (fixations.target, fixations.found) == (record.target_name, record.found)


@pytest.mark.parametrize("make", [zoom_path, window_moment])
def test_a_look_is_at_the_centre_of_what_it_shows(make):
    """The overview is square, and reaches below this wide picture."""
    record = make()
    for look in record:
        x1, y1, x2, y2 = look.region
        assert look.fixation == pytest.approx(((x1 + x2 - 1) / 2, (y1 + y2 - 1) / 2), abs=1e-3)
    assert next(iter(record)).fixation == (199.5, 149.5)


@pytest.mark.parametrize("sentences", [Scanpath._words._sentences, ZoomPath._words._sentences])
def test_only_a_search_that_found_something_speaks_of_a_confirmed_target(sentences):
    """Closer looks confirm objects from 0.5 on; a decision may ask for more, and then stays undecided beside them."""
    assert [each for each, text in sentences.items() if "confirmed" in text] == ["closer found"]


def with_picture(make):
    """A record with its photograph; a scanpath also with what its foveated views need."""
    record = make()
    width, height = record.size
    photograph = reduced_copy(torch.rand(3, height, width, generator=torch.Generator().manual_seed(4)))
    if make is not scanpath:
        return replace(record, photograph=photograph, target=2 if make is moment else record.target)
    sensor = {"sigma": 20.0, "levels": 3, "growth": 2.0, "convention": "kornia", "reference": 80.0}
    settings = {"sensor": sensor, "detector": {"name": "fixed"}}
    placement = Placement((80.0, 60.0), (1.0, 1.0), (0, 0))
    return replace(record, photograph=photograph, stimulus=Stimulus(photograph.clone(), placement, settings))


@pytest.mark.parametrize("make", RECORDS)
def test_every_record_draws_itself_on_its_picture(make, tmp_path):
    """What is printed, drawn, on the page and in the notebook are its objects, and no others."""
    record = with_picture(make)
    record = replace(record, score_threshold=0.1)
    objects, sure = record.objects, record.confirmed
    assert len(objects) > 0
    (axes,) = record.plot().axes
    colours = [to_hex(patch.get_edgecolor()).upper() for patch in axes.patches if patch.get_linestyle() == "-"]
    assert colours.count(FOUND) == int(sure.sum())
    assert colours.count(TARGET) == int((~sure).sum())
    entries = " ".join(text.get_text() for text in axes.get_legend().get_texts())
    texts = [text.get_text() for text in axes.texts]
    for row in record.object_rows():
        assert f"{row['class']} {row['score']:.2f}" in texts
        assert f"{row['class']} {row['score']:.2f}" in repr(record)
    assert "from score 0.1" in entries or sure.all()
    film = record.animate(tmp_path / "film.gif")
    with Image.open(film) as frames:
        assert frames.n_frames == len(list(record))
    page = record.report(tmp_path / "page.html", title="Cups & mugs").read_text(encoding="utf-8")
    assert "data:image/jpeg" in page
    assert "<h1>Cups &amp; mugs</h1>" in page
    shown = record._repr_html_()
    assert "data:image/jpeg" in shown
    if make is not scanpath:
        whole = [part for part in shown.split("<rect ") if "stroke-dasharray" not in part]  # the best place is dashed
        assert sum(f'stroke="{FOUND}"' in part for part in whole) == int(sure.sum())
        assert sum(f'stroke="{TARGET}"' in part for part in whole) == int((~sure).sum())
        assert page.count('class="object confirmed"') == int(sure.sum())
        assert page.count('class="object"') == int((~sure).sum())


@pytest.mark.parametrize("make", RECORDS)
def test_unknown_options_of_a_page_are_refused_with_those_of_the_page(make, tmp_path):
    record = with_picture(make)
    page = tmp_path / "page.html"
    refused("titel: expected an option of report, .*; did you mean title=", record.report, page, titel="Cups")
    refused("image: expected an option of report, .*; did you mean picture=", record.report, page, image=None)
    assert not page.exists()
    options = {"classes": 1, "settings": None} if make is scanpath else {}
    record.report(page, picture=None, name="a", boxes=None, width=40, quality=60, **options)


@pytest.mark.parametrize("make", RECORDS)
def test_a_file_keeps_the_picture(make, tmp_path):
    record = replace(with_picture(make), targets=(1, 2), score_threshold=0.4, source="a.jpg")
    file = tmp_path / "a.safetensors"
    record.save(file)
    loaded = type(record).load(file)
    assert same(loaded.image, record.image)
    assert (loaded.targets, loaded.score_threshold, loaded.source) == ((1, 2), 0.4, "a.jpg")
    assert repr(loaded) == repr(record)
    tensors, values = read(file, record._format.kind)
    write_file(file, {**tensors, "photograph": torch.zeros(3, 2, 1281, dtype=torch.uint8)}, values)
    unusable("photograph: expected 1 to 1280 px", type(record).load, file)


@pytest.mark.parametrize("make", RECORDS)
def test_files_of_another_kind_or_with_wrong_content_are_refused(make, tmp_path):
    record = make()
    file, other = tmp_path / "a.safetensors", tmp_path / "b.safetensors"
    record.save(file)
    for wrong in {Scanpath, ZoomPath, HeadPath, FoveaMoment, WindowMoment} - {type(record)}:
        unusable("expected a file of kind", wrong.load, file)
    damaged = bytearray(file.read_bytes())
    damaged[-5] ^= 1
    other.write_bytes(damaged)
    unusable("damaged", type(record).load, other)
    kind = json.loads(json.dumps(record._format.kind))
    tensors, values = read(file, kind)
    for name, changed in {
        "target": 3,
        "ending": "boredom",
        "lengths": [9] * len(values["lengths"]),
        "more": 1,
        "classes": ["cup"],
    }.items():
        write_file(other, tensors, {**values, name: changed})
        unusable(f"expected a complete {kind}", type(record).load, other)
    write_file(other, tensors, {**values, "version": "99.0.1", "more": 1})
    unusable(r"written by semfov 99\.0\.1, which is newer than this one", type(record).load, other)
    for name in tensors.keys() - {name for name, field in record._format.schema.tensors.items() if field.optional}:
        write_file(other, {key: value for key, value in tensors.items() if key != name}, values)
        unusable(name, type(record).load, other)
    far = {
        name: tensors[name].clone() for name in ("boxes", "object_boxes", "fixations", "fixation") if name in tensors
    }
    for name, tensor in far.items():
        if tensor.numel():
            tensor.view(-1)[0] = 1e38
            write_file(other, {**tensors, name: tensor}, values)
            unusable(rf"{name}: expected numbers .* got 9\.99\d+e\+37", type(record).load, other)


def test_windows_objects_and_actions_out_of_range_are_refused(tmp_path):
    file = tmp_path / "a.safetensors"
    zoom_path().save(file)
    tensors, values = read(file, "zoom path")
    windows = [{**window, "level": 9} for window in values["windows"]]
    for parts, record, message in (
        ({**tensors, "object_labels": torch.tensor([3])}, values, "object_labels"),
        ({**tensors, "object_passes": torch.tensor([3])}, values, "object_passes"),
        (tensors, {**values, "windows": windows}, "windows: expected levels below"),
        (tensors, {**values, "closer": [{**values["closer"][0], "index": 3}]}, "closer"),
    ):
        write_file(file, parts, record)
        unusable(message, ZoomPath.load, file)
    moment().save(file)
    tensors, values = read(file, "moment")
    of_two_looks = {**tensors, "highest": tensors["highest"].repeat(2, 1)}
    for parts, name, wrong, message in (
        (tensors, "cell", 8, "cell: expected a cell number below 8"),
        (tensors, "grid", [4, 3], "visited: expected 12 cells"),
        (tensors, "lengths", [1, 1], "lengths: expected 1 looks"),
        (of_two_looks, "lengths", [1, 1], "lengths: expected one look"),
    ):
        write_file(file, parts, {**values, name: wrong})
        unusable(message, FoveaMoment.load, file)
    head_path().save(file)
    tensors, values = read(file, "head path")
    world = {name: value for name, value in values["world"].items() if name != "reach"}
    for parts, record, message in (
        ({**tensors, "actions": tensors["actions"] + 10**6}, values, "actions: expected numbers below"),
        ({**tensors, "maps": tensors["maps"][:, 1:]}, values, "maps: expected values of"),
        (tensors, {**values, "world": world}, "world.reach: expected a value"),
        (
            tensors,
            {
                **values,
                "decision": {"outcome": "found", "probability": 0.9, "cell": 10**6, "place": None, "confirm": None},
            },
            "decision.cell",
        ),
    ):
        write_file(file, parts, record)
        unusable(message, HeadPath.load, file)


def test_a_head_path_from_a_file_has_the_geometry_of_its_scene(tmp_path):
    flat = Flat(torch.rand(3, 480, 640), (40, 30), degree=8, cell=5.0)
    for number, path in enumerate((head_path(), head_path(flat))):
        path.save(tmp_path / f"{number}.safetensors")
        loaded = HeadPath.load(tmp_path / f"{number}.safetensors")
        assert loaded.turns == path.turns
        assert replace(loaded, ending="duration").why_it_ended().endswith("time limit of the scene, 12.5 s (duration).")
        assert same(loaded.gaze(-1), path.gaze(-1))
        regions, labels, scores = loaded.places(-1, 0.0)
        assert len(regions) == len(labels) == len(scores)
        refused("picture: expected a scene with its picture", loaded.views.world.view, loaded.pose(0))

    class Own(Flat):
        """A scene that files do not describe."""

    own = head_path(Own(torch.rand(3, 480, 640), (40, 30), degree=8))
    refused("expected a scene that files can describe", own.save, tmp_path / "own.safetensors")


def test_objects_of_a_head_have_the_directions_to_turn_to():
    """A panorama is 360 × 180 degrees, and a flat picture has its degree in pixels."""
    record = head_path()
    width, height = record.size
    for row in record.object_rows():
        pan, tilt = 360 * row["x"] / width - 180, 90 - 180 * row["y"] / height
        assert (row["pan"] - pan) % 360 == pytest.approx(0, abs=0.02) or (row["pan"] - pan) % 360 > 360 - 0.02
        assert row["tilt"] == pytest.approx(tilt, abs=0.02)
    flat = head_path(Flat(torch.rand(3, 48, 64), (40, 30), degree=1.0, fields=(30.0,)))
    for row in flat.object_rows():
        assert (row["pan"], row["tilt"]) == pytest.approx((row["x"] - 32, 24 - row["y"]), abs=0.01)
