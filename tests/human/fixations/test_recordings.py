"""A corpus of headers of eye trackers' programs: numbers of fixations and pictures, and sums of durations."""

import warnings

import pytest

from semfov.data.fixations import read_fixations
from semfov.errors import DataError
from tests.refusals import unusable

SCREEN = "Recording resolution width\tRecording resolution height"
LAB = "Participant name\tRecording name\tEye movement type\tEye movement type index"
CLOUD = "section id,recording id,fixation id,start timestamp [ns],end timestamp [ns],duration [ms]"
SMI = "Trial\tStimulus\tParticipant\tCategory\tEye L/R\tIndex"
VIEWER = "RECORDING_SESSION_LABEL\tTRIAL_INDEX\tCURRENT_FIX_INDEX\tEYE_USED\tCURRENT_FIX_X\tCURRENT_FIX_Y"
GAZEPOINT = "MEDIA_ID,MEDIA_NAME,CNT,TIME(2024/03/05 11:22:33.444),TICK,FPOGX,FPOGY,FPOGS,FPOGD,FPOGID,FPOGV"


def lines(head, row, count=10):
    """A table of fixations 1, 2, … by a pattern of their lines; the fourth is in another picture from the sixth on."""
    rows = [row.format(n=n, x=100 + n, y=200 + n, time=200 + n, picture="a.png" if n < 6 else "b.png")
            for n in range(1, count + 1)]  # fmt: skip
    return "\n".join([head, *rows]) + "\n"


SUM = float(sum(range(201, 211)))
"""Milliseconds of the ten fixations of 201, 202, … ms."""

