"""Episodes of all kinds at all moments: before the first look, after each, and after the end."""

import json

import pytest
import torch

from semfov import ActivePerception, Eye, FovealObservationModel, Foveation, Panorama
from semfov.agents.episode import EpisodeLimits, Goal, StreamEpisode
from semfov.agents.fovea_episode import FoveaEpisode, GazePlan
from semfov.agents.head import HeadAgent, HeadEpisode
from semfov.agents.window_episode import GivenWindows
from semfov.agents.windows import ZoomAgent
from semfov.belief.observers import Semantic, SemanticMap
from semfov.decision.stopping import AtDetection, AtGoal, StoppingCriterion
from semfov.gaze.policies import Policy
from semfov.head.belief import SceneObserver
from semfov.head.gain import ExploreGain
from semfov.settings import DecisionSettings, StreamSettings
from semfov.zoom import GlimpseEvidence, WindowEye
from semfov.zoom.looks import LiveWindowLooks
from tests.decision.test_live_verifier import Lasting
from tests.decision.test_rule import Square, cells
from tests.decision.test_verifier import AT, FromScore
from tests.refusals import refused
from tests.small import Tiles
from tests.zoom.test_closer import evidence, own_evidence

PHOTOGRAPH = torch.full((3, 120, 160), 0.4)
PHOTOGRAPH[:, 90:110, 130:150] = torch.tensor([1.0, 0, 0])[:, None, None]
LARGE = torch.rand(3, 768, 1024, generator=torch.Generator().manual_seed(0)) * 0.03
LARGE[0, 320:352, 640:672] = 1
LIMITS = EpisodeLimits(passes=4)


def fovea(verification=True):
    """An agent that finds the red square, whose belief follows a script."""
    script = [(cells(c5=0.4), 0.6), (cells(c11=0.9), 0.9), *[(cells(c11=0.95), 0.97)] * 30]
    search, explore = (Lasting(*script), Policy("non-predictive")), (Semantic(3), Policy("random"))
    model = FromScore(thresholds=AT) if verification else None
    eye = Eye(Foveation(200.0), Square(), reference=160.0)
    return ActivePerception(eye, search, explore, verification=model, grid=(4, 3)).eval().fovea


def windows(model):
    return ZoomAgent(WindowEye(Tiles(("red", "green", "blue"), (128, 128), pure=True, fill=0.0).eval()), model).eval()


def on_photograph(target, criterion=None, **options):
    decisions = DecisionSettings(closer=options.pop("closer", None))
    plan = GazePlan(fovea(), target, start=0, shifts=5, decisions=decisions)
    return FoveaEpisode(plan, PHOTOGRAPH[None], LIMITS, criterion)


def of_windows(model, target, picture=LARGE, **settings):
    agent = windows(model)
    return agent.episode(picture, agent.task(target, **settings), LIMITS)


def given_windows():
    agent = windows(None)
    goal = Goal.of(agent.classes, 1)
    return GivenWindows(goal, GlimpseEvidence(3).eval(), LiveWindowLooks(agent.eye, agent.eye.open(LARGE)))


def of_head():
    torch.manual_seed(0)
    eye = Eye(Foveation(100.0, growth=2.0), Tiles(("red", "green", "blue"), fill=0.0, pure=True)).eval()
    observation = FovealObservationModel.identity(["red", "green", "blue"], [0.2])
    searching = FovealObservationModel.identity(["red", "green", "blue"], [0.2], miss_odds=torch.full((4, 2), 0.3))
    agent = HeadAgent(eye.requires_grad_(False), searching, observation).eval()
    agent = agent.requires_grad_(False)
    image = torch.zeros(3, 180, 360)
    image[2, 80:100, 200:220] = 1
    views = agent.views(Panorama(image))
    observer = SceneObserver(SemanticMap(agent.observation), views)
    return HeadEpisode(agent, observer, ExploreGain(views), None, limits=LIMITS)


STILL = {
    "fovea, closer looks": lambda: on_photograph(1),
    "fovea, presence": lambda: on_photograph(1, closer=0),
    "fovea, detection": lambda: on_photograph(1, lambda grid: AtDetection(grid, 1, {1: 1.0}, 0.99)),
    "fovea, goal": lambda: on_photograph(1, lambda grid: AtGoal(torch.arange(12) == 11)),
    "fovea, explores": lambda: on_photograph(None, lambda grid: StoppingCriterion()),
    "windows, closer looks": lambda: of_windows(evidence(), 1),
    "windows, presence": lambda: of_windows(GlimpseEvidence(3).eval(), 1),
    "windows, scores": lambda: of_windows(None, 1),
    "windows, finds": lambda: of_windows(GlimpseEvidence(3).eval(), None, batch=2),
    "windows, slices": lambda: of_windows(None, None),
    "windows, photograph": lambda: of_windows(own_evidence(), 1, torch.nn.functional.pad(PHOTOGRAPH, (16, 16))),
    "windows, given": given_windows,
    "head": of_head,
}

