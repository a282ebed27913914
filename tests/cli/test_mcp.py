"""The command `semfov mcp`: its tools as the SDK's own client sees them, hostile names included."""

import asyncio
import base64
import io
import json
import math
import os
import shutil
import sys
from collections.abc import Callable, Coroutine
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from torch import Tensor

from semfov.agent import ActivePerception
from semfov.cli import picture_tools
from semfov.cli.main import main
from semfov.cli.mcp import make_server
from semfov.cli.picture_tools import PictureTools
from semfov.data.examples import example

mcp = pytest.importorskip("mcp")


def save(pixels: Tensor, path: Path) -> None:
    Image.fromarray((pixels * 255).round().byte().permute(1, 2, 0).numpy()).save(path)


@pytest.fixture(scope="module")
def agent() -> ActivePerception:
    return ActivePerception.recommended()


@pytest.fixture(scope="module")
def pictures(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a sheet of photographs and, in a folder of it, a beach."""
    folder = tmp_path_factory.mktemp("mcp")
    (folder / "sub").mkdir()
    save(example("sheet"), folder / "sheet.png")
    save(example("beach"), folder / "sub" / "beach.png")
    return folder


@pytest.fixture
def tools(tmp_path: Path, pictures: Path, agent: ActivePerception) -> PictureTools:
    """Tools over a copy of the folder; beside it lies a picture that is not its own."""
    folder = shutil.copytree(pictures, tmp_path / "pictures")
    save(torch.zeros(3, 32, 48), tmp_path / "secret.png")
    (folder / "link.png").symlink_to(tmp_path / "secret.png")
    (folder / "ring.png").symlink_to(folder / "ring.png")
    return PictureTools(folder, agent)


def talk(tools: PictureTools, talking: Callable[[Any], Coroutine[Any, Any, Any]]) -> Any:
    """Let the SDK's client talk to the server of some tools."""

    async def run() -> Any:
        async with mcp.Client(make_server(tools)) as client:
            return await talking(client)

    return asyncio.run(run())


def call(tools: PictureTools, name: str, **arguments: Any) -> Any:
    """Call one tool by the SDK's client."""
    return talk(tools, lambda client: client.call_tool(name, arguments))


def test_the_tools_name_their_arguments_and_the_classes(tools):
    listed = talk(tools, lambda client: client.list_tools()).tools
    arguments = {tool.name: set(tool.input_schema["properties"]) for tool in listed}
    assert arguments == {
        "pictures": set(),
        "search": {"picture", "target", "passes", "prior"},
        "find": {"picture", "classes", "passes"},
        "look": {"picture", "x", "y", "width"},
        "where_people_look": {"picture"},
        "check": {"fixations"},
    }
    assert all(tool.description for tool in listed)
    of_search = next(tool.description for tool in listed if tool.name == "search")
    assert "toothbrush" in of_search


def test_pictures_are_those_below_the_folder_and_no_links_out_of_it(tools):
    assert call(tools, "pictures").structured_content == {"result": ["sheet.png", "sub/beach.png"]}


@pytest.mark.slow
def test_a_search_answers_as_the_agent_does(tools, agent):
    told = call(tools, "search", picture="sub/beach.png", target="boat", prior=0.2).structured_content
    record = agent.search(tools.folder / "sub" / "beach.png", "boat", passes=16, prior=0.2)
    assert told["result"] == record.describe()
    assert told["ended"] == record.words.ended
    assert told["probability"] == pytest.approx(record.decision.probability, abs=1e-4)
    assert told["passes"] == record.passes
    assert told["size"] == [640, 499]
    assert [row["name"] for row in told["objects"]] == [agent.classes[label] for label in record.objects.labels]
    assert told["expected"] == told["further"] == {}


@pytest.mark.slow
def test_a_find_says_what_further_looks_can_bring(tools):
    few, many = (
        call(tools, "find", picture="sheet.png", classes=["person"], passes=passes).structured_content
        for passes in (2, 16)
    )
    assert few["passes"] == 2
    assert few["passes"] < many["passes"] <= 16
    assert len(few["objects"]) < len(many["objects"])
    for told in (few, many):
        more = told["expected"]["person"] - len(told["objects"])
        assert told["further"]["person"] == pytest.approx(max(more, 0), abs=0.01)


def test_a_find_of_all_classes_has_no_number_where_none_is_known(tools, agent):
    told = call(tools, "find", picture="sub/beach.png", classes=[], passes=2).structured_content
    record = agent.find_all(tools.folder / "sub" / "beach.png", passes=2)
    unknown = {name for name, number in record.expected.items() if math.isnan(number)}
    assert unknown
    for numbers in (told["expected"], told["further"]):
        assert {name for name, number in numbers.items() if number is None} == unknown
        assert numbers.keys() == record.expected.keys()


@pytest.mark.slow
def test_a_look_shows_the_crop_and_places_its_objects_in_the_picture(tools):
    whole = call(tools, "find", picture="sheet.png", classes=["person"], passes=16).structured_content
    x1, y1, x2, y2 = max(whole["objects"], key=lambda row: row["probability"])["box"]
    answer = call(tools, "look", picture="sheet.png", x=(x1 + x2) / 2, y=(y1 + y2) / 2, width=200)
    picture, words = answer.content
    shown = Image.open(io.BytesIO(base64.b64decode(picture.data)))
    left, top, right, bottom = json.loads(words.text)["box"]
    assert (right - left, bottom - top) == (200, 200)
    assert shown.size == (800, 800)
    original = Image.open(tools.folder / "sheet.png").crop((left, top, right, bottom))
    small = np.asarray(shown.resize((200, 200), Image.Resampling.BOX), dtype=float)
    assert np.abs(small - np.asarray(original, dtype=float)).mean() < 8  # of 255: what JPEG and resampling cost
    people = [row["box"] for row in json.loads(words.text)["objects"] if row["name"] == "person"]
    overlaps = [overlap((x1, y1, x2, y2), box) for box in people]
    assert max(overlaps) > 0.5


def overlap(one: tuple[float, ...], other: tuple[float, ...]) -> float:
    """Intersection over union of two boxes."""
    width = min(one[2], other[2]) - max(one[0], other[0])
    height = min(one[3], other[3]) - max(one[1], other[1])
    common = max(width, 0) * max(height, 0)
    areas = [(box[2] - box[0]) * (box[3] - box[1]) for box in (one, other)]
    return common / (sum(areas) - common)


@pytest.mark.parametrize("place", [(math.nan, 5, 100), (5, math.inf, 100), (5, 5, math.nan), (5, -1, 100)])
def test_a_place_is_a_pixel_of_the_picture(tools, place):
    with pytest.raises(ValueError, match=r"(x|y|width): expected "):
        tools.look("sheet.png", *place)


@pytest.mark.parametrize(("x", "y"), [(0, 0), (1759, 1025), (1760, 1026), (880, 513)])
def test_a_crop_at_a_border_is_moved_into_the_picture(tools, x, y):
    left, top, right, bottom = tools.look("sheet.png", x, y, 100).box
    assert (right - left, bottom - top) == (100, 100)
    assert left >= 0
    assert top >= 0
    assert right <= 1760
    assert bottom <= 1026
    assert left <= x <= right
    assert top <= y <= bottom


@pytest.mark.slow
def test_people_look_at_places_of_the_picture(tools, agent):
    told = call(tools, "where_people_look", picture="sub/beach.png").structured_content
    assert told["places"] == agent.gaze(tools.folder / "sub" / "beach.png").peaks()
    assert told["caution"] is None


def test_a_file_of_fixations_is_checked_beside_the_pictures(tools):
    points = [(300 + 5 * index, 200 + 5 * index) for index in range(20)]
    for name, shift in (("good.csv", 0), ("bad.csv", 2000)):
        rows = [f"anna,beach.png,{x + shift},{y},0.2" for x, y in points]
        (tools.folder / name).write_text("\n".join(["subject,picture,x,y,duration", *rows]) + "\n")
    good, bad = (call(tools, "check", fixations=name).structured_content["result"] for name in ("good.csv", "bad.csv"))
    assert not [line for line in good if "outside" in line]
    assert [line for line in bad if line.startswith("suspicious: ") and "outside" in line]


HOSTILE = [
    "../secret.png", "link.png", "ring.png", "sub/../../secret.png", "/etc/hostname", "~/secret.png", "sub", "", ".",
    "no.png", "a" * 5000, "x\0y", "\udcff", "sub\\..\\..\\secret.png", "file:///etc/hostname",
    "/vsicurl/http://127.0.0.1/a.png", "http://127.0.0.1/a.png", "-", "*", "example:beach",
]  # fmt: skip


@pytest.mark.parametrize("name", HOSTILE, ids=range(len(HOSTILE)))
def test_other_names_are_refused_and_the_model_is_told_what_was_expected(tools, name):
    calls = {
        "search": lambda: tools.search(name, "person"),
        "find": lambda: tools.find(name, []),
        "look": lambda: tools.look(name, 5, 5, 10),
        "where_people_look": lambda: tools.where_people_look(name),
        "check": lambda: tools.check(name),
    }
    for made in calls.values():
        with pytest.raises(ValueError, match="picture: expected the path of a file below the folder"):
            made()


@pytest.mark.parametrize(
    ("name", "arguments", "expected"),
    [
        ("search", {"picture": "../secret.png", "target": "person"}, "the path of a file below the folder"),
        ("search", {"picture": "sheet.png", "target": "persn"}, "did you mean 'person'"),
        ("search", {"picture": "sheet.png", "target": "person", "passes": 1000}, "passes: expected 1 to 64, got 1000"),
        ("search", {"picture": "sheet.png", "target": "person", "prior": 2.0}, "prior: expected"),
        ("find", {"picture": "sheet.png", "classes": ["person"], "passes": 0}, "passes: expected 1 to 64, got 0"),
        ("look", {"picture": "sheet.png", "x": 1e9, "y": 0, "width": 100}, "x: expected 0 to 1760"),
        ("look", {"picture": "sheet.png", "x": 5, "y": 5, "width": 1}, "width: expected 8 to 1760"),
    ],
)
def test_the_model_is_told_why_a_call_is_refused(tools, name, arguments, expected):
    answer = call(tools, name, **arguments)
    assert answer.is_error
    assert expected in answer.content[0].text


def test_names_that_the_protocol_cannot_say_are_left_out(tools):
    name = os.fsencode(tools.folder) + b"/caf\xe9.png"
    with open(name, "wb") as file:
        file.write((tools.folder / "sheet.png").read_bytes())
    assert call(tools, "pictures").structured_content == {"result": ["sheet.png", "sub/beach.png"]}


def test_a_crop_is_no_wider_than_can_be_shown(tools, monkeypatch):
    monkeypatch.setattr(picture_tools, "_WIDEST", 500)
    with pytest.raises(ValueError, match="width: expected 8 to 500 pixels, got 600"):
        tools.look("sheet.png", 800, 500, 600)


@pytest.fixture(scope="module")
def raw_agent() -> ActivePerception:
    return ActivePerception.raw("yolox-nano")


@pytest.mark.slow
def test_an_agent_without_shares_of_its_fit_searches_without_a_prior(tools, raw_agent):
    raw = PictureTools(tools.folder, raw_agent)
    answer = call(raw, "search", picture="sub/beach.png", target="boat", passes=4)
    assert not answer.is_error
    found = answer.structured_content
    record = raw_agent.search(tools.folder / "sub" / "beach.png", "boat", passes=4)
    assert found["probability"] is None
    assert found["score"] == pytest.approx(record.decision.probability, abs=1e-4)
    assert [row["probability"] for row in found["objects"]] == [None] * len(record.objects)


@pytest.mark.slow
@pytest.mark.parametrize("learned", [True, False])
def test_objects_have_a_probability_or_a_score(tools, agent, raw_agent, learned):
    of_agent = PictureTools(tools.folder, agent if learned else raw_agent)
    rows = call(of_agent, "find", picture="sub/beach.png", classes=[], passes=4).structured_content["objects"]
    seen = json.loads(call(of_agent, "look", picture="sub/beach.png", x=320, y=250, width=480).content[1].text)
    assert rows
    assert seen["objects"]
    number, empty = ("probability", "score") if learned else ("score", "probability")
    for row in [*rows, *seen["objects"]]:
        assert 0 < row[number] <= 1
        assert row[empty] is None


def test_a_check_opens_no_picture_by_a_link_out_of_the_folder(tools):
    rows = [f"anna,link.png,{x},10,0.2" for x in range(10, 30)]
    (tools.folder / "f.csv").write_text("\n".join(["subject,picture,x,y,duration", *rows]) + "\n")
    told = call(tools, "check", fixations="f.csv")
    assert "48 × 32" not in str(told.content)


def test_a_folder_is_needed(tmp_path, agent):
    with pytest.raises(Exception, match="folder: expected a folder with pictures, got"):
        PictureTools(tmp_path / "none", agent)


@pytest.mark.slow
def test_the_command_speaks_the_protocol_on_its_standard_streams(tools):
    async def run() -> list[str]:
        started = mcp.StdioServerParameters(command=sys.executable, args=["-m", "semfov", "mcp", str(tools.folder)])
        async with mcp.Client(started) as client:
            assert client.server_info.name == "semfov"
            answer = await client.call_tool("pictures", {})
            return list(answer.structured_content["result"])

    assert asyncio.run(run()) == ["sheet.png", "sub/beach.png"]


def test_without_the_sdk_the_command_says_what_to_install(monkeypatch, capsys, tmp_path):
    monkeypatch.setitem(sys.modules, "mcp.server", None)
    assert main(["mcp", str(tmp_path)]) != 0
    assert 'pip install "semfov[mcp]"' in capsys.readouterr().err