TABLES = {
    "Tobii Pro Lab, brackets of a new version": (
        lines(
            f"{LAB}\t{SCREEN}\tPresented Stimulus name\tEye movement event duration [ms]\tFixation point X [DACS px]"
            "\tFixation point Y [DACS px]",
            "p\tr\tFixation\t{n}\t1920\t1080\t{picture}\t{time}\t{x}\t{y}",
        ),
        {},
    ),
    "Tobii Pro Lab, microseconds": (
        lines(
            f"{LAB}\tRecording resolution width [px]\tRecording resolution height [px]\tPresented Stimulus name\t"
            "Eye movement event duration [μs]\tFixation point X [DACS px]\tFixation point Y [DACS px]",
            "p\tr\tFixation\t{n}\t1920\t1080\t{picture}\t{time}000\t{x}\t{y}",
        ),
        {},
    ),
    "Tobii Pro Lab, the other sign for micro": (
        lines(
            f"{LAB}\t{SCREEN}\tPresented Stimulus name\tGaze event duration [\u00b5s]\tFixation point X\t"
            "Fixation point Y",
            "p\tr\tFixation\t{n}\t1920\t1080\t{picture}\t{time}000\t{x}\t{y}",
        ),
        {},
    ),
    "Tobii Pro Lab, fractions of the picture": (
        lines(
            f"{LAB}\tPresented Media name\tPresented Media width [px]\tPresented Media height [px]\t"
            "Gaze event duration [ms]\tFixation point X [MCS norm]\tFixation point Y [MCS norm]",
            "p\tr\tFixation\t{n}\t{picture}\t800\t600\t{time}\t0.5\t0.{n}",
        ),
        {},
    ),
    "Tobii Pro Lab, pixels of the picture": (
        lines(
            f"{LAB}\tPresented Media name\tPresented Media width\tPresented Media height\tGaze event duration\t"
            "Fixation point X (MCSpx)\tFixation point Y (MCSpx)",
            "p\tr\tFixation\t{n}\t{picture}\t800\t600\t{time}\t{x}\t{y}",
        ),
        {},
    ),
    "Tobii Pro Lab, decimal commas": (
        lines(
            f"{LAB}\tPresented Media name\tPresented Media width\tPresented Media height\tGaze event duration\t"
            "Fixation point X (MCSnorm)\tFixation point Y (MCSnorm)",
            "p\tr\tFixation\t{n}\t{picture}\t800\t600\t{time}\t0,5\t0,{n}",
        ),
        {},
    ),
    "Tobii Pro Lab, pixels of the picture without its size": (
        lines(
            f"{LAB}\tPresented Media name\tGaze event duration\tFixation point X [MCS px]\tFixation point Y [MCS px]",
            "p\tr\tFixation\t{n}\t{picture}\t{time}\t{x}\t{y}",
        ),
        {"size": (800, 600)},
    ),
    "Tobii Studio": (
        lines(
            "ParticipantName\tRecordingName\tMediaName\tMediaWidth\tMediaHeight\tFixationIndex\tGazeEventType\t"
            "GazeEventDuration\tFixationPointX (MCSpx)\tFixationPointY (MCSpx)",
            "p\tr\t{picture}\t800\t600\t{n}\tFixation\t{time}\t{x}\t{y}",
        ),
        {},
    ),
    "EyeLink Data Viewer": (
        lines(
            f"{VIEWER}\tCURRENT_FIX_DURATION\timage", "ann\t1\t{n}\tRIGHT\t{x}.5\t{y}.25\t{time}\t{picture}"
        ),
        {"size": (1024, 768)},
    ),
    "EyeLink Data Viewer, decimal commas": (
        lines(f"{VIEWER}\tCURRENT_FIX_DURATION\timagefile", "ann\t1\t{n}\tLEFT\t{x},5\t{y},25\t{time}\t{picture}"),
        {"size": (1024, 768)},
    ),
    "iMotions, fixations and saccades": (
        lines(
            "Fixation Index by Stimulus,Fixation X,Fixation Y,Fixation Duration,Saccade Index by Stimulus,"
            "Saccade Duration",
            "{n},{x}.5,{y}.5,{time}.0,,",
        )
        + ",,,,1,33.3\n",
        {"size": (1920, 1080), "picture": "a.png"},
    ),
    "Gazepoint, fixations alone": (
        lines("USER,MEDIA_ID,MEDIA_NAME,CNT,FPOGX,FPOGY,FPOGS,FPOGD,FPOGID,GSR_US,GSRV,",
              "U1,1,{picture},{n},0.5,0.25,0,.{time},{n},2.4,1,"),
        {"size": (1920, 1080)},
    ),
    "Tobii Pro Lab, pixels of the screen and fractions of the picture": (
        lines(
            f"{LAB}\t{SCREEN}\tPresented Stimulus name\tPresented Media width [px]\tPresented Media height [px]\t"
            "Gaze event duration [ms]\tFixation point X [DACS px]\tFixation point Y [DACS px]\t"
            "Fixation point X [MCS norm]\tFixation point Y [MCS norm]",
            "p\tr\tFixation\t{n}\t1920\t1080\t{picture}\t800\t600\t{time}\t960\t540\t0.5\t0.5",
        ),
        {},
    ),
    "SMI BeGaze": (
        lines(
            f"{SMI}\tEvent Start Trial Time [ms]\tEvent End Trial Time [ms]\tEvent Duration [ms]\t"
            "Fixation Position X [px]\tFixation Position Y [px]\tFixation Average Pupil Size X [px]",
            "Trial001\t{picture}\tp01\tFixation\tRight\t{n}\t100.1\t300.2\t{time}\t{x}.5\t{y}.5\t12.1",
        )
        + "Trial001\tb.png\tp01\tSaccade\tRight\t11\t300\t320\t20\t-\t-\t-\n",
        {"size": (1680, 1050)},
    ),
    "SMI BeGaze, glasses": (
        lines(
            f"{SMI}\tEvent Duration [ms]\tVisual Intake Position X [px]\tVisual Intake Position Y [px]",
            "Trial001\t{picture}\tp01\tVisual Intake\tRight\t{n}\t{time}\t{x}.5\t{y}.5",
        )
        + "Trial001\tb.png\tp01\tBlink\tRight\t11\t20\t-\t-\n",
        {"size": (1280, 960)},
    ),
    "SMI BeGaze, fixations alone": (
        lines(
            "Stimulus\tParticipant\tIndex\tEvent Duration [ms]\tFixation Position X [px]\tFixation Position Y [px]",
            "{picture}\tp01\t{n}\t{time}\t{x}.5\t{y}.5",
        ),
        {"size": (1680, 1050)},
    ),
    "SMI BeGaze, fixation details of an older version": (
        lines(
            "Trial,Subject,Color,Name,Stimulus,Start Time [ms],End Time [ms],Fixation Start [ms],Fixation Duration [ms]"
            ",Fixation End [ms],Position X,Position Y,Average Pupil Size [px] X,Eye L/R,Number",
            "Trial001,p01,Coral,Ann,{picture},0,900,1.5,{time},300.5,{x}.5,{y}.5,12.1,Left,{n}",
        ),
        {"size": (1680, 1050)},
    ),
    "REMoDNaV": (
        lines(
            "onset\tduration\tlabel\tstart_x\tstart_y\tend_x\tend_y\tamp\tpeak_vel\tmed_vel\tavg_vel",
            "{n}.5\t0.{time}\tFIXA\t{x}.5\t{y}.5\t{x}.0\t{y}.0\t0.1\t20.1\t3.0\t4.0",
        )
        + "11.5\t0.03\tSACC\t100\t200\t300\t400\t5.1\t200\t90\t80\n11.6\t0.4\tPURS\t1\t2\t3\t4\t5\t6\t7\t8\n",
        {"size": (1024, 768), "picture": "a.png"},
    ),
    "I2MC": (
        lines(
            "FixStart\tFixEnd\tFixDur\tXPos\tYPos\tFlankedByDataLoss\tFraction Interpolated\tWeightCutoff\tRMSxy\tBCEA"
            "\tFixRangeX\tFixRangeY\tParticipant\tTrial",
            "1\t{time}\t{time}\t{x}.5\t{y}.5\t0\t0\t2.1\t0.1\t0.1\t1\t1\tp01\t{picture}",
        ),
        {"size": (1024, 768), "columns": {"picture": "Trial"}},
    ),
    "Neon": (
        lines(
            f"{CLOUD},fixation x [px],fixation y [px],azimuth [deg],elevation [deg]",
            "s,r,{n},1,2,{time},{x},{y},1.5,2.5",
        ),
        {"size": (1600, 1200), "picture": "scene.mp4"},
    ),
    "Neon, reference image": (
        lines(
            f"{CLOUD},fixation detected in reference image,fixation x [px],fixation y [px]",
            "s,r,{n},1,2,{time},True,{x},{y}",
        ),
        {"size": (1600, 1200), "picture": "shelf.jpg"},
    ),
    "Pupil Player": (
        lines(
            "id,start_timestamp,duration,start_frame_index,end_frame_index,norm_pos_x,norm_pos_y,dispersion,confidence,method",
            "{n},5.1,{time},3,9,0.5,0.75,1.1,0.99,gaze",
        ),
        {"size": (1280, 720), "picture": "world.mp4"},
    ),
    "Gazepoint": (
        lines(GAZEPOINT, "0,{picture},{n},0.5,1,0.5,0.25,0,.{time},{n},1"),
        {"size": (1920, 1080)},
    ),
    "OpenSesame, fixations of PyGaze": (
        lines("trialnr,starttime,endtime,duration,endx,endy,image", "1,100,300,{time},{x},{y},{picture}"),
        {"size": (1024, 768), "columns": {"picture": "image"}},
    ),
    "PsychoPy": (
        lines(
            "experiment_id,session_id,event_id,type,time,eye,duration,average_gaze_x,average_gaze_y,cond",
            "1,2,{n},54,11.5,22,0.{time},{x},-{y},{picture}",
        ),
        {"size": (1920, 1080), "columns": {"picture": "cond"}},
    ),
    "pymovements": (
        lines("subject_id,stimulus,name,onset,offset,duration,location",
              '7,{picture},fixation,0,250,{time},"[{x}, {y}]"'),
        {"size": (1024, 768)},
    ),
    "a table of one's own, units in its names": (
        lines("picture,subject,x,y,width,height,duration", "{picture},p,{x},{y},800,600,{time}"),
        {},
    ),
}  # fmt: skip


