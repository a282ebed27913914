"""What is suspicious in fixations is said, each kind alone, and nothing is said of fixations of people."""

import re
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from semfov.cli.main import main
from semfov.data.fixations import Fixations, read_fixations, suspicions, write_cocosearch, write_osie, write_table
from semfov.human.check import _PictureSizes
from tests.refusals import unusable

SIZE = (800, 600)


def people(count=40, size=SIZE, seed=0):
    """Scanpaths all over a frame with durations of fixations."""
    random = np.random.default_rng(seed)
    return [
        Fixations(
            f"{number}.jpg", "ann", random.uniform(0, 1, (8, 2)) * np.array(size) - 0.5, size,
            random.uniform(120, 500, 8).round(),
        )
        for number in range(count)
    ]  # fmt: skip


def moved(change):
    return [replace(each, points=change(each.points.copy())) for each in people()]


def lasting(change):
    return [replace(each, durations=change(each.durations.copy())) for each in people()]


def blinks(points):
    points[2:4] = -1000, -1000
    return points


def held(points):
    points[3:6] = points[3]
    return points


KINDS = {
    "unit": (moved(lambda points: (points + 0.5) / SIZE), "points look like fractions"),
    "origin": (moved(lambda points: points - np.array(SIZE) / 2), "points look like pixels from the centre"),
    "axes": (
        [replace(each, points=each.points[:, ::-1]) for each in people(size=(800, 450))],
        "points look like y before x",
    ),
    "smaller frame": (moved(lambda points: points / 3), "a frame of 26. × 200"),
    "outside": (moved(lambda points: points + np.array([150, 0])), "lie outside their frame"),
    "letterbox": (moved(lambda points: points * [0.75, 1] + [100, 0]), "at the left and right: was the picture"),
    "bars above": (moved(lambda points: points * [1, 0.5] + [0, 150]), "at the top and bottom"),
    "repeats": (moved(held), "repeat the point before"),
    "blinks": (moved(blinks), r"lie at \(-1000, -1000\): does the tracker write it during blinks"),
    "twice": ([*people(), *people(2)], "2 records occur more than once, such as that of ann in 0.jpg"),
    "interleaved": ([each.first(1) for each in people()], "40 of 40 scanpaths have one fixation"),
    "seconds": (lasting(lambda times: times / 1000), "look like seconds"),
    "microseconds": (lasting(lambda times: times * 1000), "look like microseconds"),
    "samples": (lasting(lambda times: times / 30), "are those of samples"),
    "alike": (lasting(lambda times: times * 0 + 200), "all durations are 200 ms"),
    "short": (lasting(lambda times: np.where(times < 200, 20, times)), "take less than 50 ms"),
    "long": (lasting(lambda times: np.where(times == times.max(), 9000, times)), "take more than 5 s"),
}  # fmt: skip


def test_nothing_is_said_of_plain_fixations():
    assert suspicions(people()) == []
    assert suspicions([replace(each, durations=None) for each in people(3)]) == []
    assert suspicions([]) == ["there are no fixations"]


@pytest.mark.parametrize("kind", KINDS)
def test_each_kind_is_told(kind):
    records, said = KINDS[kind]
    found = suspicions(records)
    assert any(re.search(said, line) for line in found), found


