"""Pictures from files, folders, videos and embedded scenes, and the errors for unreadable sources."""

import os
import re
import sys
from collections import Counter
from itertools import accumulate
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

import semfov
from semfov.data import sources
from semfov.data.images import _FORMATS
from semfov.data.picture_files import PHOTOGRAPHS, picture_files
from semfov.data.sources import open_stream
from semfov.errors import DataError
from semfov.io.files import MADE_HERE
from semfov.report.episode import jpeg
from tests import small
from tests.films import encode
from tests.refusals import refused, unusable

SHADES = (20, 90, 160, 230)


@pytest.fixture
def video(tmp_path):
    """A video of eight frames, two of each shade of blue."""
    path = tmp_path / "video.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 5, (64, 48))
    for shade in SHADES:
        for _ in range(2):
            writer.write(np.full((48, 64, 3), (shade, 0, 0), np.uint8))
    writer.release()
    return path


@pytest.mark.skipif(os.name != "posix", reason="needs symbolic links")
def test_folders_behind_links_are_left_out_with_a_warning(tmp_path):
    folder = tmp_path / "photos"
    (folder / "low").mkdir(parents=True)
    (tmp_path / "others").mkdir()
    for path in (folder / "a.png", folder / "low" / "b.png", tmp_path / "others" / "c.png"):
        Image.new("RGB", (8, 6)).save(path)
    (folder / "linked.png").symlink_to(folder / "a.png")  # links to files are followed
    expected = ["a.png", "linked.png", "b.png"]
    assert [path.name for path in picture_files(folder, recursive=True)] == expected
    (folder / "elsewhere").symlink_to(tmp_path / "others")
    with pytest.warns(UserWarning, match=r"1 folder left out, behind symbolic links .*: \S+elsewhere$"):
        assert [path.name for path in picture_files(folder, recursive=True)] == expected
    (folder / "low" / "back").symlink_to(folder)
    with pytest.warns(UserWarning, match=r"2 folders left out, .*: \S+elsewhere, \S+back$"):
        assert [path.name for path in picture_files(folder, recursive=True)] == expected
    assert [path.name for path in picture_files(folder / "elsewhere", recursive=True)] == ["c.png"]
    assert len(picture_files(folder)) == 2  # without --recursive no folder is searched


def test_pictures_of_a_file_and_of_a_folder(tmp_path):
    for name in ("b.png", "a.jpg"):
        Image.new("RGB", (8, 6), "red").save(tmp_path / name)
    (tmp_path / "notes.txt").write_text("no picture")
    assert picture_files(tmp_path / "b.png") == [tmp_path / "b.png"]
    with pytest.warns(UserWarning, match=r": 1 file left out, of another kind than photographs: \S+notes.txt$"):
        assert picture_files(tmp_path) == [tmp_path / "a.jpg", tmp_path / "b.png"]


def test_a_folder_leaves_out_no_photograph_that_is_read_alone(tmp_path):
    Image.init()
    registered = Image.registered_extensions().items()
    read = {end for end, kind in registered if kind in (*_FORMATS, "MPO", "DIB")}
    assert read <= {*PHOTOGRAPHS}
    for name in ("a.jpg", "b.VRT", "c.jpg"):
        (tmp_path / name).touch()
    (tmp_path / "d.jpg").symlink_to(tmp_path / "nothing.jpg")
    with pytest.warns(UserWarning, match=r"1 mosaic left out, .*: \S+b.VRT$"):
        assert [path.name for path in picture_files(tmp_path)] == ["a.jpg", "c.jpg", "d.jpg"]
    assert picture_files(tmp_path / "d.jpg") == [tmp_path / "d.jpg"]


def test_a_folder_with_the_name_of_a_picture_is_none(tmp_path):
    (tmp_path / "holidays.jpg").mkdir()
    Image.new("RGB", (8, 6)).save(tmp_path / "holidays.jpg" / "a.jpg")
    unusable("expected photographs", picture_files, tmp_path)
    assert picture_files(tmp_path, recursive=True) == [tmp_path / "holidays.jpg" / "a.jpg"]


