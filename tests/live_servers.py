"""Network cameras for tests: MJPEG over HTTP, and RTSP with an MPEG transport stream inside RTP (RFC 2326, 2250)."""

from __future__ import annotations

import re
import socketserver
import struct
import threading
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np

TS_PACKET = 188


def numbered_picture(number: int) -> np.ndarray:
    """A textured scene that moves with the number."""
    rng = np.random.default_rng(0)
    noise = cv2.GaussianBlur(rng.standard_normal((240, 900)), (0, 0), 3.0)
    scene = np.clip(120 + 45 * noise / noise.std(), 0, 255).astype(np.uint8)
    left = (4 * number) % 560
    return np.ascontiguousarray(np.repeat(scene[:, left : left + 320, None], 3, axis=2))


class _Server(socketserver.ThreadingTCPServer):
    allow_reuse_address = True
    daemon_threads = True

    def __init__(self, handler: type[socketserver.BaseRequestHandler]) -> None:
        super().__init__(("127.0.0.1", 0), handler)
        self.stopping = threading.Event()
        self.connections = 0
        threading.Thread(target=self.serve_forever, kwargs={"poll_interval": 0.05}, daemon=True).start()

    @property
    def port(self) -> int:
        return int(self.server_address[1])

    def close(self) -> None:
        self.stopping.set()
        self.shutdown()
        self.server_close()


class MjpegServer(_Server):
    """``http://127.0.0.1:port/``: JPEG pictures as multipart/x-mixed-replace."""

    def __init__(self, rate_hz: float, frames_per_connection: int | None = None, *, then_stalls: bool = False) -> None:
        """After ``frames_per_connection`` the connection is closed, or kept open without a byte more."""
        self.rate_hz = rate_hz
        self.then_stalls = then_stalls
        self.frames_per_connection = frames_per_connection
        super().__init__(_MjpegHandler)


class _MjpegHandler(socketserver.StreamRequestHandler):
    server: Any

    def handle(self) -> None:
        while self.rfile.readline().strip():
            pass
        self.server.connections += 1
        self.wfile.write(b"HTTP/1.0 200 OK\r\nContent-Type: multipart/x-mixed-replace; boundary=next\r\n\r\n")
        number = 0
        try:
            while not self.server.stopping.is_set() and number != self.server.frames_per_connection:
                data = cv2.imencode(".jpg", numbered_picture(number))[1].tobytes()
                head = f"--next\r\nContent-Type: image/jpeg\r\nContent-Length: {len(data)}\r\n\r\n".encode()
                self.wfile.write(head + data + b"\r\n")
                number += 1
                self.server.stopping.wait(1.0 / self.server.rate_hz)
        except OSError:
            return
        if self.server.then_stalls:
            self.server.stopping.wait()


class RtspServer(_Server):
    """``rtsp://127.0.0.1:port/live``: plays a transport stream file once per connection, at its own pace."""

    def __init__(self, file: Path, duration_s: float) -> None:
        self.data = file.read_bytes()
        self.duration_s = duration_s
        super().__init__(_RtspHandler)


class _RtspHandler(socketserver.StreamRequestHandler):
    server: Any

    def handle(self) -> None:
        while True:
            lines = []
            while line := self.rfile.readline().decode().strip():
                lines.append(line)
            if not lines:
                return
            method = lines[0].split()[0]
            sequence = next(re.sub(r"\D", "", line) for line in lines if line.lower().startswith("cseq"))
            extra, body = "", ""
            if method == "OPTIONS":
                extra = "Public: OPTIONS, DESCRIBE, SETUP, PLAY, TEARDOWN\r\n"
            elif method == "DESCRIBE":
                body = (
                    "v=0\r\no=- 0 0 IN IP4 127.0.0.1\r\ns=test\r\nc=IN IP4 0.0.0.0\r\nt=0 0\r\n"
                    "m=video 0 RTP/AVP 33\r\na=control:track\r\n"
                )
                extra = f"Content-Type: application/sdp\r\nContent-Length: {len(body)}\r\n"
            elif method == "SETUP":
                extra = "Transport: RTP/AVP/TCP;unicast;interleaved=0-1\r\nSession: 1\r\n"
            elif method == "PLAY":
                extra = "Session: 1\r\n"
            self.wfile.write(f"RTSP/1.0 200 OK\r\nCSeq: {sequence}\r\n{extra}\r\n{body}".encode())
            if method == "PLAY":
                self.server.connections += 1
                self._play()
                return

    def _play(self) -> None:
        size = 7 * TS_PACKET
        chunks = [self.server.data[k : k + size] for k in range(0, len(self.server.data), size)]
        begin = time.monotonic()
        try:
            for number, chunk in enumerate(chunks):
                due = self.server.duration_s * number / len(chunks)
                if self.server.stopping.wait(max(0.0, begin + due - time.monotonic())):
                    return
                packet = struct.pack(">BBHII", 0x80, 33, number & 0xFFFF, round(90_000 * due), 1) + chunk
                self.wfile.write(b"$\0" + struct.pack(">H", len(packet)) + packet)
        except OSError:
            return


def write_transport_stream(path: Path, count: int, rate_hz: float) -> Path:
    """An MPEG-2 transport stream with MPEG-4 video."""
    writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*"mp4v"), rate_hz, (320, 240))
    assert writer.isOpened()
    for number in range(count):
        writer.write(numbered_picture(number))
    writer.release()
    return path
