"""The looks of a person on the page of `semfov app`, beside those of the agent, and what the script is given."""

import base64
import io
import json

import numpy as np
import pytest
import torch
from PIL import Image

from semfov.cli.own_looks import look_at_cells, scene_json
from semfov.data import read_image
from semfov.data.examples import example
from semfov.detection.placement import resize
from semfov.sensor import LogPolar
from tests import small
from tests.pretended import a_gpu
from tests.small import rand


@pytest.mark.slow
def test_looks_at_cells_that_the_agent_chose_are_those_of_its_search(agent, photo):
    image = read_image(photo)
    own = agent.search(image, "wine glass", how="fovea", start=47, shifts=3, closer=0)
    assert len(own) == 4
    cells = own.cells.tolist()
    for count in (1, 2, 3):
        looked = look_at_cells(agent, image, "wine glass", cells[:count])
        assert looked.record.cells.tolist() == cells[:count]
        torch.testing.assert_close(looked.record.presence, own.presence[:count])
        values = own.values[count - 1]
        assert float(values[looked.advice]) == pytest.approx(float(values[cells[count]]))  # ties are drawn
        assert looked.advice not in cells[:count]
        assert looked.agent is None
    assert "before it" in looked.describe()
    assert "before it" not in look_at_cells(agent, image, "wine glass", [3]).describe()


def test_a_search_of_a_person_ends_as_that_of_the_agent_and_both_are_counted(agent, photo):
    image = read_image(photo)
    agents = agent.search(image, "red", how="fovea", start=47, closer=0)
    assert agents.found
    cells = [47, *[cell for cell in (20, 21) if cell not in agents.cells], int(agents.cells[-1])]
    for count in range(1, len(cells)):
        assert look_at_cells(agent, image, "red", cells[:count]).agent is None
    looks = look_at_cells(agent, image, "red", [*cells, 5, 6])
    assert looks.record.cells.tolist() == cells  # and the looks after the end are none
    assert looks.agent.cells.tolist() == agents.cells.tolist()
    said = f"**You: found in {len(cells)} looks. The agent: found in {len(agents)} looks**"
    assert looks.describe().startswith(said)
    assert f"**Look {len(cells)}** shows" in looks.describe()  # numbered from 1, as on the page of a record
    assert json.loads(looks.marks())["next"] is None


def test_looks_at_cells_beside_a_gpu_are_those_on_the_cpu(agent):
    image = rand(3, 120, 160)
    here = look_at_cells(agent, image, "wine glass", [3, 7])
    with a_gpu():
        there = look_at_cells(agent.to("cuda"), image, "wine glass", [3, 7])
    assert there.advice == here.advice
    assert there.record.presence is not None
    torch.testing.assert_close(there.record.presence, here.record.presence, rtol=1e-3, atol=1e-4)


def test_marks_lie_over_the_picture(agent, photo):
    looks = look_at_cells(agent, read_image(photo), "red", [9])
    marks = json.loads(looks.marks())
    columns, rows = marks["grid"]
    assert (columns, rows) == (agent.columns, agent.rows)
    assert len(marks["belief"]) == columns * rows
    row, column = divmod(9, columns)
    assert marks["looks"][0] == pytest.approx([(column + 0.5) * 160 / columns - 0.5, (row + 0.5) * 120 / rows - 0.5])
    for x1, y1, x2, y2 in marks["boxes"]:
        assert (x1 < 28, x2 > 8, y1 < 28, y2 > 8) == (True,) * 4  # the red square


def levels_of(scene):
    """Decode the levels of a scene, each `(3, h, w)` in [0, 1]."""
    levels = []
    for uri in scene["levels"]:
        picture = Image.open(io.BytesIO(base64.b64decode(uri.partition(",")[2])))
        levels.append(torch.from_numpy(np.array(picture)).permute(2, 0, 1).float() / 255)
    return levels


def test_levels_blended_by_windows_are_near_what_the_fovea_sees():
    """The script's blend, written out here with PyTorch's enlargement, beside the sensor's own view."""
    agent = small.agent(small.Coloured(("red",), (320, 224)), sigma=25.0)
    image = example("lifeboat")
    scene = json.loads(scene_json(agent, image))
    levels = levels_of(scene)
    width, height = scene["size"]
    assert (width, height) == (image.shape[-1], image.shape[-2])
    assert [level.shape[-1] for level in levels[:2]] == [scene["pixels"][0], scene["pixels"][0] // 2]
    x, y = torch.meshgrid(torch.arange(width), torch.arange(height), indexing="xy")
    far = ((x - 300) / scene["sigma"][0]).square() + ((y - 150) / scene["sigma"][1]).square()
    blend = torch.zeros(3, height, width)
    finer = torch.zeros(height, width)
    for k, level in enumerate(levels):
        is_last = k == len(levels) - 1
        window = torch.ones(height, width) if is_last else (-0.5 * far / scene["growth"] ** (2 * k)).exp()
        enlarged = torch.nn.functional.interpolate(level[None], (height, width), mode="bilinear")[0]
        blend += (window - finer) * enlarged
        finer = window
    view = agent.eye.open(image)
    seen, elsewhere = agent.eye.pictures(view, [(300.0, 150.0), (100.0, 250.0)])
    left, top = view.placement.offset
    columns, rows = scene["pixels"]
    small_blend = resize(blend[None], (columns, rows))[0]
    canvases = torch.stack([seen, elsewhere, view.canvas[0]])[..., top : top + rows, left : left + columns]
    errors = (canvases - small_blend).abs().mean((1, 2, 3))
    assert errors[0] < 0.35 * errors[1:].min()  # than the view from another point, and the sharp picture


def test_a_sensor_without_bands_shows_the_sharp_picture():
    agent = small.agent(small.Coloured(("red",)))
    agent.eye.sensor = LogPolar(20.0)
    scene = json.loads(scene_json(agent, rand(3, 120, 160)))
    assert len(scene["levels"]) == 1
