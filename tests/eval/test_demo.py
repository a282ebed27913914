"""The demonstration as a user runs it, with a detector of red squares and with the agents of the package."""

import json
import re

import pytest
import torch
from PIL import Image

import eval.demo as program
from eval import demo_tables
from semfov import ActivePerception, FovealObservationModel, observers, policies, read_image
from semfov.belief import MapEvidence, Verification
from semfov.belief.observers import Semantic
from semfov.belief.target_evidence import Thresholds
from semfov.data.sources import Picture, embedded_picture
from semfov.episode import STAGES
from semfov.gaze.policies import POLICIES, Means, named_policy, policy_names
from semfov.zoom import GlimpseEvidence
from tests import small


@pytest.fixture
def agent():
    return small.agent(small.Coloured(("red", "wine glass")))


@pytest.fixture
def photo(tmp_path):
    picture = Image.new("RGB", (160, 120), (100, 100, 100))
    picture.paste((230, 20, 20), (8, 8, 28, 28))
    path = tmp_path / "my photo.png"
    picture.save(path)
    return path


def test_search_prints_looks_and_writes_pictures(run, photo, tmp_path):
    code, printed = run(photo, "--target", "red", "--start", 47, "--report", tmp_path / "page.html")
    assert code == 0
    assert re.search(
        r"my photo\.png: “red” found after 1 gaze shift \(by a detection at the gaze",
        printed.out,
    )
    rows = [line.split() for line in printed.out.splitlines() if line[:1] in ("0", "1")]
    assert rows[0][:3] == ["0", "(7,", "5)"]
    for name in ("scanpath.png", "views.png", "belief.png", "animation.gif"):
        with Image.open(tmp_path / "out" / name) as picture:
            picture.verify()
        assert f"out/{name}" in printed.out
    assert "<!DOCTYPE html>" in (tmp_path / "page.html").read_text(encoding="utf-8")
    assert str(tmp_path / "page.html") in printed.out
    assert not (tmp_path / "out" / "belief_bars.png").exists()


def test_a_description_is_matched_to_classes_by_word_vectors(run, photo, tmp_path):
    vectors = tmp_path / "vectors.txt"
    vectors.write_text("red 1 0.1\nwine 0 1\nglass 0.5 1\ncrimson 1 0\n")
    described = ["--target", "something crimson", "--embeddings", vectors]
    code, printed = run(photo, *described, "--start", 47, "--draw", "[]")
    assert code == 0
    assert "“something crimson” may mean: red 1.00" in printed.out
    assert "“red” found after 1 gaze shift" in printed.out
    vectors.write_text("red 1 0.8\nwine 0.8 1\nglass 1 1\ncrimson 1 0.9\n")
    code, printed = run(photo, *described, "--start", 47, "--draw", "[]")
    assert code == 0
    assert re.search(r"may mean: (red|wine glass) 1\.00, (red|wine glass) 0\.\d\d", printed.out)
    assert "“red” found" in printed.out
    code, printed = run(photo, "--target", "something crimson")
    assert code == 1
    assert "unknown class" in printed.err
    assert "--embeddings" in printed.err
    code, printed = run(photo, "--target", "zebra stripes", "--embeddings", vectors)
    assert code == 1
    assert "zebra stripes" in printed.err


@pytest.mark.parametrize("task", ["search", "exploration"])
def test_only_the_requested_pictures_are_drawn(run, photo, tmp_path, task):
    arguments = (photo, "--target", "red", "--start", 47) if task == "search" else (photo, "--explore", "--shifts", 1)
    code, _ = run(*arguments, "--draw", "[]")
    assert code == 0
    assert not (tmp_path / "out").exists()
    code, _ = run(*arguments, "--draw", "[belief, belief_bars]")
    wanted = {"belief.png", "belief_bars.png"} if task == "search" else {"map.png"}
    assert {file.name for file in (tmp_path / "out").iterdir()} == wanted
    with pytest.raises(SystemExit):
        run(*arguments, "--draw", "[portrait]")


@pytest.fixture
def large(tmp_path):
    picture = Image.new("RGB", (1280, 960), (100, 100, 100))
    picture.paste((230, 20, 20), (1000, 700, 1040, 740))
    path = tmp_path / "large" / "field.png"
    path.parent.mkdir()
    picture.save(path)
    return path


