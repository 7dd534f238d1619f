"""The gateway on a session that was fed by hand: numbers, formats, refusals, access."""

from __future__ import annotations

import asyncio
import io
import json
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest
from fastapi.testclient import TestClient
from plyfile import PlyData
from prometheus_client.parser import text_string_to_metric_families

from synthetic_session import (
    BASE,
    FRAME_INTERVAL_NS,
    HEIGHT,
    WIDTH,
    Session,
    world_from_camera,
    world_from_submap,
)
from vggt_motion.config import BackendConfig, Config, GatewayConfig
from vggt_motion.errors import ConfigurationError, VggtMotionError
from vggt_motion.gateway.app import create_app
from vggt_motion.gateway.builder import Builder
from vggt_motion.gateway.hub import CLOSED, LAGGED, EventHub
from vggt_motion.gateway.security import is_loopback
from vggt_motion.gateway.state import GatewayState, Snapshot
from vggt_motion.geometry import se3
from vggt_motion.records import (
    Event,
    EventKind,
    HealthReport,
    JobCount,
    LedgerStatus,
    Stream,
    StreamPosition,
    SubmapVerdict,
)

LOCAL = GatewayConfig()
TOKEN = "correct-horse-battery"


def feed(state: GatewayState, session: Session, **options: Any) -> None:
    for stream, sequence, record in session.entries(**options):
        state.apply(stream, sequence, record)  # type: ignore[arg-type]


def ledger_status(session: Session, **changes: Any) -> LedgerStatus:
    counts: dict[str, int] = {}
    for stream, sequence, _ in session.entries():
        counts[stream.value] = sequence + 1
    positions = tuple(StreamPosition(stream, count) for stream, count in counts.items())
    jobs = (JobCount("predict", "open", 2), JobCount("predict", "done", 3), JobCount("register", "leased", 1))
    return replace(LedgerStatus(positions, jobs, 1000, 2000, True, "", 4, "0a1b"), **changes)


def client_of(state: GatewayState, config: GatewayConfig = LOCAL, **options: Any) -> TestClient:
    return TestClient(create_app(state, config, **options), base_url="http://127.0.0.1:8000")


@pytest.fixture(scope="module")
def session() -> Session:
    return Session(4)


@pytest.fixture
def state(session: Session) -> GatewayState:
    state = GatewayState(Config())
    feed(state, session)
    state.set_ledger(ledger_status(session))
    return state


@pytest.fixture
def client(state: GatewayState) -> Iterator[TestClient]:
    with client_of(state) as client:
        yield client


# --- trajectory ---


def test_tum_of_keyframes_is_the_truth(client: TestClient, session: Session) -> None:
    answer = client.get("/api/v1/trajectory?format=tum&frames=key")
    assert answer.status_code == 200
    assert answer.headers["content-type"].startswith("text/plain")
    rows = np.array([[float(field) for field in line.split()] for line in answer.text.splitlines()])
    assert len(rows) == 4 * BASE
    for row, keyframe in zip(rows, session.keyframes, strict=True):
        truth = world_from_camera(keyframe.frame_index)
        assert row[0] == pytest.approx(keyframe.capture_time_ns / 1e9)
        np.testing.assert_allclose(row[1:4], truth[:3, 3], atol=1e-6)
        rotation = se3.rotation_from_quaternion(row[[7, 4, 5, 6]])
        np.testing.assert_allclose(rotation, truth[:3, :3], atol=1e-6)


def test_kitti_of_all_frames_has_a_line_for_every_input_frame(client: TestClient, session: Session) -> None:
    answer = client.get("/api/v1/trajectory", params={"format": "kitti", "frames": "all"})
    rows = np.array([[float(field) for field in line.split()] for line in answer.text.splitlines()]).reshape(-1, 3, 4)
    assert len(rows) == session.frame_count
    for index in range(0, session.frame_count, 2):
        np.testing.assert_allclose(rows[index], world_from_camera(index)[:3], atol=1e-6)
    for index in range(1, session.frame_count - 1, 2):
        # Half-way between two keyframes: the middle of the chord.
        middle = (world_from_camera(index - 1)[:3, 3] + world_from_camera(index + 1)[:3, 3]) / 2
        np.testing.assert_allclose(rows[index][:, 3], middle, atol=1e-6)


