"""Each way in that a stock viser server leaves open is closed, tried with raw HTTP and WebSocket clients."""

from __future__ import annotations

import http.client
import re
import socket
import time
from contextlib import contextmanager
from urllib.parse import urlsplit

import msgspec
import pytest
import viser
from ecslam_app import front, guard, server
from ecslam_app.listen import bind, names_elsewhere
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from ecslam import messages as m
from ecslam.types import InputError
from tests.fake_engine import FakeEngine

TOKEN = "a-token-of-some-length"


@pytest.fixture
def engine(tmp_path):
    engine = FakeEngine(tmp_path / "run", frames=100_000, period=0.02).start()
    yield engine
    engine.stop()


@pytest.fixture
def open_page(engine):
    dashboard = server.start(engine, port=0)
    yield dashboard
    dashboard.close()


@pytest.fixture
def locked_page(engine):
    dashboard = server.start(engine, port=0, token=TOKEN)
    yield dashboard
    dashboard.close()


def get(page, path="/", **headers):
    connection = http.client.HTTPConnection("127.0.0.1", page.port, timeout=5)
    connection.request("GET", path, headers={name.replace("_", "-"): value for name, value in headers.items()})
    answer = connection.getresponse()
    body = answer.read()
    connection.close()
    return answer, body


def dial(page, origin="own", **headers):
    own = f"http://127.0.0.1:{page.port}"
    return connect(
        f"ws://127.0.0.1:{page.port}/",
        origin=own if origin == "own" else origin,
        subprotocols=[f"viser-v{viser.__version__}"],
        additional_headers=headers,
        max_size=None,
        max_queue=None,  # who reads nothing can hang up all the same
        compression=None,
    )


def say(client, kind, **fields):
    client.send(msgspec.msgpack.encode({"type": kind, **fields}))


CAMERA = {
    "wxyz": [1.0, 0, 0, 0], "position": [3.0, 3, 3], "look_at": [0.0, 0, 0], "up_direction": [0.0, 0, 1],
    "fov": 1.2, "near": 0.01, "far": 1000.0, "image_height": 600, "image_width": 800,
}  # fmt: skip

CLICK = {
    "event_type": "click", "ray_origin": [0.0, 0, 10], "ray_direction": [0.0, 0, -1], "screen_pos": [[0.5, 0.5]],
    "modifier": None,
}  # fmt: skip


def enter(client):
    say(client, "ViewerCameraMessage", **CAMERA)


@contextmanager
def viewing(page):
    """The connection of the page's first viewer, once the page knows it."""
    with dial(page) as connection:
        enter(connection)
        assert until(lambda: list(page.hub.viewers()))
        yield connection


def control(page, label):
    """uuid and handle of the GUI control with this label (or option, for a group of buttons)."""
    for uuid, handle in page.hub.server.gui._gui_input_handle_from_uuid.items():
        if handle.label == label:
            return uuid, handle
    raise KeyError(label)


def until(condition, seconds=20.0):
    deadline = time.monotonic() + seconds
    while not condition() and time.monotonic() < deadline:
        time.sleep(0.01)
    return condition()


def press(page, client, label, value):
    say(client, "GuiUpdateMessage", uuid=control(page, label)[0], updates={"value": value})


def hit(page, client, label):
    """The hot key of this command, or its line in the palette."""
    commands = page.hub.server.gui._command_handle_from_uuid
    say(client, "CommandTriggerMessage", uuid=next(u for u, c in commands.items() if c.label == label))


def alive(page, client, engine):
    """The connection still works: an honest click arrives."""
    before = engine.log.count(m.Pause())
    press(page, client, "Run", "Resume")
    press(page, client, "Run", "Pause")
    return until(lambda: engine.log.count(m.Pause()) > before)


def test_page_needs_token_then_keeps_it_in_a_strict_cookie(locked_page):
    assert get(locked_page)[0].status == 401
    assert get(locked_page, "/?token=wrong-token-of-some-length")[0].status == 401
    answer, _ = get(locked_page, f"/?token={TOKEN}")
    cookie = answer.headers["Set-Cookie"]
    assert (answer.status, answer.headers["Location"]) == (303, "/")
    assert "HttpOnly" in cookie
    assert "SameSite=Strict" in cookie
    assert get(locked_page, Cookie=cookie.split(";")[0])[0].status == 200
    assert get(locked_page, Cookie=cookie.split(";")[0] + "x")[0].status == 401