@pytest.mark.parametrize("program", TABLES)
def test_ten_fixations_in_two_pictures(tmp_path, program):
    text, arguments = TABLES[program]
    (tmp_path / "export.tsv").write_text(text, encoding="utf-8")
    records = read_fixations(tmp_path / "export.tsv", **arguments)
    assert sum(map(len, records)) == 10
    assert {each.picture for each in records} == (
        {arguments["picture"]} if "picture" in arguments else {"a.png", "b.png"}
    )
    assert sum(each.durations.sum() for each in records) == pytest.approx(SUM)
    assert all(each.inside.all() for each in records)


@pytest.mark.parametrize("program", ["Tobii Studio", "Gazepoint", "SMI BeGaze", "EyeLink Data Viewer", "pymovements"])
def test_fixations_between_two_pictures_are_left_out_and_counted(tmp_path, program):
    text, arguments = TABLES[program]
    (tmp_path / "export.tsv").write_text(text.replace("b.png", "", 2), encoding="utf-8")
    with pytest.warns(UserWarning, match="2 of 10 fixations are left out, as .* names no picture"):
        records = read_fixations(tmp_path / "export.tsv", **arguments)
    assert [(each.picture, len(each)) for each in records] == [("a.png", 5), ("b.png", 3)]
    (tmp_path / "export.tsv").write_text(text.replace("a.png", "").replace("b.png", ""), encoding="utf-8")
    unusable("expected the name of the picture.*give picture=", read_fixations, tmp_path / "export.tsv", **arguments)