STREAMS = {
    "fovea, closer looks": (lambda: fovea().stream(1, StreamSettings(start=0, rate=0)), PHOTOGRAPH),
    "fovea, presence": (lambda: fovea(verification=False).stream(1, StreamSettings(start=0)), PHOTOGRAPH),
    "fovea, explores": (lambda: fovea().stream(None, StreamSettings()), PHOTOGRAPH),
    "windows, closer looks": (lambda: windows(evidence()).stream(1, follows=False), LARGE),
    "windows, scores": (lambda: windows(None).stream(1, follows=False), LARGE),
    "windows, finds": (lambda: windows(GlimpseEvidence(3).eval()).stream(follows=False), LARGE),
}


def checked(episode, count):
    """The record of an episode after some looks, with all that must hold at this moment."""
    assert len(episode.looks) == count
    assert episode.describe() == episode.goal.describe()
    assert episode.decision is None or episode.decision.outcome in ("found", "absent", "undecided")
    assert episode.criterion is None or isinstance(episode.criterion, str)
    record = episode.record()
    assert episode.looks == record.looks
    assert [(look.index, look.number) for look in record.looks] == [(index, index + 1) for index in range(count)]
    assert len(record.rows()) == len(record) == record.passes == count
    assert [row["seconds"] is None for row in record.rows()] == [False] * count
    times = [look.seconds for look in record.looks]
    assert times == sorted(times)
    json.dumps(record.to_dict(), allow_nan=False)
    assert record.describe()
    assert repr(record)
    return record


@pytest.mark.parametrize("kind", STILL)
@torch.inference_mode()
def test_looks_decision_and_record_of_a_picture_hold_at_any_time(kind):
    episode = STILL[kind]()
    made = []
    assert checked(episode, 0).looks == ()
    refused("frame: expected an episode that takes frames", episode.moment)
    while len(made) < 4 and episode.ending is None and (look := episode.look()) is not None:
        made.append(look)
        assert checked(episode, len(made)).looks[-1] is look
    assert made
    if kind == "windows, given":
        return
    ended = STILL[kind]()
    record = ended.run()
    assert record.ending == ended.ending is not None
    assert checked(ended, len(record)).to_dict().keys() == record.to_dict().keys()
    assert (ended.decision is None) == (record.decision is None)


@pytest.mark.parametrize("kind", STREAMS)
def test_looks_decision_and_moment_of_a_stream_hold_at_any_time(kind):
    make, frame = STREAMS[kind]
    stream = make()
    assert isinstance(stream, StreamEpisode)
    assert (stream.looks, stream.decision, stream.criterion, stream.passes) == ((), None, None, 0)
    for ask in (stream.moment, stream.record):
        refused("moment: expected a frame before it, got none; call step with a frame first", ask)
    for number in range(5):
        moment = stream.step(frame)
        assert moment.number == number == stream.passes - 1
        assert stream.looks == moment.looks == stream.record().looks
        assert len(moment.looks) >= 1
        assert stream.decision is moment.decision
        assert moment.describe()


def test_closer_looks_of_a_fovea_are_among_its_looks(tmp_path):
    """With their window and what it shows, in files, too; the fixations are those without them."""
    record = on_photograph(1).run()
    (closer,) = [look for look in record.looks if look.is_closer]
    assert record.closer[0].index == closer.index == len(record) - 1
    assert len(record.fixated) == len(record.cells) == len(record) - 1
    x1, y1, x2, y2 = closer.region
    assert x1 <= 130
    assert y1 <= 90
    assert (x2, y2) >= (150, 110)
    assert (x2 - x1) * (y2 - y1) < 160 * 120
    assert closer.fixation == ((x1 + x2 - 1) / 2, (y1 + y2 - 1) / 2)
    assert 0 < closer.value <= 1
    assert closer.seconds > record.looks[-2].seconds
    assert len(record.as_fixations("a.png").points) == len(record.cells)
    record.save(tmp_path / "a.safetensors")
    again = type(record).load(tmp_path / "a.safetensors")
    assert [row | {"seconds": None} for row in again.rows()] == [row | {"seconds": None} for row in record.rows()]
    assert again.rows()[-1]["seconds"] == pytest.approx(record.rows()[-1]["seconds"], abs=1e-3)
    assert torch.equal(again.looks[-1].detections.boxes, closer.detections.boxes)
    assert [look.is_closer for look in again.looks] == [look.is_closer for look in record.looks]
