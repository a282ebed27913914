"""A camera that speaks ONVIF, against a small server of SOAP messages."""

import math
from datetime import timedelta

import pytest

from semfov import HeadAgent, Panorama
from semfov.head import Speeds, open_scene
from semfov.head.onvif import OnvifCamera, OnvifClient, Position
from semfov.settings import SearchSettings
from tests.head.onvif_server import PASSWORD, SOAP, TYPES, USER, OnvifServer, envelope
from tests.refusals import refused, unusable

PAN, TILT = (-170.0, 170.0), (-30.0, 90.0)
FAST = Speeds(look=0.2, eye_start=0.0, eye=0.0, settle=0.0)


@pytest.fixture
def server():
    server = OnvifServer()
    yield server
    server.close()


@pytest.fixture
def make(server, panorama):
    """Makes the camera, which stands in a panorama and shows what is ahead of it by the server's own position."""
    world = Panorama(panorama, (104, 78))

    def frame():
        pan, tilt, _ = server.position
        return world.look_at((170 * pan, 30 + 60 * tilt), 60.0)

    def camera(**options):
        client = OnvifClient(server.address, USER, PASSWORD)
        return OnvifCamera(client, frame, (104, 78), pan=PAN, tilt=TILT, speeds=FAST, **options)

    return camera


@pytest.mark.parametrize("relative", [False, True])
@pytest.mark.parametrize("says", [True, False])
def test_it_turns_where_it_is_sent_and_tells_where_it_is(server, make, panorama, relative, says):
    server.says_whether_it_moves = says
    camera = make(relative=relative)
    places = {(-170, -30): (-1, -1), (85, 30): (0.5, 0), (170, 90): (1, 1), (0, 0): (0, -0.5)}
    for direction, position in places.items():
        frame = camera.look_at(direction, 60.0)
        assert server.position[:2] == pytest.approx(position, abs=1e-5)
        assert frame.direction == pytest.approx(direction, abs=1e-3)
        assert frame.field == pytest.approx(60.0)
    assert {move[0] for move in server.moves} == {"RelativeMove" if relative else "AbsoluteMove"}
    assert server.position[2] == 0  # a camera of one field is not told to zoom


@pytest.mark.parametrize("relative", [False, True])
def test_a_camera_without_borders_turns_across_where_its_ends_meet(server, panorama, relative):
    """180 degrees to the left and to the right are one direction, which it tells as the left one."""
    server.round = True
    client = OnvifClient(server.address, USER, PASSWORD)
    camera = OnvifCamera(client, lambda: panorama, (104, 78), tilt=TILT, speeds=FAST, relative=relative)
    for pan, told in ((170.0, 170.0), (180.0, -180.0), (-180.0, -180.0), (-170.0, -170.0), (10.0, 10.0)):
        frame = camera.look_at((pan, 0.0), 60.0)
        assert frame.direction[0] == pytest.approx(told, abs=1e-3)
    if relative:
        assert max(abs(move[1]) for move in server.moves[1:4]) < 0.1  # the short way


def test_a_turn_that_is_longer_than_one_relative_move_takes_two(server, make):
    camera = make(relative=True)
    camera.look_at((-170.0, 0.0), 60.0)
    server.moves.clear()
    assert camera.look_at((160.0, 0.0), 60.0).direction[0] == pytest.approx(160.0, abs=1e-3)
    assert [move[1] for move in server.moves] == pytest.approx([1.0, 330 / 170 - 1], abs=1e-5)


def test_a_digest_has_the_time_of_the_camera(server, make):
    """Its clock is years behind; without an answer to the time it is taken to have ours."""
    server.ahead = timedelta(days=-2000)
    assert make().where() == Position(0.5, -0.5, 0)
    server.answers["GetSystemDateAndTime"] = (400, "not here")
    unusable("Sender not Authorized", make)
    server.ahead = timedelta()
    assert make().where() == Position(0.5, -0.5, 0)


@pytest.mark.parametrize("year", [1, 9999])
def test_a_clock_of_another_century_is_ignored(server, make, year):
    date = f"<t:Date><t:Year>{year}</t:Year><t:Month>12</t:Month><t:Day>31</t:Day></t:Date>"
    time = "<t:Time><t:Hour>23</t:Hour><t:Minute>59</t:Minute><t:Second>59</t:Second></t:Time>"
    moment = f'<r xmlns:t="{TYPES}"><t:UTCDateTime>{time}{date}</t:UTCDateTime></r>'
    server.answers["GetSystemDateAndTime"] = (200, envelope(moment))
    assert make().where() == Position(0.5, -0.5, 0)