def test_pictures_that_semfov_has_written_are_left_out_of_folders_in_a_folder(tmp_path):
    """A figure, a film, a crop and heat maps, told by what is in them; by their own folder they are looked at."""
    Image.new("RGB", (8, 6), "red").save(tmp_path / "photo.jpg")
    made = tmp_path / "out" / "made"
    made.mkdir(parents=True)
    record = small.agent(small.Coloured()).explore(torch.rand(3, 12, 16), shifts=1)
    figure = semfov.viz.save_figure(record.plot(), made / "scanpath.png")
    record.animate().save(made / "film.gif")
    (made / "crop.jpg").write_bytes(jpeg(torch.rand(3, 12, 16), 92))
    with pytest.warns(UserWarning, match=r": 3 pictures left out, written by semfov .*: \S+crop.jpg, "):
        assert picture_files(tmp_path, recursive=True) == [tmp_path / "photo.jpg"]
    assert picture_files(figure) == [figure]
    assert [path.name for path in picture_files(made)] == ["crop.jpg", "film.gif", "scanpath.png"]
    for name in ("film.gif", "scanpath.png"):
        (made / name).unlink()
    with pytest.warns(UserWarning, match=r": 1 picture left out, written by semfov .*: \S+crop.jpg$"):
        picture_files(tmp_path, recursive=True)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="the system has no named pipes")
def test_a_pipe_with_the_name_of_a_picture_is_not_waited_for(tmp_path, fresh):
    Image.new("RGB", (4, 4)).save(tmp_path / "a.png")
    os.mkfifo(tmp_path / "b.png")
    code = f"""
import signal
from pathlib import Path
from semfov.data.picture_files import picture_files
signal.alarm(60)
print(len(picture_files(Path({str(tmp_path)!r}), recursive=True)))
"""
    assert fresh(code).split() == ["2"]


def test_frames_of_a_video_are_read_in_order(video):
    stream = open_stream(video)
    taken = list(stream.frames)
    assert (stream.name, stream.rate) == ("video.avi", 5.0)
    # Blue is the first channel in OpenCV, and the last one here.
    shades = [float(picture.image[2].float().mean()) for picture in taken]
    np.testing.assert_allclose(shades, np.repeat(SHADES, 2), atol=6)
    assert all(float(picture.image[0].float().mean()) < 25 for picture in taken)
    assert [picture.name for picture in taken] == [f"video.avi, frame {number}" for number in range(8)]
    assert len(list(open_stream(video, 3).frames)) == 3
    assert len(list(open_stream(video, 100).frames)) == 8


def test_the_pictures_of_a_folder_are_the_frames_of_a_stream(tmp_path, monkeypatch):
    """In the order of their names, and without OpenCV."""
    monkeypatch.setitem(sys.modules, "cv2", None)
    for number in (2, 0, 1):
        Image.new("RGB", (8, 6), (50 * number, 0, 0)).save(tmp_path / f"frame{number}.png")
    taken = list(open_stream(tmp_path).frames)
    assert [float(picture.image[0].mean()) * 255 for picture in taken] == pytest.approx([0, 50, 100])
    assert [(picture.name, picture.passed) for picture in taken][1] == ("frame1.png", 0.04)
    assert len(list(open_stream(str(tmp_path), 2).frames)) == 2


@pytest.mark.parametrize("suffix", [".mp4", ".m3u8", ".avi", ".ts"])
@pytest.mark.parametrize(
    "text",
    [
        "#EXTM3U\n#EXT-X-TARGETDURATION:5\n#EXTINF:5,\nvideo.avi\n#EXT-X-ENDLIST\n",
        "\ufeff#EXTM3U\n#EXTINF:5,\nvideo.avi\n",
        "ffconcat version 1.0\nfile video.avi\n",
        "v=0\no=- 0 0 IN IP4 127.0.0.1\ns=x\nc=IN IP4 127.0.0.1\nt=0 0\nm=video 9 RTP/AVP 96\na=rtpmap:96 H264/90000\n",
        "# VobSub index file, v7 (do not modify this line!)\n",
        "#EXTM3U\n#\x01\n#EXTINF:5,\nvideo.avi\n",
        "#EXTM3U\nAVI \nvideo.avi\n",
        "words, which FFmpeg would draw",
    ],
)
def test_a_text_is_no_video(video, text, suffix):
    path = video.with_name(f"list{suffix}")
    path.write_text(text)
    unusable("expected a video, got a text, such as a playlist", open_stream, path)


