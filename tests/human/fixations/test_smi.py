"""Texts of SMI's IDF Event Detector: small ones in its form, and the fixations in them."""

import pytest

from semfov.data.fixations import read_export, read_fixations
from tests.refusals import unusable

HEAD = """[BeGaze]
Converted from:\tC:\\data\\ann.idf
Date:\t25.11.2012 10:00:00
Version:\tIDF Event Detector 3.0.17
Sample Rate:\t250
Subject:\tAnn
Description:\t

Table Header for Fixations:
Event Type\tTrial\tNumber\tStart\tEnd\tDuration\tLocation X\tLocation Y\tDispersion X\tDispersion Y\tPlane\tAvg Pupil X

Table Header for Saccades:
Event Type\tTrial\tNumber\tStart\tEnd\tDuration\tStart Loc.X\tStart Loc.Y\tEnd Loc.X\tEnd Loc.Y\tAmplitude

Table Header for User Events:
Event Type\tTrial\tNumber\tStart\tDescription

"""
EVENTS = """UserEvent\t1\t1\t1000\t# Message: pictures\\big cat.jpg
Fixation L\t1\t1\t900\t1400\t500\t1.00\t2.00\t3\t4\t-1\t17.1
Fixation L\t1\t2\t2000\t252000\t250000\t100.50\t200.25\t3\t4\t-1\t17.1
Fixation R\t1\t1\t2100\t242100\t240000\t102.50\t201.25\t3\t4\t-1\t17.1
Saccade L\t1\t1\t252000\t272000\t20000\t100.5\t200.25\t400.00\t300.00\t4.1
UserEvent\t1\t2\t260000\t# Message: UE-keypress Space
Fixation L\t1\t3\t272000\t572000\t300000\t400.00\t300.00\t3\t4\t-1\t17.1
Fixation R\t1\t2\t272100\t571100\t299000\t402.00\t301.00\t3\t4\t-1\t17.1
UserEvent\t2\t3\t600000\t# Message: b.jpg
Blink L\t2\t1\t610000\t650000\t40000
Fixation L\t2\t4\t700000\t900000\t200000\t10.00\t20.00\t3\t4\t-1\t17.1
Fixation L\t3\t5\t950000\t990000\t40000\t840.00\t525.00\t3\t4\t-1\t17.1
"""
SIZE = (1680, 1050)
LEFT_OUT = "2 of 5 fixations are left out, as 'Stimulus' names no picture"


def variants():
    """The text as it is, in the order of kinds, with the signs of the converter, and with other separators."""
    events = EVENTS.splitlines(keepends=True)
    yield "as it is", HEAD + EVENTS
    yield "messages last", HEAD + "".join(sorted(events))
    yield "signs of the converter", "".join(f"## {line}" for line in HEAD.splitlines(keepends=True)) + EVENTS
    yield "commas", (HEAD + EVENTS).replace("\t", ",")
    yield "decimal commas", HEAD + "".join(line if "Message" in line else line.replace(".", ",") for line in events)
    yield "lines of Windows", (HEAD + EVENTS).replace("\n", "\r\n")


@pytest.mark.parametrize(("text"), [text for _, text in variants()], ids=[name for name, _ in variants()])
def test_fixations_are_of_the_picture_of_the_last_message_in_their_trial(tmp_path, text):
    """The first fixation begins before the first picture, and the last one is in a trial without any."""
    (tmp_path / "ann Events.txt").write_bytes(text.encode())
    with pytest.warns(UserWarning, match=LEFT_OUT):
        cat, second = read_fixations(tmp_path / "ann Events.txt", size=SIZE)
    assert (cat.picture, cat.subject, cat.size) == ("big cat.jpg", "Ann", SIZE)
    assert (cat.points.tolist(), cat.durations.tolist()) == ([[102.5, 201.25], [402, 301]], [240, 299])
    assert (second.picture, second.points.tolist(), second.durations.tolist()) == ("b.jpg", [[10, 20]], [200])
    with pytest.warns(UserWarning, match="2 of 5 fixations"):
        cat, _ = read_fixations(tmp_path / "ann Events.txt", size=SIZE, eye="left")
    assert (cat.points.tolist(), cat.durations.tolist()) == ([[100.5, 200.25], [400, 300]], [250, 300])


def test_the_screen_is_that_of_the_calibration_where_the_text_has_it(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text(HEAD + EVENTS)
    with pytest.warns(UserWarning, match="2 of 5 fixations"):
        unusable("SMI IDF Event Detector does not give; give size=", read_export, path)
    path.write_text(HEAD.replace("Description:\t", "Calibration Area:\t1024\t768") + EVENTS)
    with pytest.warns(UserWarning, match="2 of 5 fixations"):
        assert {record.size for record in read_export(path)} == {(1024, 768)}


def test_a_text_without_messages_needs_a_picture_or_the_numbers_of_its_trials(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text(HEAD + "".join(line for line in EVENTS.splitlines(keepends=True) if "Message" not in line))
    unusable(r"does not give, got none; give picture=, or name its column by", read_export, path, size=SIZE)
    by_trial = read_export(path, size=SIZE, columns={"picture": "Trial"}, eye="left")
    assert [(record.picture, len(record)) for record in by_trial] == [("1", 3), ("2", 1), ("3", 1)]
    named = read_export(path, size=SIZE, picture="a.jpg", eye="left")
    assert [(record.picture, len(record)) for record in named] == [("a.jpg", 3), ("a.jpg", 1), ("a.jpg", 1)]


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("\t17.1\n", "\n", "line 19: expected 12 fields, got 11"),
        ("\t2000\t", "\tsoon\t", "line 20: expected the time of an event, got 'soon'"),
        ("\t600000\t", "\tnan\t", "line 26: expected the time of an event, got 'nan'"),
        ("102.50", "here", "line 21, x: expected a number, got 'here'"),
        (
            "Event Type\tTrial\tNumber",
            "Event Type\tNumber",
            "begin with Event Type, Trial, Number, Start, got Event Type",
        ),
    ],
)
@pytest.mark.filterwarnings("ignore:.*2 of 5 fixations")
def test_lines_that_are_damaged_are_named(tmp_path, old, new, said):
    (tmp_path / "a.txt").write_text((HEAD + EVENTS).replace(old, new, 1))
    unusable(said, read_fixations, tmp_path / "a.txt", size=SIZE)


def test_samples_are_told_from_events(tmp_path):
    head = "## [BeGaze]\n## Version:\tBeGaze 3.7.40\n##\nTime\tType\tTrial\tL POR X [px]\tL POR Y [px]\tStimulus\n"
    (tmp_path / "a.txt").write_text(head + "10000\tSMP\t1\t850.71\t717.53\ta.bmp\n")
    unusable("these look like samples, in which fixations are to be found first", read_fixations, tmp_path / "a.txt")
