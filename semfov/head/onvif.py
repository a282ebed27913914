"""Cameras that speak ONVIF: pan, tilt and zoom over the network, by SOAP messages of the standard library."""

import base64
import hashlib
import math
import os
import time
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from http.client import HTTPException
from typing import Any, NamedTuple
from urllib.error import HTTPError, URLError
from urllib.parse import urlsplit, urlunsplit
from urllib.request import HTTPRedirectHandler, Request, build_opener
from xml.etree import ElementTree as XML
from xml.sax.saxutils import escape

from semfov.data.inputs import ImageLike
from semfov.errors import DataError, check, check_number
from semfov.head.camera import CameraFrame, PanTiltCamera
from semfov.head.scenes import check_fields, check_limits
from semfov.head.speeds import Speeds

_MOST_BYTES = 1 << 20  # of an answer
_POLL = 0.05  # seconds between two questions whether the camera has arrived
_NEAR = 0.01  # largest distance from the goal, in the units of ONVIF, at which a camera that says nothing has arrived
_OTHER_CENTURY = timedelta(days=36525)  # from here on the clock of a camera, which may begin in 1970, says nothing
_SECURITY = "http://docs.oasis-open.org/wss/2004/01/oasis-200401-wss-"
_DEVICE = "http://www.onvif.org/ver10/device/wsdl"
_MEDIA = "http://www.onvif.org/ver10/media/wsdl"
_PTZ = "http://www.onvif.org/ver20/ptz/wsdl"
_TYPES = "http://www.onvif.org/ver10/schema"
_SOAP = "http://www.w3.org/2003/05/soap-envelope"
_SPACES = "http://www.onvif.org/ver10/tptz"
_PREFIXES = {"s": _SOAP, "t": _TYPES, "m": _MEDIA}  # as paths through an answer write them, such as `t:PTZ/t:XAddr`
_FARTHEST = 1.0  # largest translation of one relative move, in the units of ONVIF
_BEYOND = 1.001  # largest position in the units of ONVIF, with its rounding


class Position(NamedTuple):
    """Position of a camera in the units of ONVIF: pan and tilt from -1 to 1, zoom from 0 to 1."""

    pan: float
    tilt: float
    zoom: float


class _Builder(XML.TreeBuilder):
    """Builds a document without a type, which could define entities that grow without limit."""

    def doctype(self, name: str, public: str | None, system: str | None) -> None:
        """Refuse it."""
        raise DataError(f"camera: expected a message without a document type, got <!DOCTYPE {name}>")


class _NoRedirects(HTTPRedirectHandler):
    """What follows no answer to another address: a camera says nothing of other machines."""

    def redirect_request(self, *_: Any) -> None:
        """Follow nothing."""


_OPENER = build_opener(_NoRedirects)


