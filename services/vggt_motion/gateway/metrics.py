"""Prometheus metrics, read from the state when they are asked for."""

from __future__ import annotations

from collections.abc import Iterator

from prometheus_client import CollectorRegistry, Counter, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily
from prometheus_client.metrics_core import Metric
from prometheus_client.registry import Collector

from vggt_motion.gateway.models import StatusAnswer
from vggt_motion.gateway.state import GatewayState
from vggt_motion.records import JobState

CONTENT_TYPE = "text/plain; version=0.0.4; charset=utf-8"


class GatewayMetrics:
    """The registry of one gateway."""

    def __init__(self, state: GatewayState) -> None:
        """Metrics of a state."""
        self._registry = CollectorRegistry()
        self._registry.register(_StateCollector(state))
        self.requests = Counter(
            "vggt_motion_http_requests",
            "HTTP requests by route and status code",
            ["route", "code"],
            registry=self._registry,
        )

    def render(self) -> bytes:
        """Text exposition format 0.0.4."""
        return generate_latest(self._registry)


class _StateCollector(Collector):
    def __init__(self, state: GatewayState) -> None:
        self._state = state

    def collect(self) -> Iterator[Metric]:
        status = self._state.status()
        yield _gauge("ready", "1 when the gateway's picture is complete and current", status.readiness.is_ready)
        yield _gauge("finished", "1 when the final graph is there", status.phase == "finished")
        yield from _session(status)
        yield from _services(status)
        yield from _ledger(status)
        yield _counter("live_events_missed", "events that slow clients missed", status.live_clients.missed_events)
        yield _gauge("live_clients", "clients of the live events", status.live_clients.connected)


def _session(status: StatusAnswer) -> Iterator[Metric]:
    yield _gauge("keyframes", "keyframes in the log", status.keyframes)
    frames = GaugeMetricFamily("vggt_motion_frames", "input frames of closed segments", labels=["state"])
    for state, count in status.motion.frame_counts.items():
        frames.add_metric([state], count)
    yield frames
    yield _gauge("segments", "closed segments", status.submaps.closed_segments)
    submaps = GaugeMetricFamily("vggt_motion_submaps", "predicted submaps", labels=["verdict"])
    for verdict, count in status.submaps.verdicts.items():
        submaps.add_metric([verdict], count)
    yield submaps
    constraints = GaugeMetricFamily("vggt_motion_constraints", "registrations between submaps", labels=["outcome"])
    constraints.add_metric(["accepted"], status.constraints.accepted)
    constraints.add_metric(["refused"], status.constraints.refused)
    yield constraints
    graph = status.graph
    yield _gauge("graph_revision", "newest pose graph, -1 before the first", graph.revision if graph else -1)
    yield _gauge("graph_submaps", "submaps in it", graph.submaps if graph else 0)
    yield _gauge("trajectory_breaks", "places where the trajectory is broken", len(graph.breaks) if graph else 0)
    yield _gauge("lag_keyframes", "keyframes whose submap is not in the graph yet", status.lag.keyframes)
    yield _gauge("lag_video_seconds", "seconds of video between camera and trajectory", status.lag.video_s or 0.0)


def _services(status: StatusAnswer) -> Iterator[Metric]:
    up = GaugeMetricFamily("vggt_motion_service_up", "1 for each process that is alive", labels=["service", "instance"])
    age = GaugeMetricFamily(
        "vggt_motion_service_report_age_seconds", "since its last report of health", labels=["service", "instance"]
    )
    resident = GaugeMetricFamily(
        "vggt_motion_service_resident_bytes", "resident memory", labels=["service", "instance"]
    )
    counters = GaugeMetricFamily(
        "vggt_motion_service_counter", "what the service counts itself", labels=["service", "instance", "name"]
    )
    for service in status.services:
        labels = [service.service, service.instance]
        up.add_metric(labels, 1)
        if service.report_age_s is not None:
            age.add_metric(labels, service.report_age_s)
        if service.resident_bytes is not None:
            resident.add_metric(labels, service.resident_bytes)
        for name, value in sorted(service.counters.items()):
            counters.add_metric([*labels, name], value)
    yield from (up, age, resident, counters)


def _ledger(status: StatusAnswer) -> Iterator[Metric]:
    yield _gauge("ledger_answering", "1 while the ledger answers", status.ledger.is_answering)
    yield _gauge("ledger_accepting", "0 below the reserve of free disk", status.ledger.is_accepting)
    yield _gauge("ledger_stored_bytes", "size of the session", status.ledger.stored_bytes)
    yield _gauge("ledger_free_bytes", "free disk", status.ledger.free_bytes)
    yield _counter("ledger_refused_requests", "requests that the ledger refused", status.ledger.refused_requests)
    records = GaugeMetricFamily("vggt_motion_stream_records", "records in the ledger", labels=["stream"])
    followed = GaugeMetricFamily("vggt_motion_stream_followed", "records that the gateway has", labels=["stream"])
    for stream in status.streams:
        if stream.ledger_position is not None:
            records.add_metric([stream.stream], stream.ledger_position)
        followed.add_metric([stream.stream], stream.gateway_position)
    jobs = GaugeMetricFamily("vggt_motion_jobs", "jobs in the queue", labels=["kind", "state"])
    for kind in status.jobs:
        for state in JobState:
            jobs.add_metric([kind.kind, state.value], getattr(kind, state.value))
    yield from (records, followed, jobs)


def _gauge(name: str, help_text: str, value: float) -> GaugeMetricFamily:
    return GaugeMetricFamily(f"vggt_motion_{name}", help_text, value=float(value))


def _counter(name: str, help_text: str, value: float) -> CounterMetricFamily:
    return CounterMetricFamily(f"vggt_motion_{name}", help_text, value=float(value))
