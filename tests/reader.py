"""A reader's folder: the files that README and the pages by task name, and what cameras and people would give."""

from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import torch
from PIL import Image

import semfov
from semfov.data.fixations import Fixations, write_table
from semfov.data.mosaics import Mosaics
from semfov.head import Panoramas


def _save(image, path, size=None):
    picture = Image.fromarray((image * 255).round().to(torch.uint8).permute(1, 2, 0).numpy())
    (picture if size is None else picture.resize(size)).save(path)


def fill(folder: Path) -> dict[str, object]:
    """Write photographs, large pictures, a video and fixations, and return what code takes as given."""
    scenes = semfov.EmbeddedScenes(["boat"], count=16)
    _save(scenes[0].image, folder / "kitchen.jpg", (640, 480))
    _save(scenes[2].image, folder / "poster.jpg", (640, 480))
    _save(Mosaics(scenes, 4, 4, tile=(640, 480), count=1)[0].image, folder / "harbour.jpg")
    (folder / "drone.jpg").symlink_to("harbour.jpg")
    _save(Panoramas(scenes, width=1024, count=1)[0].image, folder / "panorama.jpg")
    for name in ("FLIGHT/1.jpg", "FLIGHT/2.jpg", "HOLIDAY/1.jpg", "HOLIDAY/2.jpg", "drafts/a.png"):
        (folder / name).parent.mkdir(exist_ok=True)
        _save(scenes[3].image, folder / name, (960, 640))
    for number, name in enumerate(("before.png", "after.png")):
        _save(scenes[number].image, folder / name, (480, 360))
    (folder / "areas.json").write_text('{"headline": [0, 0, 300, 120], "logo": [320, 20, 400, 80]}')
    frame = cv2.imread(str(folder / "kitchen.jpg"))
    writer = cv2.VideoWriter(str(folder / "VIDEO.avi"), cv2.VideoWriter_fourcc(*"MJPG"), 5, frame.shape[1::-1])
    for _ in range(2):
        writer.write(frame)
    writer.release()
    people = [
        Fixations(
            "kitchen.jpg", person, np.array([[100.0, 80], [320, 200], [90 + each, 300]]), (640, 480), target="cup"
        )
        for each, person in enumerate(("someone", "another"))
    ]
    write_table(folder / "fixations.csv", people)
    (folder / "VIEWED").mkdir(exist_ok=True)
    for number in range(5):
        _save(scenes[number].image, folder / f"VIEWED/{number}.jpg", (160, 120))
    at = np.array([[80.0, 60], [30, 40], [120, 90]])
    viewings = [Fixations(f"{number}.jpg", each, at + number, (160, 120)) for number in range(5) for each in "ab"]
    write_table(folder / "viewing.csv", viewings)
    (folder / "neon").mkdir(exist_ok=True)
    (folder / "neon/fixations.csv").write_text(
        "recording id,fixation id,duration [ms],fixation x [px],fixation y [px]\nr1,1,250,800,600\nr1,2,310,900,500\n"
    )
    at: list[float] = []
    motors = SimpleNamespace(move=lambda *direction: at.__setitem__(slice(None), direction), position=lambda: tuple(at))
    video = SimpleNamespace(read=lambda: (True, frame))
    return {"frames": [frame, frame], "people": people, "motors": motors, "video": video}