def test_films_that_begin_with_words_and_empty_ones_are_no_texts(tmp_path):
    for name, head in (("a.nut", b"nut/multimedia container\0"), ("a.y4m", b"YUV4MPEG2 W8 H6\n"), ("a.mp4", b"")):
        (tmp_path / name).write_bytes(head)
        unusable("cannot be opened|no frame could be read", open_stream, tmp_path / name)


def test_the_name_of_a_video_is_no_protocol(video, monkeypatch):
    monkeypatch.chdir(video.parent)
    path = video.with_name("subfile,,start,0,end,0,,:video.avi")
    path.write_bytes(b"\0" * 100)
    unusable("cannot be opened", open_stream, path.name)


def test_streams_are_opened_by_their_address_and_refused_without_their_password(video, serve):
    place = serve(video.parent).removeprefix("http://")
    stream = open_stream(f"http://admin:secret@{place}/video.avi?key=secret")
    assert stream.name == f"http://{place}/video.avi"
    assert len(list(stream.frames)) == 8
    with pytest.raises(DataError, match=r"rtsp://127.0.0.1:9/a: cannot be opened; check that address, user") as caught:
        open_stream("rtsp://admin:secret@127.0.0.1:9/a")
    assert "secret" not in str(caught.value)
    refused(r"expected an address of a stream .*, got gopher", open_stream, "gopher://secret@camera")


def test_unreadable_sources_are_errors(tmp_path, monkeypatch):
    unusable("no such file", picture_files, tmp_path / "none.jpg")
    unusable("got none", picture_files, tmp_path)
    unusable("source: expected frames .* got none", open_stream, tmp_path)
    broken = tmp_path / "broken.mp4"
    broken.write_bytes(b"\0no video")
    unusable(r"broken\.mp4: cannot be opened", open_stream, broken)
    unusable(r"source: .*none\.mp4: no such file", open_stream, tmp_path / "none.mp4")
    unusable("camera 99: cannot be opened; check that it is connected", open_stream, 99)
    monkeypatch.setitem(sys.modules, "cv2", None)
    unusable("pip install opencv-python-headless", open_stream, broken)


def test_a_damaged_video_goes_on_after_its_gaps(video, tmp_path):
    """Frames of zeros cannot be decoded; the others keep their numbers, and say how much time has passed."""
    content = bytearray(video.read_bytes())
    starts = [each.start() for each in re.finditer(rb"00dc....\xff\xd8", content, re.DOTALL)]
    assert len(starts) == 8
    for number in (2, 3, 5):
        length = int.from_bytes(content[starts[number] + 4 : starts[number] + 8], "little")
        content[starts[number] + 8 : starts[number] + 8 + length] = bytes(length)
    (tmp_path / "damaged.avi").write_bytes(content)
    stream = open_stream(tmp_path / "damaged.avi")
    taken = list(stream.frames)
    assert [picture.name for picture in taken] == [f"damaged.avi, frame {number}" for number in (0, 1, 4, 6, 7)]
    assert [picture.passed for picture in taken] == pytest.approx([0.2, 0.2, 0.6, 0.4, 0.2])
    assert stream.gaps == {"lost": 3}
    (tmp_path / "cut.avi").write_bytes(video.read_bytes()[: starts[3]])
    stream = open_stream(tmp_path / "cut.avi")
    assert len(list(stream.frames)) == 3
    assert stream.gaps["lost"] == 5