class OnvifClient:
    """Sends commands to a camera, and reads its answers.

    Args:
        address: of the camera, such as `http://192.168.0.20`, or of its device service.
        user: name of a user; None for a camera without users.
        password: the user's password, which is sent as a digest.
        timeout: seconds to wait for an answer.

    Raises:
        InputError: the address is none of `http` or `https`.

    >>> OnvifClient("http://192.168.0.20").address
    'http://192.168.0.20/onvif/device_service'
    """

    def __init__(self, address: str, user: str | None = None, password: str = "", timeout: float = 5.0) -> None:
        parts = urlsplit(address)
        is_address = parts.scheme in ("http", "https") and bool(parts.netloc)
        check(is_address, "address", "the address of a camera, such as http://192.168.0.20", repr(address))
        check_number(timeout, "timeout", 1e-3, 1e6)
        self.address = address if parts.path.strip("/") else f"{address.rstrip('/')}/onvif/device_service"
        self.user = user
        self.password = password
        self.timeout = timeout
        self._ahead: timedelta | None = None  # of the camera's clock; None before it was asked for

    def services(self) -> dict[str, str]:
        """Ask for the addresses of the services `PTZ` and `Media`.

        Returns:
            The addresses by name.

        Raises:
            DataError: the camera does not answer, or lacks one of them.
        """
        body = f'<GetCapabilities xmlns="{_DEVICE}"><Category>All</Category></GetCapabilities>'
        answer = self.call(self.address, body)
        found = {}
        for name in ("PTZ", "Media"):
            element = answer.find(f".//t:{name}/t:XAddr", _PREFIXES)
            if element is None or not element.text:
                raise DataError(f"camera: expected a camera with the service {name}, got one without it")
            # A camera behind a router gives its own address, at which it cannot be reached from here: scheme and host
            # are those that it answers at.
            device = urlsplit(self.address)
            service = urlsplit(element.text.strip())
            found[name] = urlunsplit(service._replace(scheme=device.scheme, netloc=device.netloc))
        return found

    def call(self, address: str, body: str) -> XML.Element:
        """Send a message.

        Args:
            address: of the service.
            body: XML of the command.

        Returns:
            The answer.

        Raises:
            DataError: the camera does not answer, refuses the command, or answers what is no message.
        """
        if self.user is not None and self._ahead is None:
            self._ahead = self._clock_difference()
        head = "" if self.user is None else self._credentials(self.user)
        return self._send(address, head, body)

    def _send(self, address: str, head: str, body: str) -> XML.Element:
        """Send a message with a header, and read the answer."""
        text = f'<s:Envelope xmlns:s="{_SOAP}"><s:Header>{head}</s:Header><s:Body>{body}</s:Body></s:Envelope>'
        request = Request(address, text.encode(), {"Content-Type": "application/soap+xml; charset=utf-8"})
        try:
            with _OPENER.open(request, timeout=self.timeout) as answer:
                message = _parsed(answer.read(_MOST_BYTES + 1))
        except HTTPError as error:
            raise DataError(f"camera: it refuses a command: {_reason_of(error)}") from None
        except (URLError, HTTPException, OSError, ValueError) as error:
            raise DataError(f"camera: no answer from {address} ({error}); check the address") from None
        if message.find("s:Body/s:Fault", _PREFIXES) is not None:
            raise DataError(f"camera: it refuses a command: {_reason(message) or 'it does not say why'}")
        return message

    def _clock_difference(self) -> timedelta:
        """Ask how far the camera's clock is ahead of ours: it refuses a digest that is minutes old, or of the future.

        Every camera tells its time without a user (ONVIF Core, `GetSystemDateAndTime`); one that does not, or is
        a century away, is taken to have ours.
        """
        try:
            answer = self._send(self.address, "", f'<GetSystemDateAndTime xmlns="{_DEVICE}"/>')
            moment = answer.find(".//t:UTCDateTime", _PREFIXES)
            if moment is None:
                return timedelta()
            ahead = _time_of(moment) - datetime.now(UTC)
        except (DataError, ValueError, OverflowError):
            return timedelta()
        return ahead if abs(ahead) < _OTHER_CENTURY else timedelta()

    def _credentials(self, user: str) -> str:
        """Make the header that names a user, with a digest of the password for this message alone."""
        nonce = os.urandom(16)
        now_there = datetime.now(UTC) + (self._ahead or timedelta())
        created = now_there.strftime("%Y-%m-%dT%H:%M:%SZ")
        # WS-Security UsernameToken: the digest of nonce, time and password, in this order.
        secret = nonce + created.encode() + self.password.encode()
        digest = base64.b64encode(hashlib.sha1(secret).digest()).decode()
        kind = f"{_SECURITY}username-token-profile-1.0#PasswordDigest"
        parts = [
            f"<w:Username>{escape(user)}</w:Username>",
            f'<w:Password Type="{kind}">{digest}</w:Password>',
            f"<w:Nonce>{base64.b64encode(nonce).decode()}</w:Nonce>",
            f'<u:Created xmlns:u="{_SECURITY}wssecurity-utility-1.0.xsd">{created}</u:Created>',
        ]
        token = f"<w:UsernameToken>{''.join(parts)}</w:UsernameToken>"
        return f'<w:Security xmlns:w="{_SECURITY}wssecurity-secext-1.0.xsd" s:mustUnderstand="1">{token}</w:Security>'


