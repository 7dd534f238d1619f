"""A TCP proxy that can cut its links, swallow what goes over them, and let them come back."""

from __future__ import annotations

import contextlib
import selectors
import socket
import threading
import time

_CHUNK_BYTES = 1 << 16


class CuttingProxy:
    """Forwards every connection to ``127.0.0.1:target_port``; one thread."""

    def __init__(self, target_port: int) -> None:
        self._target = ("127.0.0.1", target_port)
        self._listener = socket.create_server(("127.0.0.1", 0), backlog=64)
        self.port = int(self._listener.getsockname()[1])
        self._peers: dict[socket.socket, socket.socket] = {}
        self._selector = selectors.DefaultSelector()
        self._selector.register(self._listener, selectors.EVENT_READ)
        self._is_cut = self._is_black_hole = self._is_closed = False
        self.cut_count = 0
        self._thread = threading.Thread(target=self._run, name="proxy", daemon=True)
        self._thread.start()

    @property
    def endpoint(self) -> str:
        return f"tcp/127.0.0.1:{self.port}"

    @property
    def link_count(self) -> int:
        """Links that are up at this moment."""
        return len(self._peers) // 2

    def cut(self, seconds: float) -> None:
        """Every link is reset, and new ones are refused, for so long."""
        self.cut_count += 1
        self._is_cut = True
        time.sleep(seconds)
        self._is_cut = False

    def black_hole(self, seconds: float) -> None:
        """Links stay open and carry nothing, and new ones are accepted and stay silent, for so long; then all end."""
        self.cut_count += 1
        self._is_black_hole = True
        time.sleep(seconds)
        # The bytes that were swallowed are gone: a stream with a hole must not go on.
        self._is_cut = True
        time.sleep(0.3)
        self._is_cut = self._is_black_hole = False

    def close(self) -> None:
        self._is_closed = True
        self._thread.join(5)

    def _run(self) -> None:
        while not self._is_closed:
            ready = self._selector.select(0.05)
            if self._is_cut:
                for end in list(self._peers):
                    self._drop(end)
            for key, _ in ready:
                end = key.fileobj
                assert isinstance(end, socket.socket)
                if end is self._listener:
                    self._accept()
                elif end in self._peers:
                    self._forward(end)
        for end in list(self._peers):
            self._drop(end)
        self._listener.close()

    def _accept(self) -> None:
        client, _ = self._listener.accept()
        try:
            if self._is_cut:
                raise ConnectionRefusedError
            server = socket.create_connection(self._target, timeout=5)
        except OSError:
            client.close()
            return
        for end, other in ((client, server), (server, client)):
            self._peers[end] = other
            end.settimeout(20)
            end.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self._selector.register(end, selectors.EVENT_READ)

    def _forward(self, end: socket.socket) -> None:
        try:
            data = end.recv(_CHUNK_BYTES)
            if not data:
                raise ConnectionResetError
            if not self._is_black_hole:
                self._peers[end].sendall(data)
        except OSError:
            self._drop(end)

    def _drop(self, end: socket.socket) -> None:
        other = self._peers.pop(end, None)
        for one in (end, other):
            if one is None:
                continue
            self._peers.pop(one, None)
            with contextlib.suppress(KeyError, ValueError):
                self._selector.unregister(one)
            one.close()
