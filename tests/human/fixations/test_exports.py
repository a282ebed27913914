"""Tables of eye trackers' programs and text files of EyeLink: small files in their forms, and the fixations in them."""

import numpy as np
import pytest

from semfov.data.fixations import read_export, read_eyelink
from semfov.errors import DataError
from tests.refusals import refused, unusable

SIZE = (1920, 1080)
TOBII = "\t".join(
    ["Recording timestamp [ms]", "Participant name", "Recording name", "Recording resolution width",
     "Recording resolution height", "Eye movement type", "Eye movement type index", "Gaze event duration [ms]",
     "Fixation point X [DACS px]", "Fixation point Y [DACS px]", "Presented Stimulus name"]
)  # fmt: skip
STUDIO = "\t".join(
    ["ParticipantName", "RecordingName", "MediaName", "MediaWidth", "MediaHeight", "FixationIndex", "GazeEventType",
     "GazeEventDuration", "FixationPointX (MCSpx)", "FixationPointY (MCSpx)"]
)  # fmt: skip
CLOUD = "section id,recording id,fixation id,start timestamp [ns],end timestamp [ns],duration [ms]"

FILES = {
    "Tobii Pro Lab": (
        f"{TOBII}\n0\tP1\tR1\t1920\t1080\tFixation\t1\t250\t100\t200\ta.jpg\n"
        "8\tP1\tR1\t1920\t1080\tFixation\t1\t250\t100\t200\ta.jpg\n16\tP1\tR1\t1920\t1080\tSaccade\t1\t30\t\t\ta.jpg\n"
        "20\tP1\tR1\t1920\t1080\tFixation\t2\t300\t640\t360,5\ta.jpg\n",
        {},
        ("a.jpg", "P1", SIZE, [[100, 200], [640, 360.5]], [250, 300]),
    ),
    "Tobii Pro Lab, on the picture": (
        "Participant name\tEye movement type\tEye movement type index\tGaze event duration\tFixation point X (MCSnorm)"
        "\tFixation point Y (MCSnorm)\tPresented Media name\tPresented Media width\tPresented Media height\n"
        "P1\tFixation\t1\t250\t0.5\t0.25\ta.jpg\t800\t600\nP1\tEyesNotFound\t1\t50\t\t\ta.jpg\t800\t600\n",
        {},
        ("a.jpg", "P1", (800, 600), [[399.5, 149.5]], [250]),
    ),
    "Tobii Studio": (
        f"{STUDIO}\nP1\tR1\ta.jpg\t800\t600\t1\tFixation\t250\t100\t200\nP1\tR1\ta.jpg\t800\t600\t\tSaccade\t30\t\t\n"
        "P1\tR1\ta.jpg\t800\t600\t2\tFixation\t300\t110\t210\n",
        {},
        ("a.jpg", "P1", (800, 600), [[100, 200], [110, 210]], [250, 300]),
    ),
    "Pupil Cloud": (
        f"{CLOUD},fixation x [px],fixation y [px],azimuth [deg]\ns1,r1,1,10,20,250,800.25,600.5,1.0\n"
        "s1,r1,2,30,40,300,,,\ns1,r1,3,50,60,310,10,20,1.0\n",
        {"size": (1600, 1200), "picture": "scene.mp4"},
        ("scene.mp4", "r1", (1600, 1200), [[800.25, 600.5], [10, 20]], [250, 310]),
    ),
    "Pupil Cloud, reference image": (
        f"{CLOUD},fixation detected in reference image,fixation x [px],fixation y [px]\n"
        "s1,r1,1,10,20,250,True,300,200\ns1,r1,2,30,40,300,False,,\n",
        {"size": (800, 600), "picture": "shelf.jpg"},
        ("shelf.jpg", "r1", (800, 600), [[300, 200]], [250]),
    ),
    "Pupil Cloud, surface": (
        f"{CLOUD},fixation detected on surface,fixation x [normalized],fixation y [normalized]\n"
        "s1,r1,1,10,20,250,True,0.5,0.25\ns1,r1,2,30,40,300,False,1.5,0.5\n",
        {"size": (800, 600), "picture": "shelf.jpg"},
        ("shelf.jpg", "r1", (800, 600), [[399.5, 149.5]], [250]),
    ),
    "Pupil Player": (
        "id,start_timestamp,duration,start_frame_index,end_frame_index,norm_pos_x,norm_pos_y,dispersion,confidence\n"
        "1,5.1,240.5,3,9,0.5,0.75,1.1,0.99\n2,5.6,120,10,14,0.25,0.25,1.2,0.98\n",
        {"size": (1280, 720), "picture": "world.mp4"},
        ("world.mp4", "ann", (1280, 720), [[639.5, 179.5], [319.5, 539.5]], [240.5, 120]),
    ),
    "Pupil Player, surface": (
        "world_timestamp,world_index,fixation_id,start_timestamp,duration,dispersion,norm_pos_x,norm_pos_y,x_scaled,"
        "y_scaled,on_surf\n1.0,3,7,0.9,240,1.1,0.5,0.75,0.5,0.75,True\n1.1,4,7,0.9,240,1.1,0.5,0.75,0.5,0.75,True\n"
        "1.2,5,8,1.2,300,1.1,1.5,0.75,1.5,0.75,False\n",
        {"size": (800, 600), "picture": "shelf.jpg"},
        ("shelf.jpg", "ann", (800, 600), [[399.5, 149.5]], [240]),
    ),
    "PsychoPy": (
        "experiment_id,session_id,device_id,event_id,type,time,eye,duration,average_gaze_x,average_gaze_y,cond\n"
        "1,2,0,30,54,11.5,22,0.25,-100.0,50.0,b.png\n1,2,0,31,54,12.0,22,0.125,0.0,0.0,b.png\n",
        {"size": SIZE, "columns": {"picture": "cond"}},
        ("b.png", "2", SIZE, [[859.5, 489.5], [959.5, 539.5]], [250, 125]),
    ),
    "Gazepoint": (
        "MEDIA_ID,MEDIA_NAME,CNT,FPOGX,FPOGY,FPOGS,FPOGD,FPOGID,FPOGV\n0,a.jpg,0,0.5,0.5,0,0.01,1,1\n"
        "0,a.jpg,1,0.5,0.25,0,0.2,1,1\n0,a.jpg,2,0.9,0.9,0,0.1,2,0\n",
        {"size": SIZE},
        ("a.jpg", "ann", SIZE, [[959.5, 269.5]], [200]),
    ),
    "PyGaze": (
        "trialnr,starttime,endtime,duration,endx,endy\n1,100,350,250,512.5,384\n1,400,600,200,100,90\n",
        {"size": (1024, 768), "picture": "a.png", "columns": {"trial": "trialnr"}},
        ("a.png", "ann", (1024, 768), [[512.5, 384], [100, 90]], [250, 200]),
    ),
    "pymovements": (
        "subject_id,trial,stimulus,name,onset,offset,duration,location_x,location_y\n"
        "7,1,a.png,fixation_ivt,0,250,250,512.5,384\n7,1,a.png,saccade,250,270,20,,\n7,1,a.png,fixation,270,370,100,10,20\n",
        {"size": (1024, 768)},
        ("a.png", "7", (1024, 768), [[512.5, 384], [10, 20]], [250, 100]),
    ),
    "pymovements, pairs": (
        'name,onset,offset,duration,location\nfixation,0,250,250,"[512.5, 384.0]"\n',
        {"size": (1024, 768), "picture": "a.png"},
        ("a.png", "ann", (1024, 768), [[512.5, 384]], [250]),
    ),
    "EyeLink Data Viewer": (
        "RECORDING_SESSION_LABEL\tTRIAL_INDEX\timage\tCURRENT_FIX_X\tCURRENT_FIX_Y\tCURRENT_FIX_DURATION\n"
        "ann\t1\ta.jpg\t512.3\t384.1\t200\nann\t1\ta.jpg\t.\t.\t200\n",
        {"size": (1024, 768)},
        ("a.jpg", "ann", (1024, 768), [[512.3, 384.1]], [200]),
    ),
}  # fmt: skip


