"""A stand-in for a camera that speaks ONVIF: a small server of SOAP messages, whose motors take a few questions."""

import base64
import hashlib
import threading
from datetime import UTC, datetime, timedelta
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from xml.etree import ElementTree

TYPES = "http://www.onvif.org/ver10/schema"
PTZ = "http://www.onvif.org/ver20/ptz/wsdl"
MEDIA = "http://www.onvif.org/ver10/media/wsdl"
SOAP = "http://www.w3.org/2003/05/soap-envelope"
USER, PASSWORD = "anna", "geheim & <gut>"


class OnvifServer:
    """Listens at `address` until it is closed.

    `position` is pan, tilt and zoom as ONVIF has them, `moves` what was asked for. A movement takes `slow` questions
    for the status. `answers` replaces the answer to a command by its name. Its clock is `ahead` of ours. A
    camera that is `round` has no borders of pan, and tells 1 as -1.
    """

    def __init__(self, slow=2):
        self.position, self.goal, self.left, self.slow = [0.5, -0.5, 0.0], [0.5, -0.5, 0.0], 0, slow
        self.ahead, self.round = timedelta(), False
        self.moves, self.answers, self.says_whether_it_moves = [], {}, True
        server = self

        class Handler(BaseHTTPRequestHandler):
            def do_POST(self):
                root = ElementTree.fromstring(self.rfile.read(int(self.headers["Content-Length"])))
                code, text = server.answer(self.path, root)
                data = text if isinstance(text, bytes) else text.encode()
                self.send_response(code)
                self.send_header("Content-Length", str(len(data)))
                self.end_headers()
                self.wfile.write(data)

            def log_message(self, *_):
                pass

        self._http = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.address = f"http://127.0.0.1:{self._http.server_address[1]}"
        threading.Thread(target=self._http.serve_forever, daemon=True).start()

    def close(self):
        self._http.shutdown()
        self._http.server_close()

    def answer(self, path, root):
        command = root.find(f"{{{SOAP}}}Body")[0]
        name = command.tag.partition("}")[2]
        if name in self.answers:
            return self.answers[name]
        if name == "GetSystemDateAndTime":
            assert root.find(f"{{{SOAP}}}Header")[:] == []  # nobody needs a user to ask for the time
            return 200, envelope(self.GetSystemDateAndTime(command))
        if not self.knows_user(root):
            return 400, envelope(
                f'<s:Fault xmlns:s="{SOAP}"><s:Reason><s:Text>Sender not Authorized</s:Text></s:Reason></s:Fault>'
            )
        assert path == {"GetCapabilities": "/onvif/device_service", "GetProfiles": "/media"}.get(name, "/ptz")
        return 200, envelope(getattr(self, name)(command))

    def knows_user(self, root):
        parts = {element.tag.rpartition("}")[2]: element.text for element in root.iter()}
        if parts.get("Username") != USER:
            return False
        created = datetime.fromisoformat(parts["Created"])
        if abs(created - datetime.now(UTC) - self.ahead) > timedelta(seconds=30):
            return False
        text = base64.b64decode(parts["Nonce"]) + parts["Created"].encode() + PASSWORD.encode()
        return base64.b64encode(hashlib.sha1(text).digest()).decode() == parts["Password"]

    def GetSystemDateAndTime(self, command):
        now = datetime.now(UTC) + self.ahead
        date = f"<t:Date><t:Year>{now.year}</t:Year><t:Month>{now.month}</t:Month><t:Day>{now.day}</t:Day></t:Date>"
        time = f"<t:Hour>{now.hour}</t:Hour><t:Minute>{now.minute}</t:Minute><t:Second>{now.second}</t:Second>"
        return f'<r xmlns:t="{TYPES}"><t:UTCDateTime><t:Time>{time}</t:Time>{date}</t:UTCDateTime></r>'

    def GetCapabilities(self, command):
        """Its own address is one that is not reached from outside."""
        services = "".join(
            f"<t:{name}><t:XAddr>http://10.0.0.1:80/{name.lower()}</t:XAddr></t:{name}>" for name in ("Media", "PTZ")
        )
        return f'<r xmlns:t="{TYPES}"><t:Capabilities>{services}</t:Capabilities></r>'

    def GetProfiles(self, command):
        profiles = '<m:Profiles token="still"/><m:Profiles token="turns"><t:PTZConfiguration/></m:Profiles>'
        return f'<m:r xmlns:m="{MEDIA}" xmlns:t="{TYPES}">{profiles}</m:r>'

    def GetStatus(self, command):
        assert command.find(f"{{{PTZ}}}ProfileToken").text == "turns"
        state = "MOVING" if self.left else "IDLE"
        if self.left:
            self.left -= 1
        elif self.position != self.goal:
            self.position = list(self.goal)
        pan, tilt, zoom = self.position
        status = f"<t:MoveStatus><t:PanTilt>{state}</t:PanTilt></t:MoveStatus>" if self.says_whether_it_moves else ""
        place = f'<t:Position><t:PanTilt x="{pan}" y="{tilt}"/><t:Zoom x="{zoom}"/></t:Position>'
        return f'<r xmlns:t="{TYPES}"><PTZStatus>{place}{status}</PTZStatus></r>'

    def AbsoluteMove(self, command):
        self._go(command, [0.0, 0.0, 0.0])
        return "<r/>"

    def RelativeMove(self, command):
        self._go(command, self.position)
        return "<r/>"

    def _go(self, command, origin):
        turn, zoom = command.find(f".//{{{TYPES}}}PanTilt"), command.find(f".//{{{TYPES}}}Zoom")
        asked = [float(turn.get("x")), float(turn.get("y")), self.goal[2] if zoom is None else float(zoom.get("x"))]
        if zoom is None:
            asked[2] -= origin[2]
        self.moves.append((command.tag.partition("}")[2], *asked))
        assert all(abs(part) <= 1.0001 for part in asked)
        self.goal = [a + b for a, b in zip(asked, origin, strict=True)]
        for element, kind in ((turn, "PanTilt"), (zoom, "Zoom")):
            form = "Position" if "Absolute" in command.tag else "Translation"
            space = f"http://www.onvif.org/ver10/tptz/{kind}Spaces/{form}GenericSpace"
            assert element is None or element.get("space") == space
        if self.round:
            self.goal[0] = (self.goal[0] + 1) % 2 - 1
        assert all(abs(part) <= 1.0001 for part in self.goal)
        self.left = self.slow


def envelope(body):
    return f'<?xml version="1.0"?><s:Envelope xmlns:s="{SOAP}"><s:Body>{body}</s:Body></s:Envelope>'