@pytest.fixture
def shipped_evidence(tmp_path, monkeypatch):
    """Ship untrained evidence for large pictures for the detector of squares."""
    monkeypatch.setattr(GlimpseEvidence, "shipped", tmp_path / "shipped")
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        GlimpseEvidence(2, 8).save(tmp_path / "shipped" / "coloured.safetensors")


def test_a_large_picture_is_looked_at_in_windows(run, large, shipped_evidence, tmp_path):
    code, printed = run(
        large, "--target", "red", "--confirm", 0.7, "--shifts", 5, "--start", 3, "--report", tmp_path / "page.html"
    )
    assert code == 0
    assert "field.png, 1280 × 960 px, looked at in windows: red: found" in printed.out
    assert "ignored for a picture of this size: start\n" in printed.out
    assert "   0  the whole picture × 0.12: 1 detection" in printed.out
    with Image.open(tmp_path / "out" / "zoom.png") as picture:
        picture.verify()
    page = (tmp_path / "page.html").read_text(encoding="utf-8")
    (episode,) = json.loads(re.search(r'id="data">(.*?)</script>', page, re.DOTALL)[1])["episodes"]
    assert episode["name"] == "field.png"
    assert episode["passes"] == str(len(episode["looks"]))
    assert episode["decision"].startswith("“red” found")
    assert len(episode["looks"]) == page.count('class="look"')
    code, printed = run(large, "--target", "red", "--confirm", 1, "--give_up", 0, "--shifts", 3)
    assert "red: undecided" in printed.out
    assert "in 4 passes. All 4 passes were used.\n" in printed.out
    code, printed = run(large, "--explore", "--until", 1000)
    assert "in 1 pass. No remaining look is expected to show enough new objects.\n" in printed.out
    (tmp_path / "out" / "zoom.png").unlink()
    code, printed = run(large, "--target", "red", "--draw", "[]")
    assert code == 0
    assert not (tmp_path / "out" / "zoom.png").exists()


def test_a_large_picture_is_looked_at_closely(run, large, shipped_evidence, tmp_path):
    evidence = GlimpseEvidence.from_pretrained("coloured")
    evidence.verification = Verification(thresholds=Thresholds(0.4, 0.0, 0.0))
    for parameter in evidence.verification.requires_grad_(False).parameters():
        parameter.zero_()  # all probabilities after closer looks are one half
    evidence.save(tmp_path / "shipped" / "coloured.safetensors")
    _, printed = run(large, "--target", "red", "--shifts", 5, "--draw", "[]", "--report", tmp_path / "page.html")
    assert "red: found (0.50) in" in printed.out
    assert "A closer look confirmed the target." in printed.out
    assert "; closer look: p 0.500 there\n" in printed.out
    assert "Closer look" in (tmp_path / "page.html").read_text(encoding="utf-8")
    _, printed = run(large, "--target", "red", "--shifts", 5, "--draw", "[]", "--closer", 0)
    assert "closer look:" not in printed.out


def test_a_folder_may_have_small_and_large_pictures(run, photo, large, shipped_evidence, tmp_path):
    photo.rename(large.with_name(photo.name))
    code, _ = run(large.parent, "--target", "red", "--start", 47, "--report", tmp_path / "page.html")
    assert code == 0
    page = (tmp_path / "page.html").read_text(encoding="utf-8")
    episodes = json.loads(re.search(r'id="data">(.*?)</script>', page, re.DOTALL)[1])["episodes"]
    assert [each["name"] for each in episodes] == ["field.png", "my photo.png"]
    assert ["looks" in each for each in episodes] == [True, False]
    assert (tmp_path / "out" / "000-field.png" / "zoom.png").is_file()
    assert (tmp_path / "out" / "001-my-photo.png" / "scanpath.png").is_file()


@pytest.mark.slow
def test_all_pictures_of_a_folder_are_explored(run, photo, tmp_path):
    Image.open(photo).save(photo.with_name("other.png"))
    code, printed = run(photo.parent, "--explore", "--shifts", 2, "--report", tmp_path / "page.html")
    assert code == 0
    assert printed.out.count("explored with 2 gaze shifts") == 2
    for folder in ("000-my-photo.png", "001-other.png"):
        assert {file.suffix for file in (tmp_path / "out" / folder).iterdir()} >= {".png", ".gif"}
        assert (tmp_path / "out" / folder / "map.png").is_file()