def _parsed(data: bytes) -> XML.Element:
    """Read an XML message, of a limited size and without a document type."""
    if len(data) > _MOST_BYTES:
        raise DataError(f"camera: expected a message of at most {_MOST_BYTES} bytes, got a longer one")
    try:
        return XML.fromstring(data, XML.XMLParser(target=_Builder()))
    except (XML.ParseError, ValueError, LookupError) as error:
        raise DataError(f"camera: expected an XML message, got none that can be read ({error})") from None


def _reason(message: XML.Element) -> str:
    """Take the reason from a fault; empty for none."""
    return message.findtext(".//s:Reason/s:Text", "", _PREFIXES).strip()


def _reason_of(error: HTTPError) -> str:
    """Take the reason from the answer to a refused command, or else that of HTTP."""
    try:
        reason = _reason(_parsed(error.read(_MOST_BYTES + 1)))
    except (DataError, HTTPException, OSError):
        reason = ""
    return reason or f"{error.code} {error.reason}"


class OnvifCamera(PanTiltCamera):
    """A pan-tilt-zoom camera that speaks ONVIF, with frames from a video or a function of your own.

    ONVIF counts pan and tilt from -1 to 1 and zoom from 0 to 1. Here -1 and 1 are the limits of pan and tilt, and
    angles lie between them in equal steps. 0 and 1 are the widest and the narrowest field of view, with equal steps of
    the focal length.

    Args:
        client: sends commands to the camera.
        frame: gives the newest frame when it is called, such as `lambda: video.read()[1]`.
        size: `(width, height)` of a frame in pixels.
        pan: the camera's largest turns to the left and to the right, in degrees.
        tilt: its largest turns down and up, in degrees.
        fields: fields of view across to use, in degrees, narrowest first: the first and the last are those of the ends
            of the zoom. One is used for a camera that does not zoom.
        speeds: of the motors; `settle` is waited for after each movement.
        rate: rate at which what was seen is forgotten, per second (`PanTiltCamera`).
        relative: whether to turn by relative moves, for cameras that know no absolute ones.
        profile: token of a media profile; None takes the first one with pan and tilt.
        patience: largest number of seconds of a movement.

    Raises:
        InputError: an argument is out of range.
        DataError: the camera does not answer, or cannot turn.

    Example::

        video = cv2.VideoCapture("rtsp://192.168.0.20/stream1")
        client = OnvifClient("http://192.168.0.20", "user", "password")
        camera = OnvifCamera(client, lambda: video.read()[1], (1280, 720), pan=(-170, 170), tilt=(-30, 90))
        path = agent.search(camera, "cup", color="bgr")
    """

    def __init__(
        self,
        client: OnvifClient,
        frame: Callable[[], ImageLike],
        size: tuple[int, int],
        *,
        pan: tuple[float, float] = (-180.0, 180.0),
        tilt: tuple[float, float] = (-90.0, 90.0),
        fields: tuple[float, ...] = (60.0,),
        speeds: Speeds | None = None,
        rate: float = 0.0,
        relative: bool = False,
        profile: str | None = None,
        patience: float = 20.0,
    ) -> None:
        check(callable(frame), "frame", "a function that gives the newest frame", type(frame).__name__)
        check_number(patience, "patience", 0, 1e6)
        for name, limits in (("pan", pan), ("tilt", tilt)):
            check_limits(name, limits)
            check(limits[0] < limits[1], name, "two different limits in degrees, the lower one first", limits)
        self.client = client
        self.frame = frame
        self.size = size
        self.pan, self.tilt = pan, tilt
        self.fields = check_fields(fields)
        self._zooms = len(self.fields) > 1
        self._is_round = pan[1] - pan[0] == 360  # left and right end are one direction
        self.speeds = Speeds(eye_start=0.0, eye=0.0, settle=0.3) if speeds is None else speeds
        self.rate = rate
        self.relative = relative
        self.patience = patience
        services = client.services()
        self._ptz = services["PTZ"]
        self._profile = self._first_profile(services["Media"]) if profile is None else profile

    def look_at(self, direction: tuple[float, float], field: float) -> CameraFrame:
        """Turn to a direction, wait until the camera stands still, and take a frame.

        Args:
            direction: pan and tilt in degrees, between the limits.
            field: field of view across, in degrees, one of `fields`.

        Returns:
            The frame, with the direction and the field of view that the camera tells.

        Raises:
            DataError: the camera does not answer, refuses to turn, or does not arrive.
        """
        goal = self.position_of(direction, field)
        if self.relative:
            self._approach(goal)
        else:
            self._move("AbsoluteMove", "Position", goal)
            self._wait(goal)
        time.sleep(self.speeds.settle)
        position = self.where()
        frame = self.frame()
        return CameraFrame(frame, *self.direction_of(position))

    def position_of(self, direction: tuple[float, float], field: float) -> Position:
        """Convert a direction and a field of view to the units of ONVIF.

        Args:
            direction: pan and tilt in degrees.
            field: in degrees.

        Returns:
            The position.
        """
        # Pan and tilt run from -1 to 1 between the limits, zoom from 0 at the shortest focal length to 1.
        pan = 2 * _share(direction[0], self.pan) - 1
        tilt = 2 * _share(direction[1], self.tilt) - 1
        shortest = _focal(self.fields[-1])
        longest = _focal(self.fields[0])
        zoom = _share(_focal(field), (shortest, longest)) if longest > shortest else 0.0
        return Position(pan, tilt, zoom)

    def direction_of(self, position: Position) -> tuple[tuple[float, float], float]:
        """Convert a position in the units of ONVIF to degrees.

        Args:
            position: the position.

        Returns:
            Pan and tilt, and the field of view.
        """
        left, right = self.pan
        down, up = self.tilt
        pan = left + (position.pan + 1) / 2 * (right - left)
        tilt = down + (position.tilt + 1) / 2 * (up - down)
        shortest = _focal(self.fields[-1])
        longest = _focal(self.fields[0])
        focal = shortest + position.zoom * (longest - shortest)
        return (pan, tilt), 2 * math.degrees(math.atan(1 / focal))

    def where(self) -> Position:
        """Ask for the present position.

        Returns:
            The position, in the units of ONVIF.

        Raises:
            DataError: the camera does not answer, or does not tell it.
        """
        position, _ = self._status()
        return position

    def _status(self) -> tuple[Position, bool]:
        """Ask for the position, and whether the camera says that it moves."""
        answer = self._command("GetStatus")
        pan_and_tilt = answer.find(".//t:PanTilt[@x]", _PREFIXES)
        if pan_and_tilt is None:
            raise DataError("camera: expected its position, got a status without pan and tilt")
        pan = _number(pan_and_tilt, "x")
        tilt = _number(pan_and_tilt, "y")
        units = pan_and_tilt.get("space", "")
        is_generic = not units or units.endswith("/PositionGenericSpace")
        if not is_generic or max(abs(pan), abs(tilt)) > _BEYOND:
            expected = "its position from -1 to 1 (the generic space of ONVIF)"
            raise DataError(f"camera: expected {expected}, got {pan:g}, {tilt:g} in {units or 'no named space'}")
        zoomed = answer.find(".//t:Zoom[@x]", _PREFIXES)
        zoom = 0.0 if zoomed is None else _number(zoomed, "x")
        states = [element.text for element in answer.iterfind(".//t:MoveStatus/*", _PREFIXES)]
        return Position(pan, tilt, zoom), "MOVING" in states

    def _approach(self, goal: Position) -> None:
        """Turn by relative moves, the short way round; one is at most as long as ONVIF allows, so there may be two."""
        position = self.where()
        while True:
            way = self._way(position, goal)
            step = Position(*map(_limited, way))
            stop = Position(position.pan + step.pan, position.tilt + step.tilt, position.zoom + step.zoom)
            self._move("RelativeMove", "Translation", step)
            self._wait(stop)
            if step == way:
                return
            position = stop

    def _way(self, position: Position, goal: Position) -> Position:
        """Compute the translation to a goal, of a camera without borders by the shorter turn."""
        pan = goal.pan - position.pan
        if self._is_round:
            pan = (pan + 1) % 2 - 1
        return Position(pan, goal.tilt - position.tilt, goal.zoom - position.zoom)

    def _wait(self, goal: Position) -> None:
        """Wait until the camera stands still at a position."""
        until = time.monotonic() + self.patience
        while True:
            position, moves = self._status()
            # A camera that was just told to move may not have begun: that it stands still is not enough.
            if self._distance(position, goal) <= _NEAR and not moves:
                return
            if time.monotonic() > until:
                raise DataError(f"camera: expected it at {goal} within {self.patience:g} s, got {position}")
            time.sleep(_POLL)

    def _distance(self, position: Position, goal: Position) -> float:
        """Compute the longest of the ways to a goal; the zoom of a camera that does not zoom says nothing."""
        pan, tilt, zoom = map(abs, self._way(position, goal))
        return max(pan, tilt, zoom if self._zooms else 0.0)

    def _move(self, command: str, name: str, to: Position) -> None:
        """Send a movement."""
        # The units of a camera are its own where none are named.
        zoom_space = f'space="{_SPACES}/ZoomSpaces/{name}GenericSpace"'
        turn_space = f'space="{_SPACES}/PanTiltSpaces/{name}GenericSpace"'
        zoom = f'<t:Zoom x="{to.zoom:.6f}" {zoom_space}/>' if self._zooms else ""
        turn = f'<t:PanTilt x="{to.pan:.6f}" y="{to.tilt:.6f}" {turn_space}/>'
        self._command(command, f'<{name} xmlns:t="{_TYPES}">{turn}{zoom}</{name}>')

    def _command(self, command: str, content: str = "") -> XML.Element:
        profile = f"<ProfileToken>{escape(self._profile)}</ProfileToken>"
        return self.client.call(self._ptz, f'<{command} xmlns="{_PTZ}">{profile}{content}</{command}>')

    def _first_profile(self, media: str) -> str:
        """Ask for the first media profile of which pan and tilt can be set."""
        answer = self.client.call(media, f'<GetProfiles xmlns="{_MEDIA}"/>')
        for profile in answer.iterfind(".//m:Profiles", _PREFIXES):
            if profile.find("t:PTZConfiguration", _PREFIXES) is not None:
                return profile.get("token", "")
        raise DataError("camera: expected a media profile with pan and tilt, got none; set it up in the camera")


def _time_of(moment: XML.Element) -> datetime:
    """Read a date and a time; raise `ValueError` where a part of them is no number."""

    def number(group: str, name: str) -> int:
        return int(moment.findtext(f"t:{group}/t:{name}", "", _PREFIXES))

    return datetime(
        number("Date", "Year"),
        number("Date", "Month"),
        number("Date", "Day"),
        number("Time", "Hour"),
        number("Time", "Minute"),
        min(number("Time", "Second"), 59),  # a leap second is 60
        tzinfo=UTC,
    )


def _limited(length: float) -> float:
    """Shorten a translation to the longest that one relative move makes."""
    return max(-_FARTHEST, min(_FARTHEST, length))


def _focal(field: float) -> float:
    """Focal length in halves of the width of a frame."""
    return 1 / math.tan(math.radians(field) / 2)


def _share(value: float, limits: tuple[float, float]) -> float:
    """Tell where a value lies between two limits, from 0 at the first to 1 at the second."""
    first, second = limits
    return (value - first) / (second - first)


def _number(element: XML.Element, name: str) -> float:
    """Read a number from an attribute."""
    try:
        value = float(element.get(name, ""))
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise DataError(f"camera: expected a number, got {element.get(name)!r}")
    return value