def test_json_and_csv_name_every_frame(client: TestClient, session: Session) -> None:
    data = client.get("/api/v1/trajectory?format=json&frames=all").json()
    assert [frame["frame_index"] for frame in data["frames"]] == list(range(session.frame_count))
    assert data["is_final"] is True
    assert {frame["state"] for frame in data["frames"]} == {"T", "L"}
    keyframes = client.get("/api/v1/trajectory").json()["frames"]  # the defaults
    assert [f["capture_time_ns"] for f in keyframes] == [n * 2 * FRAME_INTERVAL_NS for n in range(4 * BASE)]
    lines = client.get("/api/v1/trajectory?format=csv&frames=all").text.splitlines()
    assert len(lines) == session.frame_count + 1
    assert lines[0].startswith("camera,epoch,frame_index")


def test_known_distance_sets_the_scale(session: Session) -> None:
    state = GatewayState(Config(backend=BackendConfig(known_distance_m=500.0)))
    feed(state, session)
    with client_of(state) as client:
        text = client.get("/api/v1/trajectory?format=tum&frames=all").text
    positions = np.array([[float(field) for field in line.split()[1:4]] for line in text.splitlines()])
    assert np.linalg.norm(np.diff(positions, axis=0), axis=1).sum() == pytest.approx(500.0)


def test_a_broken_trajectory_is_visible_and_can_be_had_in_parts(session: Session) -> None:
    state = GatewayState(Config())
    feed(state, session, broken_at=2)
    with client_of(state) as client:
        whole = client.get("/api/v1/trajectory?frames=key")
        assert whole.headers["x-components"] == "0,2"
        parts = [client.get(f"/api/v1/trajectory?component={c}").json()["frames"] for c in (0, 2)]
        assert len(parts[0]) + len(parts[1]) == len(whole.json()["frames"])
        missing = client.get("/api/v1/trajectory?component=1")
        assert (missing.status_code, missing.json()) == (
            404,
            {"error": "the trajectory has no component 1: its components are 0, 2"},
        )
        status = client.get("/api/v1/status").json()
        assert status["graph"]["components"] == 2
        assert status["graph"]["breaks"] == ["between submaps 1 and 2: too few points"]


def test_a_camera_that_did_not_move_has_identical_poses(session: Session) -> None:
    """No graph node at all: the poses are there all the same."""
    from vggt_motion.records import GraphUpdate, MotionState, Segment

    segment = session.segments[0]
    frames = tuple(replace(f, state=MotionState.STATIC) for f in segment.frames)
    state = GatewayState(Config())
    state.apply(Stream.SEGMENT, 0, replace(segment, frames=frames))
    state.apply(Stream.GRAPH, 0, GraphUpdate(0, True, (), ()))
    assert isinstance(segment, Segment)
    with client_of(state) as client:
        rows = client.get("/api/v1/trajectory?format=kitti&frames=all").text.splitlines()
    assert len(rows) == len(frames)
    assert len(set(rows)) == 1


def test_the_answer_follows_the_graph(session: Session) -> None:
    state = GatewayState(Config())
    for stream, sequence, record in session.entries():
        if stream is not Stream.GRAPH:
            state.apply(stream, sequence, record)  # type: ignore[arg-type]
    with client_of(state) as client:
        early = client.get("/api/v1/trajectory")
        assert early.status_code == 404
        assert early.json() == {"error": "no trajectory yet: no submap has been optimised"}
        assert client.get("/api/v1/map.ply").status_code == 404
        state.apply(Stream.GRAPH, 0, session.graph(2))
        assert client.get("/api/v1/trajectory").headers["x-graph-revision"] == "4"
        assert state.status().lag.keyframes == 2 * BASE
        assert state.status().lag.video_s == pytest.approx(2 * BASE * 2 * FRAME_INTERVAL_NS / 1e9)
        state.apply(Stream.GRAPH, 1, session.graph(is_final=True))
        final = client.get("/api/v1/trajectory")
        assert (final.headers["x-graph-revision"], final.headers["x-is-final"]) == ("8", "true")
        assert state.status().lag.keyframes == 0