def test_a_fault_is_one_also_where_http_says_that_all_is_well(server, make):
    fault = f'<s:Fault xmlns:s="{SOAP}"><s:Reason><s:Text xml:lang="en">No space left</s:Text></s:Reason></s:Fault>'
    camera = make()
    server.answers["GetStatus"] = (200, envelope(fault))
    unusable("refuses a command: No space left", camera.where)
    server.answers["GetStatus"] = (200, envelope(f'<s:Fault xmlns:s="{SOAP}"/>'))
    unusable("it does not say why", camera.where)


def test_positions_in_degrees_are_not_taken_for_those_of_onvif(server, make):
    camera = make()
    degrees = "http://www.onvif.org/ver10/tptz/PanTiltSpaces/SphericalPositionSpaceDegrees"
    for attributes in ('x="85" y="30"', f'x="0.5" y="0" space="{degrees}"'):
        place = f'<r xmlns:t="{TYPES}"><t:Position><t:PanTilt {attributes}/></t:Position></r>'
        server.answers["GetStatus"] = (200, envelope(place))
        unusable("expected its position from -1 to 1", camera.where)


def test_the_agent_searches_with_it(server, make, eye, models, panorama):
    """What it sees is that of a panorama in the same directions."""
    agent = HeadAgent(eye, *models).eval()
    path = agent.search(make(), "blue", SearchSettings(passes=4, confirm=1.0))
    assert len(server.moves) == 4
    last = server.moves[-1]
    assert (170 * last[1], 30 + 60 * last[2]) == pytest.approx(tuple(path.pose(-1)[:2].tolist()), abs=1e-3)
    assert path.views.world.pan == PAN


def test_zoom_has_equal_steps_of_the_focal_length(server, make):
    camera = make(fields=(4.0, 20.0, 60.0))
    focal = [1 / math.tan(math.radians(field / 2)) for field in (60.0, 20.0, 4.0)]
    expected = (focal[1] - focal[0]) / (focal[2] - focal[0])
    for field, zoom in ((60.0, 0.0), (20.0, expected), (4.0, 1.0)):
        frame = camera.look_at((10.0, 0.0), field)
        assert server.position[2] == pytest.approx(zoom, abs=1e-6)
        assert frame.field == pytest.approx(field, rel=1e-3)
    assert camera.position_of((-170, 90), 60.0) == Position(-1, 1, 0)
    assert open_scene(camera).fields == (4.0, 20.0, 60.0)


def test_what_a_camera_refuses_and_answers_is_an_error_with_the_reason(server, make):
    unusable("refuses a command: Sender not Authorized", OnvifClient(server.address, USER, "wrong").services)
    camera = make(patience=0.0)
    bomb = '<!DOCTYPE x [<!ENTITY a "aaaa"><!ENTITY b "&a;&a;">]>' + envelope("<r>&b;</r>").partition("?>")[2]
    for answer, message in (
        (envelope("<r/>"), "got a status without pan and tilt"),
        (bomb, "without a document type"),
        (bomb.encode("utf-16"), "without a document type"),
        ("<a><b></a>", "got none that can be read"),
        (b"x" * (1 << 20) + b"y", "at most 1048576 bytes"),
        (b"", "got none that can be read"),
    ):
        server.answers["GetStatus"] = (200, answer)
        unusable(message, camera.where)
    server.answers["GetStatus"] = (500, "broken")
    unusable("refuses a command: 500", camera.where)
    del server.answers["GetStatus"]
    server.slow = 1000
    unusable("camera: expected it at .* within 0 s", camera.look_at, (0.0, 0.0), 60.0)
    server.answers["GetProfiles"] = (200, envelope("<r/>"))
    unusable("a media profile with pan and tilt", make)
    server.answers["GetCapabilities"] = (200, envelope("<r/>"))
    unusable("the service PTZ", make)


def test_arguments_are_checked(server, make, panorama):
    refused("address: expected the address of a camera", OnvifClient, "file:///etc/passwd")
    client = OnvifClient(server.address, USER, PASSWORD)
    refused("frame: expected a function", OnvifCamera, client, None, (104, 78))
    refused("pan: expected two different limits", OnvifCamera, client, lambda: panorama, (360, 180), pan=(90, -90))
    for limits in ((1,), (0, 90, 180), 90.0, None, "ab", (math.nan, 90.0), (None, 90.0)):
        refused("pan: expected a pair", OnvifCamera, client, lambda: panorama, (360, 180), pan=limits)
    refused("tilt: expected degrees", OnvifCamera, client, lambda: panorama, (360, 180), tilt=(-1.0, 1.0))
    closed = OnvifClient("http://127.0.0.1:9", timeout=0.5)
    unusable("no answer from http://127.0.0.1:9", closed.services)