def test_a_picture_that_is_named_is_not_laid_over_several(tmp_path):
    text, arguments = TABLES["Tobii Studio"]
    (tmp_path / "export.tsv").write_text(text, encoding="utf-8")
    said = "at most one name of a picture beside picture=, got 2 of them, such as a.png, b.png"
    unusable(said, read_fixations, tmp_path / "export.tsv", picture="c.png", **arguments)
    (tmp_path / "export.tsv").write_text(text.replace("b.png", ""), encoding="utf-8")
    with pytest.warns(UserWarning, match="5 of 10 fixations are left out"):
        (record,) = read_fixations(tmp_path / "export.tsv", picture="c.png", **arguments)
    assert (record.picture, len(record)) == ("c.png", 5)


def test_columns_that_are_known_but_not_read_are_named(tmp_path):
    text, arguments = TABLES["Tobii Pro Lab, brackets of a new version"]
    path = tmp_path / "export.tsv"
    path.write_text(text.replace("event duration [ms]", "event duration [min]"))
    with pytest.warns(UserWarning, match=r"no duration is read, although there is 'Eye move.*duration \[min\]'"):
        (first, _) = read_fixations(path, **arguments)
    assert first.durations is None
    path.write_text(text.replace("Eye movement event duration", "Fixation duration"))
    with pytest.warns(UserWarning, match=r"although there is 'Fixation duration \[ms\]'; name it by columns="):
        read_fixations(path, **arguments)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        records = read_fixations(path, columns={"duration": "Fixation duration [ms]"}, **arguments)
    assert sum(each.durations.sum() for each in records) == SUM
    path.write_text(text.replace("DACS px", "DACS mm"))
    with pytest.raises(DataError, match=r"points of Tobii Pro Lab in px or norm, got .*'Fixation point X \[DACS"):
        read_fixations(path, **arguments)


def test_a_report_that_data_viewer_saves_as_xls_is_text(tmp_path):
    text, arguments = TABLES["EyeLink Data Viewer"]
    path = tmp_path / "report.xls"
    path.write_text(text.replace("b.png", "UNDEFINEDnull", 2), encoding="utf-16")
    with pytest.warns(UserWarning, match="2 of 10 fixations are left out, as 'image' names no picture"):
        records = read_fixations(path, **arguments)
    assert [(record.picture, len(record)) for record in records] == [("a.png", 5), ("b.png", 3)]