# --- map ---


def painted_session() -> Session:
    pixels = np.full((40, 64, 3), (200, 100, 50), dtype=np.uint8)  # RGB
    return Session(3, cv2.imencode(".png", pixels[:, :, ::-1])[1].tobytes(), "image/png")


def test_the_map_shows_the_walls_where_they_are() -> None:
    """Every point lies on the wall that some keyframe sees, and every wall is there with all its pixels, once."""
    session = painted_session()
    state = GatewayState(
        Config(backend=BackendConfig(map_voxel_over_step=0.0)), read_blob=lambda ref: session.blobs[ref.sha256]
    )
    feed(state, session)
    with client_of(state) as client:
        answer = client.get("/api/v1/map.ply")
    assert answer.status_code == 200
    vertices = PlyData.read(io.BytesIO(answer.content))["vertex"]
    points = np.stack([vertices[axis] for axis in "xyz"], axis=1)
    assert {tuple(row) for row in zip(vertices["red"], vertices["green"], vertices["blue"], strict=True)} == {
        (200, 100, 50)
    }
    assert len(points) == 3 * BASE * WIDTH * HEIGHT
    is_on_wall = np.zeros(len(points), dtype=bool)
    for number, keyframe in enumerate(session.keyframes):
        scale = world_from_submap(number // BASE).scale
        in_camera = se3.act(se3.inverse(world_from_camera(keyframe.frame_index)), points)
        wall = scale * (5.0 + 0.01 * keyframe.frame_index)
        hits = np.abs(in_camera[:, 2] - wall) < 1e-2
        assert hits.sum() >= WIDTH * HEIGHT
        is_on_wall |= hits
    assert is_on_wall.all()


def test_the_map_of_a_broken_session_is_that_of_its_largest_part() -> None:
    session = painted_session()
    state = GatewayState(
        Config(backend=BackendConfig(map_voxel_over_step=0.0)), read_blob=lambda ref: session.blobs[ref.sha256]
    )
    feed(state, session, broken_at=1)
    with client_of(state) as client:
        vertices = PlyData.read(io.BytesIO(client.get("/api/v1/map.ply").content))["vertex"]
    assert len(vertices) == 2 * BASE * WIDTH * HEIGHT


def test_a_map_without_payloads_says_why(client: TestClient) -> None:
    answer = client.get("/api/v1/map.ply")
    assert answer.status_code == 503
    assert "no access to the payloads" in answer.json()["error"]


# --- wrong requests ---


@pytest.mark.parametrize(
    ("query", "message"),
    [
        ("format=xyz", "query 'format': input should be 'tum', 'kitti', 'csv' or 'json', not 'xyz'"),
        ("frames=some", "query 'frames': input should be 'key' or 'all', not 'some'"),
        ("component=minus", "query 'component': input should be a valid integer"),
        ("component=-1", "query 'component': input should be greater than or equal to 0"),
        ("frame=all", "query 'frame': extra inputs are not permitted, not 'all'"),
        ("format=tum&format=xyz", "query 'format': input should be"),
    ],
)
def test_a_wrong_parameter_is_one_clear_line(client: TestClient, query: str, message: str) -> None:
    answer = client.get(f"/api/v1/trajectory?{query}")
    assert answer.status_code == 400
    assert list(answer.json()) == ["error"]
    assert answer.json()["error"].startswith(message)
    assert "\n" not in answer.json()["error"]


def test_unknown_paths_and_methods(client: TestClient) -> None:
    assert client.get("/api/v1/nothing").status_code == 404
    assert client.get("/api/v1/nothing").json() == {"error": "Not Found"}
    assert client.post("/api/v1/status").status_code == 405
    assert client.get("/api/v1/status?x=1").status_code == 400
    assert client.get("/api/v1/map.ply?x=1").status_code == 400


# --- status ---


def test_status_counts_what_was_fed(client: TestClient, session: Session, state: GatewayState) -> None:
    report = HealthReport("inference", "inference-1", 0, "working", "submap 3", 123, {"jobs_done": 3.0})
    state.set_services({("inference", "inference-1"): report, ("backend", "b"): None})
    status = client.get("/api/v1/status").json()
    assert status["phase"] == "finished"
    assert status["keyframes"] == 4 * BASE
    states = [session.state(index).value for index in range(session.frame_count)]
    assert status["motion"]["frame_counts"] == {"S": 0, "T": states.count("T"), "L": states.count("L")}
    assert status["motion"]["current"] == session.keyframes[-1].state.value
    assert status["submaps"]["verdicts"] == {"good": 3, "low_quality": 1, "rotation_only": 0, "failed": 0}
    assert status["submaps"]["doubtful"] == ["submap 1 (revision 1): low_quality: few tracks"]
    assert status["constraints"] == {"accepted": 3, "refused": 0, "loops_accepted": 0}
    assert status["graph"]["edges_used"] == 3
    assert status["predictor"] == {"configured": "sfm", "reason": "", "models": {"sfm": 4}}
    positions = {s["stream"]: (s["ledger_position"], s["gateway_position"]) for s in status["streams"]}
    assert positions["keyframe"] == (4 * BASE, 4 * BASE)
    assert positions["descriptor"] == (0, 0)
    assert status["lag"]["jobs_waiting"] == 3
    assert {j["kind"]: j["open"] for j in status["jobs"]} == {"describe": 0, "predict": 2, "register": 0}
    services = {s["service"]: s for s in status["services"]}
    assert services["inference"]["counters"] == {"jobs_done": 3.0}
    assert services["backend"]["state"] == "silent"
    assert [n["kind"] for n in status["notices"]] == ["session_started", "stream_ended"]


def test_records_that_come_twice_count_once(session: Session) -> None:
    state = GatewayState(Config())
    feed(state, session)
    once = state.status()
    feed(state, session)
    assert state.status() == once


def test_a_second_revision_replaces_the_verdict(session: Session, state: GatewayState) -> None:
    again = replace(
        session.submaps[1], spec=replace(session.submaps[1].spec, revision=2), verdict=SubmapVerdict.GOOD, reason=""
    )
    state.apply(Stream.SUBMAP, 4, again)
    assert state.status().submaps.verdicts["low_quality"] == 0


def test_a_dead_job_is_shown_with_its_reason(state: GatewayState) -> None:
    detail = {"job_id": "submap/000002/r1", "kind": "predict", "reason": "out of memory", "traceback": "Traceback ..."}
    state.apply(Stream.EVENT, 2, Event("job_dead/submap/000002/r1", EventKind.JOB_DEAD, "given up", 1, detail))
    [job] = state.status().dead_jobs
    assert (job.job_id, job.kind, job.reason) == ("submap/000002/r1", "predict", "out of memory")


def test_readiness_follows_the_ledger(session: Session, monkeypatch: pytest.MonkeyPatch) -> None:
    state = GatewayState(Config())
    with client_of(state) as client:
        assert client.get("/healthz").json() == {"status": "ok"}
        answer = client.get("/readyz")
        assert (answer.status_code, answer.json()["reason"]) == (503, "the ledger does not answer")
        state.set_ledger(ledger_status(session, positions=(StreamPosition("keyframe", 5000),)))
        assert client.get("/readyz").json()["reason"] == "5000 records of the log are still to be read"
        feed(state, session)
        state.set_ledger(ledger_status(session))
        assert client.get("/readyz").status_code == 200
        state.set_ledger(None)
        assert client.get("/readyz").status_code == 200  # one answer that was missed says nothing
        monkeypatch.setattr("vggt_motion.gateway.state._STALE_S", 0.0)
        assert client.get("/readyz").status_code == 503


def test_metrics_are_prometheus_text(client: TestClient, session: Session) -> None:
    client.get("/api/v1/trajectory?format=xyz")
    answer = client.get("/metrics")
    assert answer.headers["content-type"].startswith("text/plain; version=0.0.4")
    samples = {
        (sample.name, tuple(sorted(sample.labels.items()))): sample.value
        for family in text_string_to_metric_families(answer.text)
        for sample in family.samples
    }
    assert samples["vggt_motion_keyframes", ()] == 4 * BASE
    assert samples["vggt_motion_jobs", (("kind", "predict"), ("state", "open"))] == 2
    assert samples["vggt_motion_submaps", (("verdict", "low_quality"),)] == 1
    assert samples["vggt_motion_stream_records", (("stream", "segment"),)] == 4
    assert samples["vggt_motion_ledger_refused_requests_total", ()] == 4
    assert samples["vggt_motion_http_requests_total", (("code", "400"), ("route", "/api/v1/trajectory"))] == 1


def test_openapi_describes_every_route_with_examples(client: TestClient) -> None:
    spec = client.get("/openapi.json").json()
    assert set(spec["paths"]) == {
        "/healthz", "/readyz", "/metrics", "/api/v1/status", "/api/v1/trajectory", "/api/v1/map.ply", "/api/v1/events",
    }  # fmt: skip
    content = spec["paths"]["/api/v1/trajectory"]["get"]["responses"]["200"]["content"]
    assert all("example" in entry for entry in content.values())
    assert content.keys() == {"application/json", "text/plain", "text/csv"}
    parameters = spec["paths"]["/api/v1/trajectory"]["get"]["parameters"]
    assert all(entry.get("example") is not None or entry["schema"].get("examples") for entry in parameters)
    for path in spec["paths"].values():
        assert "422" not in path["get"]["responses"], "a wrong parameter is answered with 400"
    assert "example" in spec["paths"]["/api/v1/events"]["get"]["responses"]["200"]["content"]["text/event-stream"]
    assert spec["components"]["schemas"]["ServiceStatus"]["properties"]["service"]["examples"] == ["inference"]


def test_the_pages_load_nothing_from_elsewhere(client: TestClient) -> None:
    for path in ("/", "/docs"):
        page = client.get(path)
        assert page.status_code == 200
        assert page.headers["content-type"].startswith("text/html")
        assert "default-src 'none'" in page.headers["content-security-policy"]
        for mark in ("http://", "https://", "src=", "@import", "innerHTML"):
            assert mark not in page.text


# --- access ---


@pytest.mark.parametrize("host", ["0.0.0.0", "::", "192.168.1.4", "gateway.example.org"])
def test_a_reachable_address_needs_a_token(host: str) -> None:
    with pytest.raises(ConfigurationError, match=r"set gateway\.token"):
        create_app(GatewayState(Config()), GatewayConfig(host=host))
    create_app(GatewayState(Config()), GatewayConfig(host=host, token=TOKEN))


def test_loopback_is_recognised() -> None:
    assert all(map(is_loopback, ["127.0.0.1", "127.9.9.9", "::1", "localhost"]))
    assert not any(map(is_loopback, ["0.0.0.0", "::", "10.0.0.1", "localhost.example.org", ""]))


def test_the_token_guards_interface_and_metrics(state: GatewayState) -> None:
    with client_of(state, GatewayConfig(host="0.0.0.0", token=TOKEN)) as client:
        for path in ("/api/v1/status", "/api/v1/trajectory", "/api/v1/map.ply", "/api/v1/events", "/metrics", "/api/x"):
            for header in (None, "Bearer wrong", f"Basic {TOKEN}", TOKEN, f"Bearer {TOKEN}x", "Bearer ü"):
                headers = {} if header is None else {"Authorization": header.encode()}
                answer = client.get(path, headers=headers)
                assert answer.status_code == 401, (path, header)
                assert answer.headers["www-authenticate"] == "Bearer"
        assert client.get("/api/v1/status", headers={"Authorization": f"Bearer {TOKEN}"}).status_code == 200
        for path in ("/", "/docs", "/healthz"):
            assert client.get(path).status_code == 200


def test_without_a_token_only_local_names_are_served(state: GatewayState) -> None:
    with client_of(state) as client:
        for host in ("127.0.0.1:8000", "localhost", "localhost:9", "[::1]:8000"):
            assert client.get("/api/v1/status", headers={"Host": host}).status_code == 200
        for host in ("evil.example.org", "evil.example.org:8000", "127.0.0.1.example.org", ""):
            assert client.get("/api/v1/status", headers={"Host": host}).status_code == 403


# --- slow clients, long results ---


def test_a_slow_client_misses_and_learns_so() -> None:
    async def scenario() -> None:
        hub = EventHub(capacity=3)
        slow, fast = hub.subscribe(), hub.subscribe()
        assert slow is not None and fast is not None
        seen = []
        for number in range(10):
            hub.publish("keyframe", {"n": number})
            event = await fast.next(1.0)
            assert event is not None
            seen.append(event.data["n"])
        assert seen == list(range(10))
        first = await slow.next(1.0)
        assert first is not None and (first.name, first.data) == (LAGGED, {"missed_events": 9})
        second = await slow.next(1.0)
        assert second is not None and second.data == {"n": 9}
        assert await slow.next(0.01) is None
        assert hub.dropped_count == 9
        hub.close()
        last = await slow.next(1.0)
        assert last is not None and last.name == CLOSED
        assert hub.subscribe() is None

    asyncio.run(scenario())


def test_too_many_clients_are_refused_and_a_place_becomes_free() -> None:
    async def scenario() -> None:
        hub = EventHub(max_clients=2)
        clients = [hub.subscribe() for _ in range(3)]
        assert clients[0] is not None and clients[2] is None
        clients[0].close()
        clients[0].close()
        assert hub.subscribe() is not None
        assert hub.client_count == 2

    asyncio.run(scenario())


def test_events_from_another_thread_wake_the_client() -> None:
    async def scenario() -> None:
        hub = EventHub()
        client = hub.subscribe()
        assert client is not None
        task = asyncio.create_task(client.next(30.0))
        await asyncio.sleep(0)
        await asyncio.to_thread(hub.publish, "graph", {"revision": 3})
        event = await task
        assert event is not None
        assert event.encode() == b'id: 1\nevent: graph\ndata: {"revision":3}\n\n'

    asyncio.run(scenario())


def test_what_many_ask_for_is_built_once() -> None:
    async def scenario() -> None:
        builder: Builder[int] = Builder("test", kept=1)
        count = 0

        def build() -> int:
            nonlocal count
            count += 1
            return count

        results = await asyncio.gather(*(builder.get("a", build) for _ in range(20)))
        assert {built.value for built in results} == {1}
        assert (await builder.get("b", build)).value == 2
        assert (await builder.get("a", build)).value == 3  # only one is kept

    asyncio.run(scenario())


def test_a_failed_build_reaches_all_who_asked_and_is_tried_again(session: Session) -> None:
    state = GatewayState(Config())
    feed(state, session)
    attempts: list[Snapshot] = []

    def build(snapshot: Snapshot) -> bytes:
        attempts.append(snapshot)
        if len(attempts) == 1:
            raise VggtMotionError("the ledger does not answer")
        return b"ply"

    with client_of(state, build_map=build) as client:
        first = client.get("/api/v1/map.ply")
        assert (first.status_code, first.json()) == (503, {"error": "the ledger does not answer"})
        assert client.get("/api/v1/map.ply").content == b"ply"
        assert client.get("/api/v1/map.ply").content == b"ply"
    assert len(attempts) == 2
    assert set(attempts[0].submaps) == {0, 1, 2, 3}


def test_status_is_json_without_surprises(client: TestClient) -> None:
    text = client.get("/api/v1/status").text
    json.loads(text, parse_constant=lambda name: pytest.fail(f"{name} is not JSON"))