def test_frames_pass_by_their_time_stamps(monkeypatch):
    """Frames at 0, 40, 80 and 1080 ms; those of a camera come when they are read, at 5, 5.1, 5.6 and 5.7 s."""
    monkeypatch.setattr(sources.time, "monotonic", iter([5, 5.1, 5.6, 5.7]).__next__)
    film = sources._Film(Path("a.mp4"))
    for source, expected in ((film, [0.04, 0.04, 0.04, 1]), (sources._Camera(0), [0.04, 0.1, 0.5, 0.1])):
        recorder = Recorder([[0, 40, 80, 1080], []])
        monkeypatch.setattr(recorder, "get", lambda key, of=recorder: of.now if key == cv2.CAP_PROP_POS_MSEC else 25.0)
        taken = sources._Recording(cv2, recorder, source, Counter()).frames(4)
        assert [picture.passed for picture in taken] == pytest.approx(expected)


@given(
    rate=st.sampled_from([15, 24000 / 1001, 24, 25, 30000 / 1001, 30, 50, 60, 120, 240]),
    begin=st.floats(0, 100),
    gaps=st.lists(st.integers(1, 5000), min_size=1, max_size=20),
)
def test_time_stamps_rounded_to_milliseconds_give_the_seconds_of_the_rate(rate, begin, gaps):
    clock = sources._Clock(1 / rate, rounded=True)
    clock.passed(round(begin, 3), 0)
    for gap, number in zip(gaps, accumulate(gaps), strict=True):
        assert clock.passed(round(begin + number / rate, 3), 0) == pytest.approx(gap / rate, abs=1e-9)


def test_time_stamps_that_do_not_fit_the_rate_are_kept():
    clock = sources._Clock(1 / 30, rounded=True)
    assert [round(clock.passed(stamp, 0), 6) for stamp in (0, 0.05, 0.067, 0.567)] == [0.033333, 0.05, 0.017, 0.5]


def test_a_film_that_begins_late_lacks_no_frame(tmp_path):
    for end, codec in ((".mkv", "libx264"), (".mp4", "libx264"), (".avi", "mpeg4")):
        stream = open_stream(encode(tmp_path / f"late{end}", codec, range(150, 162)))
        assert len(list(stream.frames)) == 12
        assert not stream.gaps["lost"]


def test_a_header_that_states_too_many_frames_is_not_believed(video, tmp_path):
    """The film ends with its last frame, of which none is lost."""
    content = bytearray(video.read_bytes())
    for place in (content.index(b"avih") + 24, content.index(b"strh") + 40):
        assert content[place : place + 4] == (8).to_bytes(4, "little")
        content[place : place + 4] = (900_000_000).to_bytes(4, "little")
    (tmp_path / "long.avi").write_bytes(content)
    stream = open_stream(tmp_path / "long.avi")
    assert len(list(stream.frames)) == 8
    assert not stream.gaps["lost"]


