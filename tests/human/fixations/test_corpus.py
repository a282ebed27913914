"""Exports as programs write them, with their full headers and the lines between fixations: what the program reports."""

import re
import warnings

import pytest

from semfov.data.fixations import read_fixations, read_table
from tests.refusals import unusable

LAB = (
    "Recording timestamp [μs]\tComputer timestamp [μs]\tSensor\tProject name\tExport date\tParticipant name\t"
    "Recording name\tTimeline name\tRecording Fixation filter name\tRecording resolution height [px]\t"
    "Recording resolution width [px]\tEvent\tGaze point X [DACS px]\tGaze point Y [DACS px]\tValidity left\t"
    "Presented Stimulus name\tEye movement type\tGaze event duration [ms]\tEye movement type index\t"
    "Fixation point X [DACS px]\tFixation point Y [DACS px]\tAOI hit [a - Face]\tAOI hit [a - Face]\n"
)


def lab(person, stimulus, kind, duration, number, x, y):
    """A line of Tobii Pro Lab."""
    return (
        f"1\t2\tEye Tracker\tproject\t01.02.2024\t{person}\tRecording of {person}\tTimeline1\tTobii I-VT (Fixation)\t"
        f"1080\t1920\t\t{x}\t{y}\tValid\t{stimulus}\t{kind}\t{duration}\t{number}\t{x}\t{y}\t0\t1\n"
    )


LAB_LINES = (
    "0\t\t\tproject\t\tP1\tRecording of P1\tTimeline1\t\t1080\t1920\tRecordingStart" + 11 * "\t" + "\n"
    + 2 * lab("P1", "a", "Fixation", 200, 1, "700.5", 500)
    + lab("P1", "a", "Saccade", 30, 1, "", "")
    + lab("P1", "a", "Fixation", 250, 2, 800, 520)
    + lab("P1", "", "Fixation", 300, 3, 960, 540)
    + lab("P1", "b", "Fixation", 180, 4, 900, 600)
    + lab("P1", "b", "EyesNotFound", 80, 1, "", "")
    + lab("P1", "b", "Unclassified", 20, 1, 5, 5)
    + lab("P2", "a", "Fixation", 100, 1, 600, 300)
    + lab("P2", "b", "Fixation", 150, 2, 700, 300)
)  # fmt: skip

STUDIO = (
    "ParticipantName\tRecordingName\tRecordingDate\tRecordingResolution\tFixationFilter\tMediaName\t"
    "MediaPosX (ADCSpx)\tMediaPosY (ADCSpx)\tMediaWidth\tMediaHeight\tSegmentName\tRecordingTimestamp\tFixationIndex\t"
    "SaccadeIndex\tGazeEventType\tGazeEventDuration\tFixationPointX (MCSpx)\tFixationPointY (MCSpx)\t"
    "SaccadicAmplitude\tGazePointX (ADCSpx)\tAOI[A]Hit\t\n"
    "P\tR\t01.02.2012\t1280 x 1024\tI-VT\ta.jpg\t240\t212\t800\t600\ts\t10\t1\t\tFixation\t200\t100\t50\t\t0\t1\t\n"
    "P\tR\t01.02.2012\t1280 x 1024\tI-VT\ta.jpg\t240\t212\t800\t600\ts\t20\t\t1\tSaccade\t30\t\t\t2,5\t0\t0\t\n"
    "P\tR\t01.02.2012\t1280 x 1024\tI-VT\tb.jpg\t240\t212\t800\t600\ts\t40\t2\t\tFixation\t250\t300,5\t80\t\t0\t0\t\n"
)

VIEWER = (
    "RECORDING_SESSION_LABEL\tTRIAL_INDEX\tTRIAL_LABEL\tDATA_FILE\tEYE_USED\tCURRENT_FIX_INDEX\tCURRENT_FIX_START\t"
    "CURRENT_FIX_END\tCURRENT_FIX_DURATION\tCURRENT_FIX_X\tCURRENT_FIX_Y\tCURRENT_FIX_PUPIL\tIP_LABEL\tIMAGE\n"
    "s1\t1\tTrial: 1\ts1.edf\tRIGHT\t1\t4\t203\t200\t512.30\t384.10\t900\t.\ta.png\n"
    "s1\t1\tTrial: 1\ts1.edf\tRIGHT\t2\t240\t439\t200\t.\t.\t900\t.\ta.png\n"
    "s1\t2\tTrial: 2\ts1.edf\tLEFT\t1\t4\t253\t250\t12.30\t84.10\t900\t.\tb.png\n"
)