def test_file_names_are_escaped_in_the_report(run, photo, tmp_path):
    photo = photo.rename(photo.with_name("<img src=x onerror=alert(1)>'\"&$x$.png"))
    code, _ = run(photo, "--target", "red", "--start", 47, "--report", tmp_path / "page.html")
    assert code == 0
    page = (tmp_path / "page.html").read_text(encoding="utf-8")
    assert "<img" not in page
    data = json.loads(re.search(r'id="data">(.*?)</script>', page, re.DOTALL)[1])
    assert data["episodes"][0]["name"] == photo.name


def test_classes_are_listed_without_a_target(run, photo, tmp_path):
    code, printed = run(photo)
    assert code == 0
    assert "wine glass" in printed.out
    assert not (tmp_path / "out").exists()


def test_a_threshold_that_no_score_reaches_confirms_nothing(run, photo):
    code, printed = run(photo, "--target", "red", "--start", 47, "--confirm", 1, "--shifts", 3)
    assert code == 0
    assert "“red” undecided after 3 gaze shifts" in printed.out


class WithThresholds(observers.Semantic):
    """An observer with thresholds, so that a search can decide."""

    thresholds = Thresholds(0.99, 0.0)


def test_annotated_boxes_do_not_affect_decisions(agent, photo):
    """Boxes of a picture are drawn but not used by the search; thresholds come from the command line."""
    observer = WithThresholds(3)
    deciding = ActivePerception(
        agent.eye, (observer, policies.NonPredictive()), (observer, policies.Random()), grid=(8, 6)
    ).eval()
    picture = Picture("photo", read_image(photo), boxes=torch.tensor([[0.0, 0.0, 160.0, 120.0]]))
    common = {"target": "red", "start": 47, "shifts": 4}
    never = program.look_at(deciding, picture, program.DemoConfig(**common))
    assert (never.found, never.shifts, never.decision.outcome) == (False, 4, "undecided")
    soon = program.look_at(deciding, picture, program.DemoConfig(**common, confirm=0.0))
    assert soon.decision.outcome == "found"
    assert 1 <= soon.shifts < 4
    assert soon.posterior[-1][soon.cells].max() >= 0.9 * soon.posterior[-1].max()
    tired = program.look_at(deciding, picture, program.DemoConfig(**common, give_up=1.0))
    assert (tired.found, tired.shifts) == (False, 0)
    assert tired.decision.outcome == ("absent" if tired.decision.probability < 0.5 else "undecided")


def test_the_stages_of_every_look_are_timed(agent, photo):
    picture = Picture("photo", read_image(photo))
    plain = agent.search(picture.image, "red", start=40)
    shown = program.look_at(agent, picture, program.DemoConfig(target="red", start=40))
    assert torch.equal(plain.cells, shown.cells)
    assert torch.equal(plain.values, shown.values)
    assert len(shown.seconds) == len(shown) > 1
    assert all(set(look) == set(STAGES) and min(look.values()) > 0 for look in shown.seconds)


def test_the_duration_of_every_look_is_printed(agent, photo):
    picture = Picture("photo", read_image(photo))
    scanpath = program.look_at(agent, picture, program.DemoConfig(explore=True, start=40, shifts=2))
    lines = demo_tables.path_table("photo", scanpath).splitlines()
    assert lines[1].endswith("ms")
    milliseconds = [f"{1000 * sum(look.values()):.0f}" for look in scanpath.seconds]
    assert [line.split()[-1] for line in lines[2 : lines.index("")]] == milliseconds


@pytest.fixture(scope="module")
def default_agent():
    """The agent that the demonstration uses by default."""
    return program.make_agent(program.DemoConfig())


@pytest.fixture(scope="module")
def cup(default_agent) -> Picture:
    return embedded_picture(default_agent.classes[1:], "cup", seed=0)


def demo_and_agent(agent, picture, **how):
    """Scanpaths of the demonstration, which times each stage, and of the agent alone."""
    config = program.DemoConfig(start=0, shifts=2, until=0, **how)
    shown = program.look_at(agent, picture, config)
    assert len(shown.seconds) == len(shown)
    assert all(set(look) == set(STAGES) for look in shown.seconds)
    with torch.inference_mode():
        if config.target is None:
            return shown, agent.explore(picture.image, start=0, shifts=2, worth=0)
        return shown, agent.search(picture.image, config.target, start=0, shifts=2)