@pytest.mark.parametrize("program", FILES)
def test_fixations_of_a_program(tmp_path, program):
    text, arguments, (picture, subject, size, points, durations) = FILES[program]
    (tmp_path / "ann.csv").write_text(text, encoding="utf-8-sig")
    (record,) = read_export(tmp_path / "ann.csv", **arguments)
    assert (record.picture, record.subject, record.size) == (picture, subject, size)
    assert np.allclose(record.points, points)
    assert np.allclose(record.durations, durations)


def test_viewings_are_told_apart(tmp_path):
    """By picture, person and trial; a picture that comes again later is another viewing."""
    rows = ["P1,1,a.jpg", "P1,1,b.jpg", "P1,1,b.jpg", "P1,1,a.jpg", "P2,1,a.jpg", "P2,2,a.jpg"]
    head = "subject_id,trial,stimulus,name,onset,offset,duration,location_x,location_y"
    lines = [f"{row},fixation,0,9,9,{place},{place}" for place, row in enumerate(rows)]
    (tmp_path / "a.csv").write_text("\n".join([head, *lines]))
    records = read_export(tmp_path / "a.csv", size=(80, 60))
    assert [len(each) for each in records] == [1, 2, 1, 1, 1]


@pytest.mark.parametrize("names", [("21", "22"), ("EyeTrackerConstants.LEFT_EYE", "b'RIGHT'"), ("L", "R")])
def test_fixations_of_both_eyes_are_those_of_one(tmp_path, names):
    """The right one where a viewing has both; b.png was seen by the left one alone."""
    left, right = names
    rows = [(left, 1, "a"), (right, 2, "a"), (left, 3, "a"), (right, 4, "a"), (left, 5, "b")]
    head = "session_id,eye,duration,average_gaze_x,average_gaze_y,cond"
    (tmp_path / "a.csv").write_text("\n".join([head, *(f"2,{eye},0.2,{x},0,{name}.png" for eye, x, name in rows)]))
    known = {"size": (101, 101), "columns": {"picture": "cond"}}
    for eye, expected in ((None, [[2, 4], [5]]), ("right", [[2, 4]]), ("left", [[1, 3], [5]])):
        records = read_export(tmp_path / "a.csv", eye=eye, **known)
        assert [(each.points[:, 0] - 50).tolist() for each in records] == expected
    (tmp_path / "a.csv").write_text("\n".join([head, f"2,{left},0.2,1,0,a.png"]))
    with pytest.raises(DataError, match="expected fixations of the right eye, got those of the other one"):
        read_export(tmp_path / "a.csv", eye="right", **known)


