"""The gateway as a process, with a real router and a real ledger, asked over real HTTP."""

from __future__ import annotations

import contextlib
import io
import json
import socket
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import httpx
import numpy as np
import pytest
from plyfile import PlyData

from live_session import LiveSession, Service, live_session, wait_for
from synthetic_session import BASE, HEIGHT, WIDTH, Session, world_from_camera
from vggt_motion.config import Config, GatewayConfig
from vggt_motion.errors import ConfigurationError
from vggt_motion.gateway.app import create_app
from vggt_motion.gateway.service import HttpServer, bind, main
from vggt_motion.gateway.state import GatewayState
from vggt_motion.records import Event, EventKind, Stream


@pytest.fixture(scope="module")
def session() -> Session:
    pixels = np.full((20, 32, 3), 90, dtype=np.uint8)
    return Session(3, cv2.imencode(".png", pixels)[1].tobytes(), "image/png")


def client_of(live: LiveSession, gateway: Service) -> httpx.Client:
    report = live.report_of(gateway)
    assert report is not None
    return httpx.Client(base_url=f"http://127.0.0.1:{int(report.counters['port'])}", timeout=60)


def events_of(response: httpx.Response) -> Iterator[tuple[str, Any]]:
    """Events of an open stream, as the HTML standard reads them."""
    name = ""
    for line in response.iter_lines():
        if line.startswith("event: "):
            name = line[len("event: ") :]
        elif line.startswith("data: "):
            yield name, json.loads(line[len("data: ") :])


def test_the_gateway_shows_what_the_ledger_holds(tmp_path: Path, session: Session) -> None:
    with live_session(tmp_path, backend={"map_voxel_over_step": 0.0}) as live:
        gateway = live.started("gateway")
        with client_of(live, gateway) as client:
            assert client.get("/healthz").status_code == 200
            wait_for(lambda: client.get("/readyz").status_code == 200, "readiness")
            assert client.get("/api/v1/trajectory").status_code == 404
            with client.stream("GET", "/api/v1/events") as stream:
                live.append(session)
                names = []
                for name, data in events_of(stream):
                    names.append(name)
                    if name == "graph":
                        assert data == {
                            "revision": 6, "is_final": True, "submaps": 3, "components": 1, "breaks": 0
                        }  # fmt: skip
                    if {"keyframe", "segment", "submap", "constraint", "graph", "event"} <= set(names):
                        break
            status = wait_for(
                lambda: (s := client.get("/api/v1/status").json())["phase"] == "finished" and s, "the end"
            )
            wait_for(
                lambda: all(
                    s["ledger_position"] == s["gateway_position"]
                    for s in client.get("/api/v1/status").json()["streams"]
                ),
                "all records",
            )
            # Tokens of liveliness come one by one, and the gateway looks at them now and then.
            wait_for(
                lambda: (
                    {"ledger", "gateway"}
                    <= {service["service"] for service in client.get("/api/v1/status").json()["services"]}
                ),
                "the services",
            )
            assert status["ledger"]["is_accepting"] is True
            text = client.get("/api/v1/trajectory?format=tum&frames=key").text
            rows = np.array([[float(field) for field in line.split()] for line in text.splitlines()])
            truth = np.array([world_from_camera(k.frame_index)[:3, 3] for k in session.keyframes])
            np.testing.assert_allclose(rows[:, 1:4], truth, atol=1e-6)
            vertices = PlyData.read(io.BytesIO(client.get("/api/v1/map.ply").content))["vertex"]
            assert len(vertices) == 3 * BASE * WIDTH * HEIGHT
            assert "vggt_motion_keyframes 18.0" in client.get("/metrics").text
            assert client.get("/").headers["content-type"].startswith("text/html")
        assert gateway.stop() == 0, gateway.text()
        assert "Traceback" not in gateway.text()


def test_a_killed_gateway_knows_everything_again(tmp_path: Path, session: Session) -> None:
    with live_session(tmp_path) as live:
        live.append(session)
        texts = []
        for _ in range(2):
            gateway = live.started("gateway")
            with client_of(live, gateway) as client:
                wait_for(lambda: client.get("/api/v1/trajectory").headers.get("x-is-final") == "true", "trajectory")
                wait_for(lambda: client.get("/api/v1/status").json()["keyframes"] == 3 * BASE, "keyframes")
                texts.append(client.get("/api/v1/trajectory?format=csv&frames=all").text)
            gateway.kill()
        assert texts[0] == texts[1]