def test_websocket_needs_token(locked_page):
    with pytest.raises(InvalidStatus, match="401"):
        dial(locked_page)
    with pytest.raises(InvalidStatus, match="401"):
        connect(f"ws://127.0.0.1:{locked_page.port}/?token={TOKEN}", origin=f"http://127.0.0.1:{locked_page.port}")
    dial(locked_page, Cookie=f"ecslam_{locked_page.port}={TOKEN}").close()


@pytest.mark.parametrize("host", ["evil.example", "evil.example:80", "127.0.0.1.evil.example", "localhost; x", ""])
def test_foreign_host_is_refused(open_page, host):
    assert get(open_page, Host=host)[0].status in (400, 403)


def test_forwarded_port_is_served(open_page):
    assert get(open_page, Host="localhost:9999")[0].status == 200


@pytest.mark.parametrize("origin", ["https://evil.example", "null", "http://localhost:1", None])
def test_foreign_origin_is_refused(open_page, origin):
    with pytest.raises(InvalidStatus, match="403"):
        dial(open_page, origin=origin)


def test_page_may_only_talk_to_its_own_server(open_page):
    answer, body = get(open_page)
    policy = dict(part.strip().split(" ", 1) for part in answer.headers["Content-Security-Policy"].split(";"))
    assert set(policy["connect-src"].split()) <= {
        "'self'", f"ws://127.0.0.1:{open_page.port}", f"wss://127.0.0.1:{open_page.port}", "blob:", "data:",
    }  # fmt: skip
    assert policy["frame-ancestors"] == "'none'"
    assert b"<title>EC-SLAM</title>" in body


def test_traversal_is_refused(open_page):
    assert get(open_page, "/../../../../etc/passwd")[0].status == 404
    assert get(open_page, "/%2e%2e/%2e%2e/index.html")[0].status == 404


@pytest.mark.parametrize(
    "updates",
    [{"update_cb": []}, {"disabled": True}, {"value": "Pause", "visible": False}, {"props": {}}, {}, {"removed": True}],
)
def test_injected_attributes_do_nothing(open_page, engine, updates):
    uuid, handle = control(open_page, "Run")
    before = {k: v for k, v in vars(handle._impl).items() if k not in ("value", "update_timestamp")}
    with dial(open_page) as client:
        enter(client)
        say(client, "GuiUpdateMessage", uuid=uuid, updates=updates)
        assert alive(open_page, client, engine)
    assert {k: v for k, v in vars(handle._impl).items() if k not in ("value", "update_timestamp")} == before
    assert handle._impl.update_cb


@pytest.mark.parametrize(
    ("label", "value"),
    [
        ("Limit (frames/s)", 61), ("Limit (frames/s)", -1), ("Limit (frames/s)", float("nan")),
        ("Limit (frames/s)", "fast"),
        ("Limit (frames/s)", True), ("Seed", -1), ("Seed", 2**40), ("Seed", 0.5), ("Sequence", "/etc"),
        ("Preset", "evil"),
        ("Sequence", ["synthetic/studio"]), ("Run", "Quit"), ("Ground truth", "yes"), ("Voxel size (cm)", 1e300),
    ],
)  # fmt: skip
def test_values_out_of_range_are_not_stored(open_page, engine, label, value):
    handle = control(open_page, label)[1]
    before = handle.value
    with dial(open_page) as client:
        enter(client)
        press(open_page, client, label, value)
        if label == "Run":
            assert until(lambda: m.Quit() in engine.log, 0.3) is False
        else:
            assert alive(open_page, client, engine)
    assert handle.value == before


def test_honest_values_are_stored(open_page):
    with dial(open_page) as client:
        enter(client)
        press(open_page, client, "Limit (frames/s)", 30)
        press(open_page, client, "Preset", "full")
        assert until(lambda: control(open_page, "Limit (frames/s)")[1].value == 30)
        assert until(lambda: control(open_page, "Preset")[1].value == "full")