def test_what_is_missing_is_named(tmp_path):
    text, _, _ = FILES["Pupil Cloud"]
    (tmp_path / "a.csv").write_text(text)
    unusable("Pupil Cloud does not give, got none; give picture=", read_export, tmp_path / "a.csv", size=(1600, 1200))
    unusable("Pupil Cloud does not give; give size=", read_export, tmp_path / "a.csv", picture="scene.mp4")
    (tmp_path / "b.csv").write_text("picture,x,y\na.jpg,1,2\n")
    unusable("expected the columns of a table of Tobii Pro Lab", read_export, tmp_path / "b.csv")
    (tmp_path / "c.csv").write_text(f"{CLOUD},fixation x [px],fixation y [px]\ns1,r1,1,10,20,250,,\n")
    with pytest.raises(DataError, match="expected fixations of Pupil Cloud, got none"):
        read_export(tmp_path / "c.csv", size=(1600, 1200), picture="scene.mp4")
    (tmp_path / "d.csv").write_text(f"{CLOUD},fixation x [px],fixation y [px]\ns1,r1,1,10,20,250,left,3\n")
    with pytest.raises(DataError, match=r"line 2, x: expected a number, got 'left'"):
        read_export(tmp_path / "d.csv", size=(1600, 1200), picture="scene.mp4")