def test_an_mp4_file_lacks_frames_if_it_is_cut_and_none_if_it_does_not_show_them(tmp_path):
    """The first five frames come before the film begins, as an editor trims it."""
    whole = encode(tmp_path / "whole.mp4", "mpeg4", range(20), movflags="faststart")
    place = whole.read_bytes().index(b"mdat")
    (tmp_path / "cut.mp4").write_bytes(whole.read_bytes()[: place + (whole.stat().st_size - place) // 2])
    stream = open_stream(tmp_path / "cut.mp4")
    read = len(list(stream.frames))
    assert 0 < read < 19
    assert stream.gaps["lost"] == 20 - read
    stream = open_stream(encode(tmp_path / "trimmed.mp4", "libx264", range(-5, 15), bf="0"))
    assert len(list(stream.frames)) == 15
    assert not stream.gaps["lost"]


@pytest.mark.parametrize("kind", ["gif", "webp"])
def test_animations_are_films(tmp_path, monkeypatch, kind):
    """Each frame follows when the one before was shown for its time, without OpenCV; a browser shows 0 as 100 ms."""
    monkeypatch.setitem(sys.modules, "cv2", None)
    path, times = tmp_path / f"film.{kind}", [40, 250, 0, 90] if kind == "gif" else [40, 250, 1, 90]
    first, *others = [Image.new("RGB", (16, 12), (shade, shade, shade)) for shade in SHADES]
    first.save(
        path, save_all=True, append_images=others, duration=times, **({} if kind == "gif" else {"lossless": True})
    )
    stream = open_stream(path)
    taken = list(stream.frames)
    assert stream.rate == 25
    assert [picture.name for picture in taken] == [f"film.{kind}, frame {number}" for number in range(4)]
    assert [float(picture.image.mean()) * 255 for picture in taken] == pytest.approx(SHADES, abs=1)
    assert [picture.passed for picture in taken] == pytest.approx([0.04, 0.04, 0.25, 0.1 if kind == "gif" else 0.001])
    assert len(list(open_stream(path, 2).frames)) == 2
    (tmp_path / "head").write_bytes(path.read_bytes()[:20])
    unusable("image .*head", open_stream, tmp_path / "head")


def test_a_damaged_animation_ends_with_a_warning(tmp_path):
    noise = [Image.fromarray(np.random.default_rng(n).integers(0, 255, (48, 64), np.uint8)) for n in range(4)]
    noise[0].save(tmp_path / "film.gif", save_all=True, append_images=noise[1:], duration=40)
    content = (tmp_path / "film.gif").read_bytes()
    (tmp_path / "cut.gif").write_bytes(content[: len(content) * 5 // 8])
    stream = open_stream(tmp_path / "cut.gif")
    with pytest.warns(UserWarning, match=r"cut\.gif ends with a frame that cannot be read: image .*truncated"):
        assert len(list(stream.frames)) == 2
    assert stream.gaps == {"lost": 1}


def test_frames_of_sixteen_bits_are_shown_between_black_and_white(tmp_path):
    path, kind = tmp_path / "warm.mkv", [cv2.VIDEOWRITER_PROP_DEPTH, cv2.CV_16U, cv2.VIDEOWRITER_PROP_IS_COLOR, 0]
    film = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, cv2.VideoWriter_fourcc(*"FFV1"), 25, (64, 48), kind)
    for value in (300, 1300, 4000):
        film.write(np.full((48, 64), value, np.uint16))
    film.release()
    taken = [each.image for each in open_stream(path, white=(300, 2300)).frames]
    assert [each.shape for each in taken] == [(3, 48, 64)] * 3
    assert [int(each[0, 0, 0]) for each in taken] == [0, 128, 255]
    assert all((each == each[0, 0, 0]).all() for each in taken)
    plain = [int(each.image[0, 0, 0]) for each in open_stream(path).frames]
    assert np.allclose(plain, np.array([300, 1300, 4000]) / 256, atol=1)


class Recorder:
    """OpenCV's reader of a stream that breaks off, and is there again when it is opened for the second time."""

    def __init__(self, parts):
        self.parts, self.left = parts, list(parts.pop(0))

    def get(self, key):
        return -1.0

    def set(self, key, value):
        pass

    def release(self):
        pass

    def isOpened(self):
        return bool(self.parts)

    def open(self, *source):
        self.left = list(self.parts.pop(0))
        return bool(self.left)

    def read(self):
        if not self.left:
            return False, None
        self.now = float(self.left.pop(0))
        return True, np.full((6, 8, 3), self.now % 256, np.uint8)


def test_a_stream_that_breaks_off_is_opened_again(monkeypatch):
    recorder, gaps = Recorder([[1, 2], [], [3, 4]]), Counter()
    monkeypatch.setattr(sources, "_PAUSES", (0.0, 0.0))
    monkeypatch.setattr(sources, "_recorder", lambda *_: recorder)
    taken = list(sources._Recording(cv2, recorder, sources._Address("rtsp://camera"), gaps).frames(None))
    assert [int(picture.image[0, 0, 0]) for picture in taken] == [1, 2, 3, 4]
    assert gaps == {"reconnected": 1, "lost": 0}
    assert [picture.passed for picture in taken[:2]] == [0.04, 0.04]
    assert taken[2].passed > 0.04


def test_warnings_of_what_a_folder_leaves_out_point_to_its_caller(tmp_path):
    for name in ("a.jpg", "b.txt", "c.vrt"):
        (tmp_path / name).write_bytes(b"")
    (tmp_path / "d.png").write_bytes(MADE_HERE.encode())
    with pytest.warns(UserWarning, match="left out") as warned:
        picture_files(tmp_path, recursive=True)
    assert len(warned) == 3
    assert {warning.filename for warning in warned} == {__file__}
