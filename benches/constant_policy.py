"""A policy of openpi's protocol that answers every query after a millisecond with the same actions."""

import base64
import hashlib
import socket
import struct
import threading
import time

ACCEPT = b"258EAFA5-E914-47DA-95CA-C5AB0DC85B11"  # RFC 6455


class ConstantPolicy:
    """Serves chunks of these actions on a free port until the process ends, and knows what it was asked."""

    def __init__(self, actions: list[list[float]], seconds: float = 0.001) -> None:
        width = len(actions[0])
        numbers = b"".join(struct.pack(f"<{width}f", *row) for row in actions)
        shape = b"\x92" + bytes([len(actions), width])
        array = b"\x84\xc4\x0b__ndarray__\xc3\xc4\x04data\xc5" + struct.pack(">H", len(numbers)) + numbers
        array += b"\xc4\x05dtype\xa3<f4\xc4\x05shape" + shape
        self.answer = frame(b"\x81\xa7actions" + array)
        self.seconds = seconds
        self.prompts: set[str] = set()
        self.queries: set[bytes] = set()
        self.listener = socket.create_server(("127.0.0.1", 0))
        self.address = f"ws://127.0.0.1:{self.listener.getsockname()[1]}"
        threading.Thread(target=self.accept, daemon=True).start()

    def accept(self) -> None:
        """A thread a client."""
        while True:
            client, _ = self.listener.accept()
            client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            threading.Thread(target=self.serve, args=(client,), daemon=True).start()

    def serve(self, client: socket.socket) -> None:
        """Answer until the client closes."""
        with client, client.makefile("rb") as stream:
            key = b""
            while (line := stream.readline().strip()) != b"":
                name, _, value = line.partition(b":")
                key = value.strip() if name.lower() == b"sec-websocket-key" else key
            accepted = base64.b64encode(hashlib.sha1(key + ACCEPT).digest())
            head = b"HTTP/1.1 101 Switching Protocols\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
            client.sendall(head + b"Sec-WebSocket-Accept: " + accepted + b"\r\n\r\n" + frame(b"\x80"))
            while (query := message(stream)) is not None:
                self.queries.add(hashlib.sha256(query).digest())
                place = query.find(b"\xa6prompt")
                if place >= 0:
                    length, begin = query[place + 7], place + 8
                    # a text of 32 bytes or more has its length in a byte of its own
                    length, begin = (query[begin], begin + 1) if length == 0xD9 else (length & 0x1F, begin)
                    self.prompts.add(query[begin : begin + length].decode())
                time.sleep(self.seconds)
                client.sendall(self.answer)


def frame(payload: bytes) -> bytes:
    """A binary message of a server."""
    short = len(payload) < 126
    return b"\x82" + (bytes([len(payload)]) if short else b"\x7e" + struct.pack(">H", len(payload))) + payload


def message(stream) -> bytes | None:  # noqa: ANN001
    """The payload of a client's next binary message, in one frame or several; None at the end."""
    whole = b""
    while True:
        head = stream.read(2)
        if len(head) < 2 or head[0] & 0xF == 8:
            return None
        length = head[1] & 0x7F
        if length >= 126:
            length = int.from_bytes(stream.read(2 if length == 126 else 8), "big")
        mask = stream.read(4)
        masked = stream.read(length)
        plain = int.from_bytes(masked, "big") ^ int.from_bytes((mask * (length // 4 + 1))[:length], "big")
        whole += plain.to_bytes(length, "big")
        if head[0] & 0x80:
            return whole