HEAD = """** CONVERTED FROM D:\\data\\ann.edf using edfapi 4.2.1
** DATE: Wed Nov 25 10:00:00 2026
MSG\t2156250 DISPLAY_COORDS 0 0 1023 767
EFIX R   2156251\t2156260\t10\t   1.0\t   1.0\t   900
"""
TRIALS = """MSG\t2156300 TRIALID 1
MSG\t2156310 !V IMGLOAD FILL images\\a b.jpg
START\t2156320 \tLEFT\tRIGHT\tSAMPLES\tEVENTS
SFIX L   2156321
EFIX L   2156321\t2156500\t180\t  510.3\t  380.1\t   1200
EFIX R   2156322\t2156520\t200\t  512.3\t  384.1\t   1210
SBLINK R 2156530
EBLINK R 2156530\t2156560\t32
EFIX R   2156570\t2156600\t32\t   .\t   .\t   0
EFIX R   2156620\t2156900\t282\t  100.0\t   50.5\t   1200
MSG\t2157000 TRIAL_RESULT 0
MSG\t2157100 TRIALID 2 b.jpg
EFIX R   2157120\t2157900\t782\t  9.0\t   8.5\t   1200
MSG\t2158000 TRIALID 3
MSG\t2158001 !V TRIAL_VAR image c.jpg
END\t2158002 \tSAMPLES\tEVENTS\tRES\t  38.54\t  31.12
"""


def test_trials_have_their_picture_and_one_eye(tmp_path):
    path = tmp_path / "ann.asc"
    path.write_text(HEAD + TRIALS)
    first, second = read_eyelink(path)
    assert (first.picture, second.picture, first.subject, first.size) == ("a b.jpg", "2 b.jpg", "ann", (1024, 768))
    np.testing.assert_array_equal(first.points, [[512.3, 384.1], [100.0, 50.5]])
    np.testing.assert_array_equal(first.durations, [200, 282])
    with pytest.warns(UserWarning, match="1 of 2 pictures have no fixation of the left eye"):
        (left,) = read_eyelink(path, eye="left", subject="7")
    assert (left.subject, left.points.tolist(), left.durations.tolist()) == ("7", [[510.3, 380.1]], [180])


def test_points_are_counted_from_the_first_corner_of_the_frame(tmp_path):
    path = tmp_path / "a.asc"
    path.write_text(HEAD.replace("0 0 1023 767", "10 20 809 619") + TRIALS)
    record = read_eyelink(path)[0]
    assert (record.size, record.points[0].tolist()) == ((800, 600), pytest.approx([502.3, 364.1]))
    path.write_text(TRIALS)
    assert read_eyelink(path, size=(1024, 768))[0].size == (1024, 768)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (TRIALS, "expected a message DISPLAY_COORDS, got none; give size="),
        (HEAD, "expected lines EFIX after a message TRIALID"),
        (HEAD + "MSG\t1 TRIALID 1\nEFIX R 10 20 10 x y 3\n", "line 6: expected an event of EyeLink"),
        (HEAD + "MSG\t1 TRIALID 1\nEFIX R 10\n", "line 6: expected an event of EyeLink"),
        ("EFIX\n\0", "expected lines EFIX"),
    ],
)
def test_what_is_no_recording_is_refused(tmp_path, content, said):
    (tmp_path / "a.asc").write_text(content)
    unusable(said, read_eyelink, tmp_path / "a.asc")


def test_a_size_may_be_an_array(tmp_path):
    (tmp_path / "a.asc").write_text(HEAD + "MSG\t1 TRIALID 1 b.jpg\nEFIX L 1 2 1 5 5 5\n")
    (record,) = read_eyelink(tmp_path / "a.asc", size=np.array([800, 600]))
    assert record.size == (800, 600)


def test_other_arguments_are_refused(tmp_path):
    (tmp_path / "a.asc").write_text(HEAD + "MSG\t1 TRIALID 1\nEFIX L 1 2 1 5 5 5\n")
    unusable("expected fixations of the right eye", read_eyelink, tmp_path / "a.asc", eye="right")
    refused("eye: expected 'left', 'right' or None", read_eyelink, tmp_path / "a.asc", eye="both")