@pytest.fixture(scope="module")
def means(default_agent) -> Means:
    """Models with which every policy can be made."""
    name = default_agent.eye.detector.name
    models = FovealObservationModel.from_pretrained(name), MapEvidence.from_pretrained(name)
    return Means(*(each.requires_grad_(False) for each in models))


@pytest.fixture(scope="module")
def dirichlet_map(default_agent):
    """The observer of policies that need Dirichlet distributions."""
    return Semantic(len(default_agent.classes), tempering=0.5)


@pytest.mark.weights
@pytest.mark.parametrize("name", [name for name in policy_names("search") if POLICIES[name].table is None])
def test_the_demonstration_searches_as_the_agent_does_with_every_policy(name, default_agent, means, dirichlet_map, cup):
    """With a map of all classes for policies that need one, otherwise with the belief of the agent."""
    mapping = default_agent.exploring.observer, default_agent.exploring.policy
    observer = dirichlet_map if name in ("predictive", "neighbourhood") else default_agent.searching.observer
    agent = ActivePerception(default_agent.eye, (observer, named_policy(name, "search", means)), mapping).eval()
    shown, plain = demo_and_agent(agent, cup, target="cup")
    assert torch.equal(shown.cells, plain.cells)
    assert torch.equal(shown.values, plain.values)


@pytest.mark.weights
@pytest.mark.parametrize("name", [name for name in policy_names("exploration") if POLICIES[name].table is None])
def test_the_demonstration_explores_as_the_agent_does_with_every_policy(name, default_agent, means, dirichlet_map, cup):
    seeking = default_agent.searching.observer, default_agent.searching.policy
    observer = default_agent.exploring.observer if name in ("random", "closer-look", "expected-gain") else dirichlet_map
    mapping = observer, named_policy(name, "exploration", means)
    agent = ActivePerception(default_agent.eye, seeking, mapping).eval()
    shown, plain = demo_and_agent(agent, cup, explore=True)
    assert torch.equal(shown.cells, plain.cells)
    assert torch.equal(shown.values, plain.values)
    assert shown.shifts == 2


@pytest.mark.weights
@pytest.mark.slow
@pytest.mark.parametrize("task", [("--target", "cup"), ("--explore",)], ids=["search", "exploration"])
@pytest.mark.parametrize(
    "agent",
    [
        (),
        ("--agent", "published"),
        ("--agent", "published", "--sensor", "published-narrow"),
        ("--agent", "raw"),
        ("--agent", "raw", "--sensor", "gradual"),
    ],
    ids=" ".join,
)
def test_agents_of_the_package_run_in_the_demonstration(agent, task, cup, tmp_path, capsys):
    photo = tmp_path / "photo.png"
    pixels = (cup.image * 255).round().to(torch.uint8).permute(1, 2, 0).numpy()
    Image.fromarray(pixels).save(photo)
    short = ["--shifts", "1", "--start", "0", "--out", str(tmp_path / "out"), "--report", str(tmp_path / "page.html")]
    assert program.main([str(photo), *task, *agent, *short]) == 0
    printed = capsys.readouterr().out
    assert "photo.png: " in printed
    assert [line.split()[0] for line in printed.splitlines() if line[:1] in ("0", "1")] == ["0", "1"]
    written = {path.name for path in (tmp_path / "out").iterdir()}
    assert {"scanpath.png", "views.png", "animation.gif", "map.png" if len(task) == 1 else "belief.png"} <= written
    assert "<!DOCTYPE html>" in (tmp_path / "page.html").read_text(encoding="utf-8")


@pytest.mark.slow
@pytest.mark.weights
def test_agents_have_their_own_sensor_unless_one_is_named(default_agent):
    """The recommended agent's sensor is `gradual`, the published agent's the wide fovea."""
    expected = {
        ("recommended", None): (100, 2),
        ("published", None): (100, 1),
        ("published", "published-narrow"): (50, 1),
        ("raw", "gradual"): (100, 2),
    }
    for (kind, sensor), (sigma, growth) in expected.items():
        eye = program.make_agent(program.DemoConfig(agent=kind, sensor=sensor)).eye
        assert (float(eye.sensor.sigma), eye.sensor.growth) == pytest.approx((sigma, growth))