SMI = (
    "Trial\tStimulus\tExport Start Trial Time [ms]\tExport End Trial Time [ms]\tParticipant\tColor\tCategory Group\t"
    "Category\tEye L/R\tIndex\tEvent Start Trial Time [ms]\tEvent End Trial Time [ms]\tEvent Duration [ms]\t"
    "Fixation Position X [px]\tFixation Position Y [px]\tAOI Name\n"
    "Trial001\ta.jpg\t0\t3000\tp01\tDarkOrange\tEye\tFixation\tLeft\t1\t10\t210\t200,5\t500,1\t300,2\t-\n"
    "Trial001\ta.jpg\t0\t3000\tp01\tDarkOrange\tEye\tFixation\tRight\t1\t10\t210\t200,5\t501,1\t301,2\t-\n"
    "Trial001\ta.jpg\t0\t3000\tp01\tDarkOrange\tEye\tSaccade\tRight\t1\t210\t230\t20\t-\t-\t-\n"
    "Trial001\ta.jpg\t0\t3000\tp01\tDarkOrange\tInformation\tSeparator\t\t1\t0\t0\t0\t-\t-\t-\n"
    "Trial002\tb.jpg\t0\t3000\tp01\tDarkOrange\tEye\tVisual Intake\tRight\t1\t1\t91\t90\t640\t480\t-\n"
)

GAZEPOINT = (
    "MEDIA_ID,MEDIA_NAME,CNT,TIME(2024/03/05 11:22:33.444),TIMETICK(f=10000000),FPOGX,FPOGY,FPOGS,FPOGD (in secs),"
    "FPOGID,FPOGV,BPOGX,BPOGY,BPOGV,CX,CY,USER,LPCX,\n"
    "0,Media0,0,0.00,1,0.50,0.50,0.0,0.100,1,1,0.5,0.5,1,0,0,,0,\n"
    "0,Media0,1,0.01,1,0.50,0.50,0.0,0.200,1,1,0.5,0.5,1,0,0,,0,\n"
    "0,Media0,2,0.02,1,0.90,0.90,0.2,0.010,2,0,0.5,0.5,1,0,0,,0,\n"
    "1,Media1,3,0.03,1,0.20,0.30,0.3,0.250,3,1,0.5,0.5,1,0,0,,0,\n"
)

IMOTIONS = (
    "#INFO,,,,\n#Study name,Ads,,,\n#Respondent Name,R01,,,\n#METADATA,,,,\n#DATA,,,,\n"
    "Row,Timestamp,EventSource,SlideEvent,StimType,Duration,CollectionPhase,SourceStimuliName,EventSource,"
    "ET_GazeLeftx,ET_GazeLefty,EventSource,Gaze X,Gaze Y,Fixation Index,Fixation Index by Stimulus,Fixation X,"
    "Fixation Y,Fixation Start,Fixation End,Fixation Duration,Fixation Dispersion,Saccade Index\n"
    "1,16,1,,TestImage,5000,,a,2,500,400,3,500,400,1,1,500,400,0,200,200,0.1,\n"
    "2,32,1,,TestImage,5000,,a,2,500,400,3,500,400,1,1,500,400,0,200,200,0.1,\n"
    "3,48,1,,TestImage,5000,,a,2,500,400,3,500,400,,,,,,,,,1\n"
    "4,64,1,,TestImage,5000,,b,2,500,400,3,500,400,2,1,600,300,0,150,150,0.1,\n"
)

GLASSES = (
    "Recording timestamp\tSensor\tParticipant name\tRecording name\tRecording media name\t"
    "Mapped eye movement type [shelf]\tMapped eye movement type index [shelf]\tMapped fixation X [shelf]\t"
    "Mapped fixation Y [shelf]\tMapped eye movement type [till]\tMapped eye movement type index [till]\t"
    "Mapped fixation X [till]\tMapped fixation Y [till]\tEye movement type\tGaze event duration\t"
    "Eye movement type index\tFixation point X\tFixation point Y\n"
    "1\tEye Tracker\tY1\tR1\tv.mp4\tFixation\t1\t500\t400\t\t\t\t\tFixation\t300\t1\t962\t647\n"
    "2\tGyroscope\tY1\tR1\tv.mp4\tFixation\t1\t500\t400\t\t\t\t\tFixation\t300\t1\t962\t647\n"
    "3\tEye Tracker\tY1\tR1\tv.mp4\tEyesNotFoundMovement\t2\t\t\tFixation\t1\t30\t40\tFixation\t200\t2\t900\t600\n"
)

NEON = (
    "section id,recording id,fixation id,start timestamp [ns],end timestamp [ns],duration [ms],fixation x [px],"
    "fixation y [px],azimuth [deg],elevation [deg]\n"
    "s,r,1,1,2,200,800.5,600,1,2\ns,r,2,3,4,210,810,600,1,2\nz,q,1,5,6,220,20,60,1,2\n"
)