def test_names_of_pictures_may_be_in_the_encoding_of_windows(tmp_path):
    text = (HEAD + TRIALS).replace("a b.jpg", "übung.jpg")
    path = tmp_path / "ann.asc"
    for encoding in ("utf-8", "utf-16"):
        path.write_bytes(text.encode(encoding))
        assert "übung.jpg" in {record.picture for record in read_eyelink(path)}
    path.write_bytes(text.encode("cp1252"))
    with pytest.warns(UserWarning, match=r"is not UTF-8, .* such as 'übung\.jpg'"):
        assert "übung.jpg" in {record.picture for record in read_eyelink(path)}


LOADS = """MSG\t1000 DISPLAY_COORDS 0 0 1023 767
MSG\t1001 TRIALID 1
MSG\t1002 !V IMGLOAD FILL cross.png
START\t1003 \tLEFT\tSAMPLES\tEVENTS
EFIX L   1010\t1200\t190\t  511.0\t  383.0\t   1200
MSG\t1500 -250 !V IMGLOAD CENTER pictures/big cat 2.jpg 512 384 800 600
EFIX L   1600\t1900\t300\t  112.0\t  84.0\t   1200
EFIX L   1760\t2000\t240\t  612.0\t  184.0\t   1200
MSG\t2200 !V CLEAR 128 128 128
EFIX L   2210\t2300\t90\t  1.0\t  1.0\t   1200
MSG\t2400 TRIAL_RESULT 0
EFIX L   2500\t2600\t100\t  2.0\t  2.0\t   1200
MSG\t3000 TRIALID 2
MSG\t3001 !V IMGLOAD TOP_LEFT b.jpg 100 50
EFIX R   3100\t3300\t200\t  300.0\t  200.0\t   1200
END\t3500 \tSAMPLES\tEVENTS\tRES\t  38.54\t  31.12
EFIX R   3600\t3700\t100\t  3.0\t  3.0\t   1200
"""


def test_fixations_are_of_the_picture_that_is_on_the_screen_when_they_begin(tmp_path):
    """A message that is late by -250 ms is of 1750 ms; the eye is that of each trial."""
    (tmp_path / "a.asc").write_text(LOADS)
    cross, cat, second = read_eyelink(tmp_path / "a.asc")
    assert [each.picture for each in (cross, cat, second)] == ["cross.png", "big cat 2.jpg", "b.jpg"]
    assert (cross.points.tolist(), cat.points.tolist()) == ([[511, 383], [112, 84]], [[500, 100]])
    (tmp_path / "a.asc").write_text(LOADS.replace("1500 -250 !V", "1500 10 !V"))
    cross, cat, second = read_eyelink(tmp_path / "a.asc")
    assert (cross.points.tolist(), cross.size, cross.durations.tolist()) == ([[511, 383]], (1024, 768), [190])
    assert (cat.points.tolist(), cat.size) == ([[0, 0], [500, 100]], (800, 600))
    assert (second.points.tolist(), second.size) == ([[300, 200]], (1024, 768))


def test_what_was_lost_or_shown_at_no_time_is_said(tmp_path):
    (tmp_path / "a.asc").write_text(LOADS.replace("1500 -250", "1500") + "MSG\t4000 MESSAGES LOST 3\n")
    with pytest.warns(UserWarning, match=r"messages or data were lost \(line 18\)"):
        assert len(read_eyelink(tmp_path / "a.asc")) == 3
    late = LOADS.replace("1500 -250", "1500").replace("3001 !V", "3400 !V")
    (tmp_path / "a.asc").write_text(late)
    with pytest.warns(UserWarning, match=r"the fixations of 1 of 2 trials, such as that of b\.jpg, are left out"):
        assert [each.picture for each in read_eyelink(tmp_path / "a.asc")] == ["cross.png", "big cat 2.jpg"]