def test_share_requests_are_refused(open_page, engine, monkeypatch):
    asked = []
    monkeypatch.setattr(viser.ViserServer, "request_share_url", lambda self, verbose=True: asked.append(self))
    with dial(open_page) as client:
        enter(client)
        say(client, "ShareUrlRequest")
        assert alive(open_page, client, engine)
    assert asked == []
    assert viser._messages.ShareUrlRequest not in open_page.hub.server._websock_server._incoming_handlers


def test_uploads_do_not_pile_up(open_page, engine):
    uuid, _ = control(open_page, "Run")
    with dial(open_page) as client:
        enter(client)
        for k in range(20):
            say(client, "FileTransferStartUpload", source_component_uuid=uuid, transfer_uuid=str(k), filename="x",
                mime_type="x", part_count=9, size_bytes=9)  # fmt: skip
            say(
                client, "FileTransferPart", source_component_uuid=uuid, transfer_uuid=str(k), part_index=0, content=b"x"
            )
        assert alive(open_page, client, engine)
    assert open_page.hub.server.gui._current_file_upload_states == {}


@pytest.mark.parametrize(
    "raw",
    [b"", b"\xff" * 50, b"\x91" * 5000, msgspec.msgpack.encode(7), msgspec.msgpack.encode({"type": ["x"]}),
     msgspec.msgpack.encode({"type": "RunJavascriptMessage", "source": "alert(1)"}),
     msgspec.msgpack.encode({"type": "ViewerCameraMessage", **CAMERA, "position": [float("nan"), 0, 0]}),
     msgspec.msgpack.encode({"type": "ViewerCameraMessage", **CAMERA, "extra": 1}),
     *(msgspec.msgpack.encode({"type": "ScenePointerMessage", **CLICK, **wrong}) for wrong in (
         {"ray_direction": [0.0, 0, 0]}, {"ray_direction": [0.0, 0, -2.0]}, {"ray_direction": None},
         {"ray_origin": [0.0, 0, float("nan")]}, {"ray_origin": [0.0, 0]}, {"screen_pos": []},
         {"screen_pos": [0.5, 0.5]}, {"modifier": "shift"}, {"event_type": "rect-select"}, {"extra": 1}))],
)  # fmt: skip
def test_malformed_messages_are_dropped(raw):
    assert not guard.message_passes(raw, lambda uuid, value: True)


def test_garbage_does_not_end_the_connection(open_page, engine):
    with dial(open_page) as client:
        enter(client)
        client.send(b"\xff\x00garbage")
        client.send("text")
        assert alive(open_page, client, engine)


def test_who_hangs_up_before_the_answer_leaves_no_trace_on_the_terminal(open_page, caplog):
    for begun in (b"", b"GET / HTTP/1.1\r\nHost: loc", b"\x16\x03\x01 TLS"):
        with socket.create_connection(("127.0.0.1", open_page.port)) as caller:
            caller.sendall(begun)
    get(open_page)
    time.sleep(0.5)
    assert "handshake" not in caplog.text


def test_busy_port_is_a_clear_error(engine):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with pytest.raises(InputError, match=rf"--port {port}: cannot listen there .* choose another --port"):
            server.start(engine, port=port)


@pytest.mark.parametrize("host", ["192.0.2.1", "no-such-host.invalid"])
def test_unbindable_host_is_a_clear_error(engine, host):
    with pytest.raises(InputError, match="--host"):
        server.start(engine, host=host, port=0)


def test_open_host_always_has_a_token(engine):
    page = server.start(engine, host="0.0.0.0", port=0)
    try:
        assert "?token=" in page.url
        assert get(page)[0].status == 401
        assert get(page, Host="evil.example")[0].status == 403
        assert get(page, page.url.split(str(page.port))[1])[0].status == 303
    finally:
        page.close()