PSYCHOPY = (
    "experiment_id,session_id,device_id,event_id,type,device_time,logged_time,time,confidence_interval,delay,filter_id,"
    "eye,start_time,end_time,duration,start_gaze_x,start_gaze_y,end_gaze_x,end_gaze_y,average_gaze_x,average_gaze_y,"
    "amplitude_x,status\n"
    "1,1,0,10,54,1,1,1,0,0,0,22,1.0,1.25,0.25,0,0,0,0,-100.5,50.0,1,0\n"
    "1,1,0,11,54,1,1,1,0,0,0,21,1.0,1.25,0.30,0,0,0,0,-100.5,50.0,1,0\n"
)

MATLAB = (
    "Picture,Subject,X [px],Y [px],Width,Height,Duration [s]\n"
    "a.png,1,10,20,80,60,0.2\na.png,1,NaN,NaN,80,60,NaN\nb.png,1,12,22,80,60,0.25\n"
)

FRACTIONS = "subject;picture;y [norm];x [norm];height;width;duration (µs)\n1;a.png;0,25;0,5;60;80;200000\n;;;;;;\n"

WIDE, SCREEN = (1920, 1080), (1024, 768)

EXPORTS = {
    "Tobii Pro Lab": (LAB + LAB_LINES, {}, {"a": [200, 250, 100], "b": [180, 150]}, (700.5, 500), WIDE),
    "Tobii Pro Lab, glasses": (
        GLASSES, {"size": {"shelf": (1000, 800), "till": (600, 400)}}, {"shelf": [300], "till": [200]}, (500, 400),
        (1000, 800),
    ),
    "Tobii Studio": (STUDIO, {}, {"a.jpg": [200], "b.jpg": [250]}, (100, 50), (800, 600)),
    "EyeLink Data Viewer": (VIEWER, {"size": SCREEN}, {"a.png": [200], "b.png": [250]}, (512.3, 384.1), SCREEN),
    "SMI BeGaze": (SMI, {"size": WIDE}, {"a.jpg": [200.5], "b.jpg": [90]}, (501.1, 301.2), WIDE),
    "Gazepoint": (GAZEPOINT, {"size": WIDE}, {"Media0": [200], "Media1": [250]}, (959.5, 539.5), WIDE),
    "iMotions": (IMOTIONS, {"size": WIDE}, {"a": [200], "b": [150]}, (500, 400), WIDE),
    "Neon": (NEON, {"size": (1600, 1200), "picture": "v"}, {"v": [200, 210, 220]}, (800.5, 600), (1600, 1200)),
    "PsychoPy": (PSYCHOPY, {"size": WIDE, "picture": "a"}, {"a": [250]}, (859, 489.5), WIDE),
    "MATLAB": (MATLAB, {}, {"a.png": [200], "b.png": [250]}, (10, 20), (80, 60)),
    "fractions, y first": (FRACTIONS, {}, {"a.png": [200]}, (39.5, 14.5), (80, 60)),
}  # fmt: skip
"""Texts, arguments of the reader, durations in each picture, the first point, and the frame."""

WORDS = r"1 of \d fixations are left out, as 'Presented Stimulus name'|1 of 3 lines are left out, as they have no place"


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16"])
@pytest.mark.parametrize("end", ["\n", "\r\n"])
@pytest.mark.parametrize("program", EXPORTS)
def test_what_a_program_reports_is_what_is_read(tmp_path, program, end, encoding):
    text, arguments, durations, first, size = EXPORTS[program]
    (tmp_path / "ann.txt").write_bytes(text.replace("\n", end).encode(encoding))
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        records = read_fixations(tmp_path / "ann.txt", **arguments)
    assert all(re.search(WORDS, str(warning.message)) for warning in said)
    found = {}
    for record in records:
        found.setdefault(record.picture, []).extend(record.durations.tolist())
    assert found == {name: pytest.approx(times) for name, times in durations.items()}
    assert records[0].points[0].tolist() == pytest.approx(first)
    assert records[0].size == size


def test_snapshots_without_fixations_leave_those_of_the_scene(tmp_path):
    unmapped = GLASSES.replace("Fixation\t1\t500\t400", 3 * "\t").replace("Fixation\t1\t30\t40", 3 * "\t")
    (tmp_path / "a.tsv").write_text(unmapped)
    (record,) = read_fixations(tmp_path / "a.tsv", size=WIDE)
    assert (record.picture, record.points.tolist()) == ("v.mp4", [[962, 647], [900, 600]])
    assert record.durations.tolist() == [300, 200]


