"""A scanpath beside people: each measure is the mean of its function over pairs, and orders scanpaths as expected."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from semfov import Grid, InputError
from semfov.data.fixations import Fixations, Letterbox, write_table
from semfov.metrics.scanpath import cell_labels, compare_scanpath, edit_distance, multimatch, sequence_score
from tests import small
from tests.refusals import refused

SIZE = (800, 600)


def people(count=4, noise=12.0, seed=0):
    """Scanpaths through the same five places, with noise."""
    generator = np.random.default_rng(seed)
    places = np.array([[400.0, 300.0], [120.0, 100.0], [640.0, 150.0], [600.0, 500.0], [200.0, 450.0]])
    paths = [places[: 5 - n % 2] + generator.normal(0, noise, (5 - n % 2, 2)) for n in range(count)]
    return [Fixations("a.jpg", str(n), path, SIZE) for n, path in enumerate(paths)]


_DISTANCES = {"edit distance", "time warping", "time delay embedding", "saccade lengths", "saccade directions"}


def test_measures_of_pairs_are_means_over_people():
    mine, *others = people(4)
    table = compare_scanpath(mine, others)
    words = [cell_labels(each.points, 8, 8, SIZE) for each in (mine, *others)]
    matched = [multimatch(mine.points, each.points, SIZE) for each in others]
    expected = {f"MultiMatch {name}": [getattr(each, name) for each in matched] for name in matched[0]._fields[:4]}
    expected["sequence score"] = [sequence_score(words[0], word) for word in words[1:]]
    expected["edit distance"] = [edit_distance(words[0], w) / max(len(words[0]), len(w)) for w in words[1:]]
    for name, values in expected.items():
        assert table[name].scanpath == pytest.approx(np.mean(values)), name
    among = [sequence_score(a, b) for n, a in enumerate(words[1:]) for m, b in enumerate(words[1:]) if n != m]
    assert table["sequence score"].people == pytest.approx(np.mean(among))


def test_a_person_is_nearer_to_people_than_a_random_scanpath_in_any_size():
    mine, *others = people(5)
    generator = np.random.default_rng(1)
    noise = Fixations("a.jpg", "noise", generator.uniform((0, 0), SIZE, (5, 2)) - 0.5, SIZE)
    person, random = compare_scanpath(mine, others), compare_scanpath(noise, others)
    for name, worse in random.items():
        assert (
            (person[name].scanpath < worse.scanpath) if name in _DISTANCES else (person[name].scanpath > worse.scanpath)
        ), name
        assert person[name].people == worse.people
    smaller = compare_scanpath(mine.resized((400, 300)), others)
    assert all(smaller[name] == pytest.approx(person[name]) for name in person)
    alone = compare_scanpath(mine, others[:1])
    assert np.isnan(alone["NSS"].people)
    assert "nan: too few people" in str(alone)


def test_other_pictures_and_fixations_in_another_unit_are_told():
    mine, *others = people(3)
    refused(r"^people: expected fixations of at least one person", compare_scanpath, mine, [])
    with pytest.raises(InputError, match=r"^people: expected fixations in one picture"):
        compare_scanpath(mine, [*others, Fixations("b.jpg", "1", mine.points, SIZE)])
    shifted = Fixations("a.jpg", "1", mine.points * 3, SIZE)
    with pytest.warns(UserWarning, match=r"^scanpath: \d of 5 fixations \(\d+ %\) lie far outside their frame"):
        compare_scanpath(shifted, others)


def test_a_record_is_compared_by_itself_and_printed_as_a_table():
    grid = Grid(10, 10, SIZE)
    scanpath = small.scanpath(grid, torch.tensor([55, 11, 27, 87]), ("background", "cup"), target=1)
    others = people(3)
    table = scanpath.compare(others)
    assert table == compare_scanpath(scanpath.as_fixations("a.jpg"), others)
    assert str(table).splitlines()[0].split() == ["measure", "scanpath", "people"]
    assert len(str(table).splitlines()) == 1 + len(table)
    assert replace(scanpath, source="folder/a.png").compare(others) == table
    refused("people: expected fixations in 'b', got in 'a.jpg'", replace(scanpath, source="b.png").compare, others)


def test_people_are_given_as_one_record_or_as_a_table(tmp_path):
    """Of a table those in the picture are taken."""
    mine, *others = people(3)
    write_table(tmp_path / "t.csv", [*others, Fixations("b.jpg", "1", mine.points, SIZE)])
    assert compare_scanpath(mine, tmp_path / "t.csv") == compare_scanpath(mine, others)
    one = compare_scanpath(mine, others[0])
    assert one["sequence score"].scanpath == compare_scanpath(mine, others[:1])["sequence score"].scanpath
    with pytest.raises(InputError, match=r"people: expected fixations in 'c', got others, such as those in 'a\.jpg'"):
        compare_scanpath(replace(mine, picture="c.jpg"), tmp_path / "t.csv")


def test_what_cannot_be_compared_is_refused():
    mine, *others = people(3)
    for changes, said in (
        ({"picture": "b.jpg"}, "people: expected fixations in 'b', got in 'a.jpg'"),
        ({"target": "cup"}, "people: expected searches for one target, got for 'cup', 'fork'"),
        ({"size": (1680, 1050)}, "people: expected frames with the proportions of 1680 × 1050 .*, got 800 × 600"),
    ):
        theirs = [replace(each, target="fork") for each in others] if "target" in changes else others
        refused(said, compare_scanpath, replace(mine, **changes), theirs)
        with pytest.raises(InputError, match="people: expected"):
            compare_scanpath(mine, [replace(others[0], **changes), replace(others[1], target="fork")])
    placed = replace(mine, points=Letterbox((1680, 1050), SIZE).to_screen(mine.points), size=(1680, 1050))
    back = compare_scanpath(placed.in_picture(SIZE), [mine, *others])
    assert back["sequence score"].scanpath == compare_scanpath(mine, [mine, *others])["sequence score"].scanpath
    rounded = compare_scanpath(mine.resized((641, 480)), others)
    assert rounded["AUC"].scanpath == pytest.approx(compare_scanpath(mine, others)["AUC"].scanpath, abs=0.01)


def test_pictures_are_the_same_in_whatever_folder_a_tracker_saw_them():
    path = Fixations("a.jpg", "1", np.array([[10.0, 10], [60, 10], [60, 40]]), (80, 60))
    for name in ("a", "b/a.png", "C:\\pictures\\a.jpg"):
        assert compare_scanpath(path, [replace(path, picture=name)])["sequence score"].scanpath == 1
    refused(
        "people: expected fixations in 'a', got in", compare_scanpath, path, [replace(path, picture="C:\\a\\b.jpg")]
    )
