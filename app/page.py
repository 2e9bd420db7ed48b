"""viser's one-file page with our name, style sheet and security headers."""

from __future__ import annotations

import gzip
from functools import lru_cache
from pathlib import Path

import viser
from websockets.datastructures import Headers
from websockets.http11 import Response

from . import hints
from .theme import STYLE

_ICON = (
    "data:image/svg+xml,%3Csvg xmlns='http://www.w3.org/2000/svg' viewBox='0 0 32 32'%3E%3Crect width='32' height='32' "
    "rx='8' fill='%23ea580c'/%3E%3Cpath d='M6 22c5-14 15-14 20 0M9 12h14' stroke='white' stroke-width='3' fill='none' "
    "stroke-linecap='round'/%3E%3C/svg%3E"
)
# The page may talk only to where it came from: a link with ?websocket=... cannot point it at another server.
_POLICY = (
    "default-src 'self'; script-src 'self' 'unsafe-inline' 'unsafe-eval' blob:; style-src 'self' 'unsafe-inline'; "
    "img-src 'self' data: blob:; font-src 'self' data:; worker-src 'self' blob: data:; "
    "connect-src 'self' ws://{host} wss://{host} blob: data:; frame-ancestors 'none'; base-uri 'none'; "
    "form-action 'none'"
)
# A control that was clicked keeps the focus, and would take the next key for its own: let go of it. One that the
# keyboard has reached keeps the keys it needs: space presses a button or ticks a box, and is no hot key then. A tab
# needs none but the arrows and Enter; all others are hot keys, as everywhere but in a field that one types in. Enter
# ends the typing of a number.
_FOCUS = (
    "addEventListener('click',e=>{const chosen=e.target.closest('[role=option]');if(e.detail)setTimeout(()=>{const "
    "on=document.activeElement;if(chosen||on.matches('button,[role=tab],[type=checkbox]'))on.blur()})});"
    "addEventListener('keydown',e=>{if(e.ctrlKey||e.metaKey||e.altKey)return;const space=e.key===' ',"
    "on=kind=>e.target.closest(kind);if(space&&on('button'))e.stopPropagation();"
    "else if(e.key==='Enter'&&on('[inputmode]'))setTimeout(()=>e.target.blur());"
    "else if(space?on('[role=tab]'):e.key.length===1&&on('[type=checkbox]')){e.preventDefault();e.stopPropagation();"
    "document.body.dispatchEvent(new KeyboardEvent('keydown',e))}},true)"
)
# A finger captures the canvas by itself when it touches it, which viser takes for a gizmo being dragged: a tap would be
# no click.
_TAP = (
    "addEventListener('pointerdown',e=>{if(e.pointerType==='touch'&&e.target.tagName==='CANVAS'&&"
    "e.target.hasPointerCapture(e.pointerId))e.target.releasePointerCapture(e.pointerId)},true)"
)
# viser's page tries its socket anew every second while the server is away. After some failures a browser holds each
# try back for longer than that, and the page never returns: let one through only when the server answers, and wait.
# Until then say what is the matter.
_AWAY = (
    "No connection: the program behind this page has ended or cannot be reached. Once it is back, the page goes on by "
    "itself."
)
_OTHER_TOKEN = "The program behind this page was started anew: open the address that its terminal printed."
_RETURN = (
    "let trying=false;const post=Worker.prototype.postMessage,told=document.documentElement.dataset;"
    "Worker.prototype.postMessage=function(message,...rest){const send=()=>post.call(this,message,...rest);"
    "if(message?.type!=='retry')send();else if(!trying){trying=true;fetch('/up',{cache:'no-store'}).then(answer=>{"
    f"if(answer.status===401)told.away={_OTHER_TOKEN!r};else{{delete told.away;send()}}"
    f"setTimeout(()=>trying=false,4000)}},()=>{{told.away={_AWAY!r};trying=false}})}}}}"
)


@lru_cache(1)
def _page() -> tuple[bytes, bytes]:
    text = (Path(viser.__file__).parent / "client" / "build" / "index.html").read_text("utf-8")
    head = (
        f'<title>EC-SLAM</title><link rel="icon" href="{_ICON}"><style>{STYLE}{hints.STYLE}</style>'
        f"<script>{_FOCUS};{_TAP};{_RETURN};{hints.SCRIPT}</script></head>"
    )
    body = text.replace("<title>Viser</title>", "").replace("</head>", head, 1).encode()
    return body, gzip.compress(body)


def index_page(request: Headers) -> Response:
    """The answer to a request for the page."""
    plain, packed = _page()
    zipped = "gzip" in request.get("Accept-Encoding", "")
    body = packed if zipped else plain
    headers = {
        "Content-Type": "text/html; charset=utf-8",
        "Content-Length": str(len(body)),
        "Content-Encoding": "gzip" if zipped else "identity",
        "Content-Security-Policy": _POLICY.format(host=request.get("Host", "")),
        "X-Content-Type-Options": "nosniff",
        "X-Frame-Options": "DENY",
        "Referrer-Policy": "no-referrer",
        "Cache-Control": "no-store",
    }
    return Response(200, "OK", Headers(headers), body)
