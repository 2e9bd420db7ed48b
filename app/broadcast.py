"""Sends what all viewers see: each batch of messages is packed once, not once for every viewer.

viser packs and compresses every batch anew in each connection's sender, so twenty viewers of a live mesh would cost
twenty compressions beside the engine. The sender here writes the same wire format, but viewers that are in step are
handed the very same bytes. A viewer whose socket is full holds up nobody else: viser's buffer keeps only the newest
state of everything for it, and ``front`` drops it when it stalls.
"""

from __future__ import annotations

import threading
import time
from collections import OrderedDict
from collections.abc import Sequence
from typing import Any

import msgspec
import viser
import viser.infra._infra as infra
import zstandard
from viser._messages import FileTransferPart
from viser.infra._async_message_buffer import AsyncMessageBuffer
from viser.infra._messages import Message

BATCHES_KEPT = 4
_ALIGNMENT = 8


class Packer:
    """Packs batches and remembers the last few, so that the next viewer gets the same bytes."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._packed: OrderedDict[tuple[int, ...], tuple[Sequence[Message], bytes]] = OrderedDict()

    def shared(self, batch: Sequence[Message]) -> bytes:
        """The wire bytes of a batch that other viewers get too."""
        # The batch is kept with its bytes: as long as it lives, no other message can have the same identity.
        key = tuple(map(id, batch))
        with self._lock:
            found = self._packed.get(key)
            if found is None:
                found = self._packed[key] = batch, pack(batch)
                if len(self._packed) > BATCHES_KEPT:
                    self._packed.popitem(last=False)
        return found[1]


def pack(batch: Sequence[Message]) -> bytes:
    """One batch in viser's wire format: two lengths, compressed MessagePack, then the arrays as they lie in memory."""
    arrays: list[memoryview] = []
    messages = tuple(message.as_serializable_dict(arrays) for message in batch)
    body = msgspec.msgpack.encode(
        {
            "messages": messages,
            "timestampSec": time.perf_counter(),
            "binaryBufferLengths": tuple(array.nbytes for array in arrays),
        }
    )
    squeezed = zstandard.compress(body, 1)
    parts: list[bytes | memoryview] = [len(body).to_bytes(8, "little"), len(squeezed).to_bytes(8, "little"), squeezed]
    for array in arrays:
        parts.append(bytes(-sum(memoryview(part).nbytes for part in parts) % _ALIGNMENT))
        parts.append(array)
    return b"".join(parts)


async def send_batches(
    websocket: Any, buffer: AsyncMessageBuffer, client_id: int, backlog_done_message: Message | None = None
) -> None:
    """Send one connection everything that its buffer hands out, until the buffer is done."""
    batches = buffer.window_generator(client_id, backlog_done_message=backlog_done_message)
    try:
        async for batch in batches:
            await websocket.send(_packer.shared(batch) if buffer.persistent_messages else pack(batch))
    finally:
        await batches.aclose()


def downloading(client: viser.ClientHandle) -> bool:
    """Whether parts of a file wait to be sent to a viewer; they stay in memory until then."""
    waiting = list(client._websock_connection.get_message_buffer().message_from_id.values())
    return any(isinstance(message, FileTransferPart) for message in waiting)


def share_batches() -> None:
    """Let the viser servers of this process send with ``send_batches``. Raises RuntimeError when viser has changed."""
    theirs = getattr(infra, "_message_producer", None)
    if theirs is None:
        raise RuntimeError(f"viser {viser.__version__} sends in a way that is not known here")
    infra._message_producer = send_batches


_packer = Packer()