def test_the_command_says_what_is_in_files_and_exits_with_1_if_anything_is_wrong(tmp_path, capsys):
    write_table(tmp_path / "good.csv", people())
    assert main(["check", str(tmp_path / "good.csv")]) == 0
    shown = capsys.readouterr().out
    assert "320 fixations, 40 scanpaths, 1 person, 40 pictures, frames of 800 × 600; they take" in shown
    assert "nothing is suspicious; frames were not compared with pictures (--picture FOLDER)\n" in shown
    # The same table with other names of columns, which the command is told.
    text = (tmp_path / "good.csv").read_text()
    (tmp_path / "other.csv").write_text(text.replace("picture,", "seen by,", 1).replace(",x,", ",FPOGX,", 1))
    assert main(["check", str(tmp_path / "other.csv")]) == 1
    assert "(`semfov check` takes --columns x=THEIRS,y=THEIRS, too)" in capsys.readouterr().err
    assert main(["check", str(tmp_path / "other.csv"), "--columns", "picture=seen by, x = FPOGX"]) == 0
    assert capsys.readouterr().out == shown.replace("good.csv", "other.csv")
    assert main(["check", str(tmp_path / "other.csv"), "--columns", "picture=seen by,x="]) == 1
    assert "columns: expected the file's name of x, as in x=FPOGX" in capsys.readouterr().err
    write_table(tmp_path / "bad.csv", KINDS["origin"][0])
    assert main(["check", str(tmp_path / "good.csv"), str(tmp_path / "bad.csv"), str(tmp_path / "none.csv")]) == 1
    shown = capsys.readouterr().out
    assert "suspicious: points look like pixels from the centre" in shown
    assert "none.csv: cannot be read: " in shown
    (tmp_path / "neon.csv").write_text("fixation id,duration [ms],fixation x [px],fixation y [px]\n1,250,800,600\n")
    command = ["check", str(tmp_path / "neon.csv"), "--picture", "scene.mp4"]
    assert main(command) == 1
    assert "give --size, or give its pictures by --picture FOLDER" in capsys.readouterr().err
    assert main([*command, "--size", "1600,1200"]) == 0
    assert main([*command, "--size", "wide"]) == 1
    write_osie(tmp_path / "free.json", people(2))
    write_cocosearch(tmp_path / "search.json", people(2))
    capsys.readouterr()
    for name, usual, data in (("free", "800 × 600", "OSIE"), ("search", "1680 × 1050", "COCO-Search18")):
        main(["check", str(tmp_path / f"{name}.json")])
        assert f"frames of {usual} (those of {data}, or give --size)" in capsys.readouterr().out
        main(["check", str(tmp_path / f"{name}.json"), "--size", "1024,768"])
        assert "frames of 1024 × 768; " in capsys.readouterr().out


def test_pictures_of_a_folder_are_compared_with_the_frames_by_their_names(tmp_path, capsys):
    (tmp_path / "viewed" / "more").mkdir(parents=True)
    for name, size in (("a.png", (800, 600)), ("B.PNG", (640, 480)), ("more/c.png", (400, 600))):
        Image.new("L", size).save(tmp_path / "viewed" / name)
    records = people(3)
    table, command = tmp_path / "t.csv", ["check", str(tmp_path / "t.csv"), "--picture", str(tmp_path / "viewed")]
    write_table(table, [replace(one, picture=name) for one, name in zip(records, ("a.png", "b", "x\\a"), strict=True)])
    assert main(command) == 0  # of the same proportions, whatever their size
    write_table(table, [replace(one, picture=name) for one, name in zip(records, ("a", "C:/c.jpg", "d"), strict=True)])
    assert main(command) == 1
    shown = capsys.readouterr().out
    assert "1 of 3 pictures are missing or damaged, such as d\n" in shown
    assert "1 of 3 pictures have other proportions than their frames, such as C:/c.jpg, 400 × 600 in 800 × 600" in shown
    # Without a frame in the table, the pictures are the frames.
    table.write_text("picture,subject,x,y\nb,1,600,400\nc,1,390,590\n")
    assert main(command) == 0
    assert "frames of 400 × 600, 640 × 480 (the pictures, as the file has no frame; " in capsys.readouterr().out