def test_no_request_waits_for_a_name_server(engine, monkeypatch):
    monkeypatch.setattr(socket, "getfqdn", lambda: "Here.Example")
    page = server.start(engine, host="0.0.0.0", port=0)
    monkeypatch.delattr(socket, "getfqdn")
    try:
        for host in ("localhost", "here.example", socket.gethostname(), "192.0.2.1"):
            assert get(page, Host=host)[0].status == 401
        assert get(page, Host="there.example")[0].status == 403
    finally:
        page.close()


@contextmanager
def opened(engine, host):
    """A page that listens there; the test is skipped where this machine has no such address."""
    try:
        listener = bind(host, 0)
    except InputError:
        pytest.skip(f"this machine has no {host}")
    page = server.start(engine, host=host, listener=listener)
    try:
        yield page
    finally:
        page.close()


@pytest.mark.parametrize("host", ["127.0.0.1", "127.0.0.2", "0.0.0.0", "::1"])
def test_the_tunnel_leads_to_the_page(engine, host):
    with opened(engine, host) as page:
        near, there, port, address = re.match(r"ssh -L (\d+):(.+):(\d+) <.*>, then open (\S+)", page.ssh_hint).groups()
        assert address.startswith(f"http://localhost:{near}/")
        with socket.create_connection((there.strip("[]"), int(port)), 5) as tunnel:
            tunnel.sendall(f"GET {urlsplit(address).path}?{urlsplit(address).query} HTTP/1.1\r\n".encode())
            tunnel.sendall(f"Host: {urlsplit(address).netloc}\r\n\r\n".encode())
            assert tunnel.recv(12) in (b"HTTP/1.1 200", b"HTTP/1.1 303")


@pytest.mark.parametrize("host", ["0.0.0.0", "::"])
def test_an_open_page_says_under_which_addresses_other_machines_find_it(engine, host, monkeypatch):
    monkeypatch.setattr(socket, "gethostname", lambda: "here")
    with opened(engine, host) as page:
        *addresses, name = page.elsewhere
        assert name == page.url.replace("localhost", "here")
        for address in (*addresses, name):
            there = urlsplit(address)
            assert not front.is_loopback(there.hostname)
            assert get(page, f"/?{there.query}", Host=there.netloc)[0].status == 303


def test_addresses_elsewhere_are_those_that_this_machine_sends_from(monkeypatch):
    class Sender:
        def __init__(self, family, kind):
            self.own = {socket.AF_INET: "192.0.2.7", socket.AF_INET6: "2001:db8::7"}[family]

        __enter__, __exit__, connect = (lambda self: self), (lambda self, *_: None), (lambda self, far: None)

        def getsockname(self):
            return self.own, 9

    with bind("0.0.0.0", 0) as listener:
        monkeypatch.setattr(socket, "socket", Sender)
        monkeypatch.setattr(socket, "gethostname", lambda: "localhost")
        assert names_elsewhere(listener) == ("192.0.2.7",)
        monkeypatch.setattr(Sender, "connect", lambda self, far: (_ for _ in ()).throw(OSError("no network")))
        assert names_elsewhere(listener) == ()


@pytest.mark.parametrize(("host", "count"), [("127.0.0.1", 0), ("localhost", 0), ("192.0.2.9", 1)])
def test_one_address_is_the_same_from_everywhere(engine, host, count):
    page = server.start(engine, host=host, listener=bind("127.0.0.1", 0))
    try:
        assert list(page.elsewhere) == count * [page.url]
    finally:
        page.close()


@pytest.mark.parametrize("token", ["short", "with space in the middle", "semi;colon;semi;colon", "ünicode-ünicode-ü"])
def test_weak_tokens_are_refused(engine, token):
    with pytest.raises(InputError, match="token: use at least"):
        server.start(engine, port=0, token=token)


def test_a_viser_that_cannot_be_guarded_is_not_used(monkeypatch):
    monkeypatch.setattr(
        front._Shell, "serve", lambda self, serve, handler, host, port, **rest: serve(handler, "127.0.0.1", 0, **rest)
    )
    with pytest.raises(RuntimeError, match="cannot be guarded"):
        front.open_viser(bind("127.0.0.1", 0), "127.0.0.1", None, "x")