def test_a_silent_ledger_makes_the_gateway_unready_and_no_more(tmp_path: Path, session: Session) -> None:
    with live_session(tmp_path) as live:
        live.append(session)
        gateway = live.started("gateway")
        with client_of(live, gateway) as client:
            wait_for(lambda: client.get("/readyz").status_code == 200, "readiness")
            wait_for(lambda: client.get("/api/v1/trajectory").status_code == 200, "trajectory")
            next(service for service in live.services if service.name == "ledger").kill()
            answer = wait_for(lambda: (a := client.get("/readyz")).status_code == 503 and a, "unreadiness")
            assert answer.json()["reason"] == "the ledger does not answer"
            assert client.get("/api/v1/trajectory").status_code == 200
            assert client.get("/api/v1/status").json()["ledger"]["is_answering"] is False
        assert gateway.stop() == 0


def test_the_token_is_needed_from_outside(tmp_path: Path) -> None:
    token = "a-token-of-some-length"
    with live_session(tmp_path, gateway={"port": 0, "host": "0.0.0.0", "token": token}) as live:
        gateway = live.started("gateway")
        with client_of(live, gateway) as client:
            assert client.get("/api/v1/status").status_code == 401
            assert client.get("/api/v1/status", headers={"Authorization": f"Bearer {token}"}).status_code == 200
        assert token not in gateway.text()


# --- starting ---


def test_an_address_for_all_without_a_token_is_refused_at_start() -> None:
    with pytest.raises(ConfigurationError, match=r"set gateway\.token"):
        main(Config(gateway=GatewayConfig(host="0.0.0.0", port=0)))


def test_a_taken_port_is_one_clear_line_and_exit_2(tmp_path: Path) -> None:
    with live_session(tmp_path) as live, socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        gateway = live.start("gateway", "--set", f"gateway.port={port}")
        assert gateway.process.wait(60) == 2
        assert gateway.text().strip() == (
            f"vggt-motion: the gateway cannot listen on 127.0.0.1 port {port}: address already in use; "
            "choose another with gateway.port, 0 for any"
        )


@pytest.mark.parametrize("host", ["192.0.2.1", "no-such-host.invalid"])
def test_an_address_of_another_machine_is_refused(host: str) -> None:
    with pytest.raises(ConfigurationError, match=host.replace(".", r"\.")):
        bind(GatewayConfig(host=host, token="a-token-of-some-length"))


# --- HTTP server alone ---


@contextlib.contextmanager
def served(state: GatewayState) -> Iterator[str]:
    config = GatewayConfig(port=0)
    listener = bind(config)
    server = HttpServer(create_app(state, config), listener)
    server.start()
    try:
        yield f"http://127.0.0.1:{listener.getsockname()[1]}"
    finally:
        state.hub.close()
        server.stop()
        listener.close()


def warning(number: int) -> Event:
    return Event(f"warning/{number}", EventKind.WARNING, "x" * 1000, number)


def test_a_client_that_does_not_read_holds_up_nobody() -> None:
    """One client opens the events and reads nothing; 20 MB of events go by; the other gets all of its own."""
    state = GatewayState(Config())
    count = 20_000
    with served(state) as url:
        port = int(url.rsplit(":", 1)[1])
        with socket.create_connection(("127.0.0.1", port)) as deaf:
            deaf.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
            deaf.sendall(b"GET /api/v1/events HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n")
            wait_for(lambda: state.hub.client_count == 1, "the deaf client")
            feeder = threading.Thread(
                target=lambda: [state.apply(Stream.EVENT, n, warning(n)) for n in range(count)], daemon=True
            )
            feeder.start()
            feeder.join(60)
            assert not feeder.is_alive()
            with httpx.Client(base_url=url, timeout=60) as client:
                assert client.get("/api/v1/status").json()["live_clients"]["missed_events"] > 0
                with client.stream("GET", "/api/v1/events") as stream:
                    wait_for(lambda: state.hub.client_count == 2, "the other client")
                    received = []
                    events = events_of(stream)
                    for number in range(count, count + 200):
                        state.apply(Stream.EVENT, number, warning(number))
                        received.append(next(events))
                assert [name for name, _ in received] == ["event"] * 200
                assert [data["time_ns"] for _, data in received] == list(range(count, count + 200))
            # When it reads at last, it learns what it missed and goes on with the newest.
            deaf.settimeout(60)
            text = b""
            while b"event: lagged" not in text:
                chunk = deaf.recv(65536)
                assert chunk
                text = text[-2000:] + chunk
        wait_for(lambda: state.hub.client_count == 0, "the clients' end")


def test_open_streams_end_with_the_server() -> None:
    state = GatewayState(Config())
    ended = threading.Event()

    def listen(url: str) -> None:
        with httpx.stream("GET", f"{url}/api/v1/events", timeout=60) as stream:
            for _ in stream.iter_bytes():
                pass
        ended.set()

    with served(state) as url:
        threading.Thread(target=listen, args=(url,), daemon=True).start()
        wait_for(lambda: state.hub.client_count == 1, "the client")
    assert ended.wait(60)