def test_damaged_pictures_are_named_and_the_others_are_compared(tmp_path, capsys):
    folder = tmp_path / "viewed"
    folder.mkdir()
    (folder / "0.jpg").write_bytes(b"no picture")
    for number in range(1, 6):
        Image.effect_noise(SIZE, 50).save(folder / f"{number}.jpg")
    whole = (folder / "5.jpg").read_bytes()
    (folder / "5.jpg").write_bytes(whole[: len(whole) // 2])  # its head tells its size
    Image.new("L", (400, 600)).save(folder / "2.jpg")
    table = tmp_path / "t.csv"
    command = ["check", str(table), "--picture", str(folder)]
    write_table(table, people(6))
    assert main(command) == 1
    shown = capsys.readouterr().out
    assert "1 of 6 pictures are missing or damaged, such as 0.jpg\n" in shown
    assert f"suspicious: image {folder / '0.jpg'}: " in shown
    assert f"suspicious: image {folder / '5.jpg'}: " in shown
    assert "1 of 6 pictures have other proportions than their frames, such as 2.jpg, 400 × 600 in 800 × 600" in shown
    # Fixations whose frame is a damaged picture cannot be read.
    table.write_text("picture,subject,x,y\n0.jpg,1,60,40\n1.jpg,1,390,590\n")
    assert main(command) == 1
    assert "; or leave out the lines of this picture, or give --size\n" in capsys.readouterr().err


def test_damage_of_a_picture_is_said_of_the_files_that_name_it(tmp_path, capsys):
    folder = tmp_path / "viewed"
    folder.mkdir()
    (folder / "0.jpg").write_bytes(b"no picture")
    Image.new("L", SIZE).save(folder / "1.jpg")
    first, second, frameless = (tmp_path / f"{name}.csv" for name in ("first", "second", "frameless"))
    write_table(first, people(1))
    write_table(second, people(2)[1:])
    frameless.write_text("picture,subject,x,y\n1.jpg,1,900,40\n")  # outside its frame, which is a whole picture
    assert main(["check", *map(str, (first, second, frameless)), "--picture", str(folder)]) == 1
    of_first, of_others = capsys.readouterr().out.split(f"{second}: ")
    assert f"suspicious: image {folder / '0.jpg'}: " in of_first
    assert "0.jpg" not in of_others


def test_of_many_damaged_pictures_the_first_are_named(tmp_path, capsys):
    heads, bodies = tmp_path / "heads", tmp_path / "bodies"
    for folder, kept in ((heads, 4), (bodies, 5000)):
        folder.mkdir()
        for number in range(7):
            Image.effect_noise(SIZE, 50).save(folder / f"{number}.jpg")
        for number in range(2, 6):
            damaged = folder / f"{number}.jpg"
            damaged.write_bytes(damaged.read_bytes()[:kept])
    write_table(tmp_path / "t.csv", people(7))
    for folder in (heads, bodies):
        assert main(["check", str(tmp_path / "t.csv"), "--picture", str(folder)]) == 1
        shown = capsys.readouterr().out
        assert shown.count("suspicious: image ") == 3
        assert "suspicious: 1 more picture cannot be opened\n" in shown


def test_fixations_in_the_pixels_of_smaller_pictures_are_told():
    smaller = {f"{number}.jpg": (640, 480) for number in range(40)}
    within = [replace(each, size=SIZE) for each in people(size=(640, 480))]
    assert any("0.jpg: give its size, 640 × 480" in each for each in suspicions(within, smaller))
    assert suspicions(people(), smaller) == []
    assert suspicions(people(), dict.fromkeys(smaller, (1600, 1200))) == []


def test_one_picture_is_compared_with_its_frame_and_one_that_is_not_there_is_refused(tmp_path, capsys):
    (tmp_path / "none").mkdir()
    for name, size in (("0.jpg", SIZE), ("1.jpg", (400, 600))):
        Image.new("L", size).save(tmp_path / name)
    write_table(tmp_path / "t.csv", people(2))

    def told(place):
        code = main(["check", str(tmp_path / "t.csv"), "--picture", str(tmp_path / place)])
        return code, *capsys.readouterr()

    code, out, err = told("0.jpg")
    assert (code, err) == (0, "")
    assert "1 picture, " in out
    assert out.endswith("  nothing is suspicious\n")
    assert "have other proportions than their frames, such as 1.jpg, 400 × 600 in 800 × 600" in told("1.jpg")[1]
    code, _, err = told("nosuch")
    assert code == 1
    assert f"picture: expected a picture or folder that exists, got {tmp_path / 'nosuch'}\n" in err
    assert "picture: expected photographs (.jpg, .png, .tif, …) in " in told("none")[2]
    # Without a frame in an export that names no picture, it is the picture that is named.
    (tmp_path / "t.csv").write_text("fixation id,duration [ms],fixation x [px],fixation y [px]\n1,250,300,500\n")
    assert "1 picture, frames of 400 × 600" in told("1.jpg")[1]


def test_pictures_of_one_name_are_told_apart_by_their_folders(tmp_path):
    for name, side in (("a/p.png", 8), ("b/p.png", 9)):
        (tmp_path / name).parent.mkdir()
        Image.new("L", (side, side)).save(tmp_path / name)
    sizes = _PictureSizes(tmp_path)
    for before in ("", "x/", f"{tmp_path}/"):
        assert [sizes[f"{before}{name}/p.png"] for name in "aB"] == [(8, 8), (9, 9)]


def test_columns_of_an_export_are_taken_with_its_units(tmp_path):
    path = tmp_path / "report.csv"
    path.write_text(
        "CURRENT_FIX_X,CURRENT_FIX_Y,CURRENT_FIX_DURATION,stimulus,who\n40,.,200,a.jpg,7\n40,30,250,a.jpg,7\n"
    )
    names = {"picture": "stimulus", "subject": "who"}
    (record,) = read_fixations(path, columns=names, size=(80, 60))
    assert (record.picture, record.subject, record.durations.tolist()) == ("a.jpg", "7", [250])
    path.write_text(path.read_text().replace("40,.,200,a.jpg,7\n", ""))
    named = {**names, "x": "CURRENT_FIX_X", "y": "CURRENT_FIX_Y"}
    with pytest.warns(UserWarning, match="'CURRENT_FIX_DURATION' is not read"):
        (record,) = read_fixations(path, columns=named, size=(80, 60))
    assert (record.points.tolist(), record.durations) == ([[40, 30]], None)


def test_a_file_tells_its_reader(tmp_path):
    records = people(3)
    write_table(tmp_path / "a.csv", records)
    write_osie(tmp_path / "b.json", records)
    write_cocosearch(tmp_path / "c.json", [replace(each, size=(1680, 1050)) for each in records])
    (tmp_path / "d.asc").write_text("MSG 1 DISPLAY_COORDS 0 0 799 599\nMSG 2 TRIALID 1\nEFIX R 10 209 200 5.5 3.5 1\n")
    for name in ("a.csv", "b.json", "c.json"):
        read = read_fixations(tmp_path / name)
        assert all(np.allclose(one.points, other.points) for one, other in zip(read, records, strict=True))
    assert read_fixations(tmp_path / "d.asc")[0].points.tolist() == [[5.5, 3.5]]
    for text, said in (
        ("3", "expected JSON, a list or an object"),
        ('{"a": [', "as JSON.*it was read as a file of OSIE"),
    ):
        (tmp_path / "e.json").write_text(text)
        unusable(said, read_fixations, tmp_path / "e.json")


def test_pictures_at_their_own_size_are_told_with_their_sizes_and_without():
    """400 × 300 in the middle of 800 × 600: without sizes by the empty border, with them by the pictures."""
    own = moved(lambda points: (points + 0.5) / 2 + [200, 150] - 0.5)
    said = "shown at their own size (Fixations.in_picture with scale=1), or are the points in degrees?"
    (line,) = suspicions(own)
    assert line.startswith("fixations fill ")
    assert said in line
    sizes = {each.picture: (400, 300) for each in own}
    (line,) = suspicions(own, sizes)
    assert "such as 400 × 300 in 800 × 600 of 0.jpg: was it shown at its own size?" in line
    assert all(each.in_picture((400, 300), scale=1).inside.all() for each in own)
    assert suspicions(people(), sizes) == []
    # Of one picture people may look at the middle alone.
    one = [replace(each, picture="a.jpg", subject=each.picture) for each in own]
    assert suspicions(one) == []
    assert len(suspicions(one, {"a.jpg": (400, 300)})) == 1


DRAWN = np.random.default_rng(0).normal((400, 300), (180, 130), (400, 2)).clip(0, (799, 599))
"""Fixations in a picture of 800 × 600."""


@pytest.mark.parametrize(
    ("shown", "frame", "said"),
    [
        (DRAWN + np.array([560, 240]), (1920, 1080), "at its own size"),
        (DRAWN, (1920, 1080), "no fixation lies beyond the pixels of its picture"),
        (DRAWN * 1.8 + (240, 0), (1920, 1080), "no x lies in 13 %"),
        (
            DRAWN * 1.5 + (360, 90),
            (1920, 1080),
            r"other proportions .* \(Fixations.in_picture; with scale=1 at its own size",
        ),
        ((DRAWN - (400, 300)) / 35, (1920, 1080), "points look like degrees from the centre"),
        (DRAWN - (400, 300), (1920, 1080), "points look like pixels from the centre"),
    ],
    ids=["own size", "own size in the corner", "letterboxed", "smaller", "degrees", "centre"],
)
def test_where_a_picture_was_shown_is_said_once(shown, frame, said):
    """What is clear from the fixations is not asked again by proportions that differ."""
    people = [Fixations("a.jpg", str(n), shown[n::20], frame) for n in range(20)]
    first, *others = suspicions(people, {"a.jpg": (800, 600)})
    assert re.search(said, first)
    assert all("letterboxed" in first and "letterboxed" in other for other in others)


def test_a_check_says_in_which_encoding_names_were_read_and_which_column_was_not(tmp_path, capsys):
    path = tmp_path / "export.csv"
    text = "picture,subject,x,y,width,height,fixation duration\ncafé.jpg,Zoë,40,30,80,60,250\n"
    path.write_bytes(text.encode("cp1252"))
    main(["check", str(path)])
    told = capsys.readouterr().err
    assert "is not UTF-8" in told
    assert "the column 'fixation duration' is not read" in told
