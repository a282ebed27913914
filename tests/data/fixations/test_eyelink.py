"""Text files of EyeLink trackers: trials, pictures, eyes and frames."""

import numpy as np
import pytest

from semfov.data.fixations import read_eyelink
from tests.refusals import refused, unusable

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
    path.write_text(HEAD + TRIALS.replace("a b.jpg", "a.jpg"))
    first, second = read_eyelink(path)
    assert (first.picture, second.picture, first.subject, first.size) == ("a.jpg", "2 b.jpg", "ann", (1024, 768))
    np.testing.assert_array_equal(first.points, [[512.3, 384.1], [100.0, 50.5]])
    np.testing.assert_array_equal(first.durations, [200, 282])
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


def test_other_arguments_are_refused(tmp_path):
    (tmp_path / "a.asc").write_text(HEAD + "MSG\t1 TRIALID 1\nEFIX L 1 2 1 5 5 5\n")
    unusable("expected fixations of the right eye", read_eyelink, tmp_path / "a.asc", eye="right")
    refused("eye: expected 'left', 'right' or None", read_eyelink, tmp_path / "a.asc", eye="both")


def test_names_of_pictures_may_be_in_the_encoding_of_windows(tmp_path):
    text = (HEAD + TRIALS).replace("a b.jpg", "übung.jpg")
    for encoding in ("utf-8", "utf-16", "cp1252"):
        (tmp_path / "ann.asc").write_bytes(text.encode(encoding))
        assert "übung.jpg" in {each.picture for each in read_eyelink(tmp_path / "ann.asc")}