def test_a_name_that_several_columns_have_counts_only_where_it_is_read(tmp_path):
    (tmp_path / "a.tsv").write_text((LAB + LAB_LINES).replace("AOI hit [a - Face]\n", "Participant name\n"))
    unusable("expected one column of a name, got several named Participant name", read_fixations, tmp_path / "a.tsv")


@pytest.mark.parametrize(
    "columns",
    [
        "timestamp [ns],gaze x [px],gaze y [px],worn,fixation id",  # Neon
        "timestamp,time,fix,state,rawx,rawy,avgx,avgy,psize",  # PyGaze
        "rt,stimulus,webgazer_data,trial_type",  # jsPsych
        "participant_id,filename,time_elapsed,x_pred,y_pred",  # Gorilla
        "Timestamp,GazeX,GazeY",
    ],
)
def test_samples_are_no_fixations(tmp_path, columns):
    (tmp_path / "a.csv").write_text(f"{columns}\n1,2,3\n")
    said = "these look like samples, in which fixations are to be found first.*name them by columns="
    unusable(said, read_fixations, tmp_path / "a.csv", picture="a.png", size=SCREEN)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (("[px]", "[mm]"), r"expected x and y in px or norm, got the columns 'X \[mm\]' and 'Y \[mm\]'"),
        (("X [px]", "X [norm]"), r"expected x and y in px or norm, got the columns 'X \[norm\]' and 'Y \[px\]'"),
        (("[s]", "[frames]"), r"expected durations in s, ms or μs, got the column 'Duration \[frames\]'"),
        (("a.png,1,10,", 'a.png,1,"10,5",'), "line 2, x: expected a number, got '10,5'; write decimal points"),
    ],
)
def test_what_is_not_read_is_named(tmp_path, change, said):
    (tmp_path / "a.csv").write_text(MATLAB.replace("NaN,NaN,80,60,NaN", "1,1,80,60,0.1").replace(*change))
    unusable(said, read_table, tmp_path / "a.csv")


BEGIN = "** CONVERTED FROM a.edf\nMSG\t100 DISPLAY_COORDS 0 0 1023 767\n"
FIXATION = "EFIX R   210\t409\t200\t  512.3\t  384.1\t   1200\n"
ASC = {
    "drift correction": "MSG\t200 TRIALID 1\nMSG\t201 DRIFTCORRECT R RIGHT at 512,384  OFFSET 0.45 deg.\n"
    "MSG\t202 !V IMGLOAD FILL a.png\nSTART\t203\tRIGHT\tSAMPLES\tEVENTS\n" + FIXATION + "END\t500\tSAMPLES\n",
    "no trials": "MSG\t202 !V IMGLOAD FILL a.png\nSTART\t203\tRIGHT\tSAMPLES\n" + FIXATION + "END\t500\tSAMPLES\n"
    "START\t503\tRIGHT\tSAMPLES\nEFIX R   510\t609\t100\t  5.0\t  5.0\t   1200\n",
    "OpenSesame": "MSG\t200 start_trial 0\nMSG\t201 var image a.png\nSTART\t203\tRIGHT\n" + FIXATION
    + "MSG\t450 stop_trial\nEFIX R   510\t609\t100\t  5.0\t  5.0\t   1200\n",
    "names without a space": "MSG\t200 TRIALID_1\nMSG\t201 !V TRIAL_VAR image a.png\n" + FIXATION
    + "MSG\t450 TRIAL_RESULT0\nEFIX R   510\t609\t100\t  5.0\t  5.0\t   1200\nMSG\t700 TRIALID2\n",
    "resolution and two kilohertz": "MSG\t200.5 TRIALID 1\nMSG\t202.0 !V IMGLOAD FILL a.png\n"
    "EFIX R   210.0\t409.5\t200.0\t  512.3\t  384.1\t   1200\t25.1\t25.2\n",
}  # fmt: skip


@pytest.mark.parametrize("kind", ASC)
@pytest.mark.parametrize("end", ["asc", "txt"])
def test_texts_of_eyelink(tmp_path, kind, end):
    (tmp_path / f"a.{end}").write_text(BEGIN + ASC[kind])
    (record,) = read_fixations(tmp_path / f"a.{end}")
    assert (record.picture, record.points.tolist(), record.durations.tolist()) == ("a.png", [[512.3, 384.1]], [200])
    (tmp_path / f"a.{end}").write_text(BEGIN + FIXATION)
    said = "got 1 EFIX, but no such message, nor !V IMGLOAD, so no picture; write a table for read_table"
    unusable(said, read_fixations, tmp_path / f"a.{end}")
