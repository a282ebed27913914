"""An episode and a run without a detector, with names that contain HTML markup."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from eval.comparison import report_page as run_report
from eval.comparison.summary import Curve
from eval.search.run import SearchConfig
from semfov import Detections, Grid, Objects, Scanpath
from semfov.decision import Decision
from semfov.paths import ZoomPath
from semfov.paths.windows import looks_at_windows
from semfov.report import write_page
from semfov.report.zoom import zoom_data
from semfov.runs.config import DataConfig, PolicyConfig
from semfov.zoom import Lattice
from semfov.zoom.looks import Window, WindowLook
from tests import small


@pytest.fixture(scope="session")
def hostile() -> str:
    """A name that would run as a script if it were not escaped: in an attribute, a text, the title or a script."""
    attack = "<img src=x onerror=\"alert('taken')\"><script>alert('taken')</script>"
    return f"\"'>{attack}</title></script>{attack}<!--<script>"


@pytest.fixture(scope="session")
def scanpath(hostile: str) -> Scanpath:
    """Three fixations on a 4 × 3 grid, with different beliefs and detections."""
    generator = torch.Generator().manual_seed(0)
    scores = torch.rand(3, 2, 4, generator=generator).softmax(-1)
    corner = torch.rand(3, 2, 2, generator=generator) * 40
    looks = Detections(torch.cat([corner, corner + 18], -1), scores, torch.ones(3, 2, dtype=torch.bool))
    return small.scanpath(
        Grid(4, 3, (80, 60)),
        torch.tensor([0, 6, 11]),
        ("background", "cat", hostile, "cup"),
        target=2,
        detections=tuple(looks[number : number + 1] for number in range(3)),
        probabilities=torch.rand(3, 12, 4, generator=generator).add(0.1).softmax(-1),
        found=True,
        posterior=torch.rand(3, 12, generator=generator),
    )


@pytest.fixture(scope="session")
def image() -> torch.Tensor:
    """A picture of the size of the frame of the episode."""
    across, down = torch.linspace(0, 1, 80).expand(60, 80), torch.linspace(0, 1, 60)[:, None].expand(60, 80)
    return torch.stack([across, down, 1 - across])


@pytest.fixture(scope="session")
def run_page(scanpath: Scanpath, image: torch.Tensor, hostile: str, tmp_path_factory) -> Path:
    """The page of a run in which every name is `hostile`."""
    scene = SimpleNamespace(name=hostile, image=image, boxes=torch.ones(1, 4), labels=torch.tensor([2]))
    run = SimpleNamespace(
        task=hostile,
        policies={hostile: PolicyConfig("random")},
        config=SearchConfig(
            data=DataConfig(annotations=Path(hostile)), policies=(hostile,), out=tmp_path_factory.mktemp("run")
        ),
        eye=SimpleNamespace(
            detector=SimpleNamespace(name=hostile),
            settings=lambda: {"detector": {"name": hostile}, "sensor": {"sigma": 100, "reference": 640, "growth": 2}},
        ),
        scenes=type("Scenes", (list,), {"ids": [7]})([scene]),
    )
    stimulus = SimpleNamespace(views=lambda fixations: [image] * len(fixations))
    share = np.array([0.0, 0.5, 1.0])
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(run_report, "Stimulus", SimpleNamespace(of=lambda eye, image: stimulus))
        patch.setattr(run_report, "replay", lambda run, index, record: scanpath)
        return run_report.write_run_report(
            run,
            [{"policy": hostile, "scene": 7, "repetition": 0}],
            {"average": {hostile: Curve(share, share / 10, share / 10, 1, 1)}},
            titles={"average": hostile},
            label=hostile,
            shifts=(0, 2),
            others={hostile + "2": share},
        )


@pytest.fixture(scope="session")
def zoom_path(hostile: str) -> ZoomPath:
    """Three looks at a picture of 400 × 300 px, the whole of it and two windows of 200 px."""
    lattice = Lattice.over((400, 300), (100, 100))
    boxes = torch.tensor([[[20.0, 20, 60, 50]], [[30.0, 24, 61, 52]], [[250.0, 110, 280, 160]]])
    scores = torch.tensor([[0.3, 0.1, 0.5, 0.1], [0.1, 0.04, 0.8, 0.06], [0.1, 0.6, 0.2, 0.1]])
    looks = tuple(
        WindowLook(
            Window.on(lattice, action),
            Detections(boxes[None, number], scores[None, number, None], torch.ones(1, 1, dtype=torch.bool)),
            torch.zeros(1, dtype=torch.bool),
            scores[number, 1:],
            None,
        )
        for number, action in enumerate([(0, 0, 0), (1, 0, 0), (1, 16, 8)])
    )
    objects = Objects(boxes[1:, 0], torch.tensor([0.8, 0.4]), torch.tensor([2, 2]), torch.tensor([1, 2]))
    classes = ("background", "cat", hostile, "cup")
    decision = Decision("found", 0.93, None, boxes[1, 0])
    return ZoomPath(
        lattice=lattice,
        classes=classes,
        target=2,
        looks=looks_at_windows(looks, lattice, (float("inf"), 0.5, 0.25)),
        candidates=objects,
        decision=decision,
        detector=hostile,
    )


@pytest.fixture(scope="session")
def large_picture() -> torch.Tensor:
    """Colours that tell the place: red grows along x, and green along y."""
    across, down = torch.linspace(0, 1, 400).expand(300, 400), torch.linspace(0, 1, 300)[:, None].expand(300, 400)
    return torch.stack([across, down, torch.full((300, 400), 0.5)])


@pytest.fixture(scope="session")
def zoom_page(zoom_path: ZoomPath, large_picture: torch.Tensor, hostile: str, tmp_path_factory) -> Path:
    """The page of a large picture whose names are `hostile`."""
    data = zoom_data(zoom_path, large_picture, name=hostile)
    return write_page(tmp_path_factory.mktemp("large") / "large.html", hostile, [data])
