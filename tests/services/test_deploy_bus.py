"""The Zenoh files that we ship, with real certificates, passwords and sessions on loopback."""

from __future__ import annotations

import contextlib
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from bus_processes import free_port, wait_until
from vggt_motion.bus.session import Bus, open_bus
from vggt_motion.config import BusConfig
from vggt_motion.errors import BusUnavailableError, VggtMotionError

SHIPPED = Path(__file__).resolve().parents[2] / "deploy" / "zenoh"
CREDENTIALS = "/run/credentials/vggt-motion-frontend.service"


def openssl(*arguments: str, cwd: Path) -> None:
    subprocess.run(["openssl", *arguments], cwd=cwd, check=True, capture_output=True, timeout=60)


def authority(directory: Path) -> None:
    directory.mkdir()
    curve = ["-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes"]
    openssl(
        "req", "-x509", *curve, "-keyout", "ca.key", "-out", "ca.pem", "-days", "2", "-subj", "/CN=ca", cwd=directory
    )


def certificate(directory: Path, name: str, alternative_names: str, usage: str) -> None:
    """Key and certificate ``name``.key, ``name``.pem, signed by the authority in ``directory``."""
    curve = ["-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes"]
    openssl("req", *curve, "-keyout", f"{name}.key", "-out", f"{name}.csr", "-subj", f"/CN={name}", cwd=directory)
    (directory / "extensions").write_text(f"subjectAltName={alternative_names}\nextendedKeyUsage={usage}\n")
    openssl(
        *("x509", "-req", "-in", f"{name}.csr", "-CA", "ca.pem", "-CAkey", "ca.key", "-CAcreateserial"),
        *("-days", "2", "-extfile", "extensions", "-out", f"{name}.pem"),
        cwd=directory,
    )


def installed(directory: Path, file: str, certificates: Path) -> Path:
    """A shipped file as it would be installed, with the certificates of the test."""
    text = (SHIPPED / file).read_text(encoding="utf-8")
    text = text.replace("/etc/vggt-motion/tls", str(certificates)).replace(CREDENTIALS, str(certificates))
    path = directory / file
    path.write_text(text, encoding="utf-8")
    return path


@pytest.fixture(scope="module")
def certificates(tmp_path_factory: pytest.TempPathFactory) -> Path:
    if shutil.which("openssl") is None:
        pytest.skip("openssl is not installed (Debian package openssl)")
    directory = tmp_path_factory.mktemp("tls") / "ours"
    authority(directory)
    certificate(directory, "rack", "DNS:localhost,DNS:router", "serverAuth,clientAuth")
    certificate(directory, "vehicle", "DNS:vehicle-017", "clientAuth")
    return directory


@pytest.fixture
def rack(certificates: Path, tmp_path: Path) -> Path:
    return installed(tmp_path, "rack_tls.json5", certificates)


@pytest.fixture
def endpoint(rack: Path) -> Iterator[str]:
    port = free_port()
    # As compose.tls.yaml does: listen on every address, connect by the name in the certificate.
    router = open_bus(BusConfig(endpoint=f"tls/0.0.0.0:{port}", zenoh_config=rack), "router")
    yield f"tls/localhost:{port}"
    router.close()


def answered(bus: Bus, payload: bytes) -> bytes:
    """The answer of whoever serves the ledger's key, once its declaration has reached the router."""
    answers: list[bytes] = []

    def ask() -> bool:
        with contextlib.suppress(BusUnavailableError):
            answers.append(bus.request(bus.keys.rpc("ledger", "append"), payload, timeout_s=5.0))
        return bool(answers)

    wait_until(ask)
    return answers[0]


def test_vehicle_and_worker_of_the_rack_meet_at_the_router(
    certificates: Path, tmp_path: Path, rack: Path, endpoint: str
) -> None:
    vehicle = installed(tmp_path, "vehicle_tls.json5", certificates)
    worker_bus = open_bus(BusConfig(endpoint=endpoint, zenoh_config=rack))
    vehicle_bus = open_bus(BusConfig(endpoint=endpoint, zenoh_config=vehicle))
    try:
        with contextlib.closing(worker_bus.serve(worker_bus.keys.rpc("ledger", "append"), lambda _, data: data[::-1])):
            assert answered(vehicle_bus, b"keyframe") == b"emarfyek"
    finally:
        vehicle_bus.close()
        worker_bus.close()


def refused(config: BusConfig) -> bool:
    """Whether a session cannot be had, or carries nothing: TLS 1.3 tells a client late that it is not accepted."""
    try:
        bus = open_bus(config)
    except VggtMotionError:
        return True
    try:
        bus.request(bus.keys.rpc("ledger", "append"), b"keyframe", timeout_s=2.0)
    except VggtMotionError:
        return True
    finally:
        bus.close()
    return False


def test_strangers_are_refused(certificates: Path, tmp_path: Path, rack: Path, endpoint: str) -> None:
    owner = open_bus(BusConfig(endpoint=endpoint, zenoh_config=rack))
    seen: list[bytes] = []

    def note(_: str, payload: bytes) -> bytes:
        seen.append(payload)
        return b""

    try:
        with contextlib.closing(owner.serve(owner.keys.rpc("ledger", "append"), note)):
            answered(owner, b"mine")
            seen.clear()
            # Someone whose certificate another authority has signed.
            foreign = tmp_path / "foreign"
            authority(foreign)
            certificate(foreign, "vehicle", "DNS:vehicle-017", "clientAuth")
            shutil.copy(certificates / "ca.pem", foreign / "ca.pem")
            stranger = installed(tmp_path, "vehicle_tls.json5", foreign)
            assert refused(BusConfig(endpoint=endpoint, zenoh_config=stranger, connect_timeout_s=2.0))
            # Someone without a certificate who trusts the rack.
            anonymous = tmp_path / "anonymous.json5"
            anonymous.write_text(
                f'{{transport: {{link: {{tls: {{root_ca_certificate: "{certificates}/ca.pem"}}}}}}}}', encoding="utf-8"
            )
            assert refused(BusConfig(endpoint=endpoint, zenoh_config=anonymous, connect_timeout_s=2.0))
            # Someone without TLS.
            assert refused(BusConfig(endpoint=endpoint.replace("tls/", "tcp/"), connect_timeout_s=2.0))
            assert seen == []
            answered(owner, b"mine")  # the router still serves its own
            assert seen == [b"mine"]
    finally:
        owner.close()


def test_vehicle_does_not_talk_to_a_false_rack(certificates: Path, tmp_path: Path) -> None:
    """A router with a certificate of our authority but for another name is not the rack."""
    false = tmp_path / "false"
    shutil.copytree(certificates, false)
    certificate(false, "rack", "DNS:elsewhere.example.org", "serverAuth,clientAuth")
    port = free_port()
    router = open_bus(
        BusConfig(endpoint=f"tls/127.0.0.1:{port}", zenoh_config=installed(tmp_path, "rack_tls.json5", false)), "router"
    )
    try:
        vehicle = installed(tmp_path, "vehicle_tls.json5", certificates)
        with pytest.raises(VggtMotionError):
            open_bus(BusConfig(endpoint=f"tls/localhost:{port}", zenoh_config=vehicle, connect_timeout_s=2.0))
    finally:
        router.close()


def test_password_keeps_strangers_out(tmp_path: Path) -> None:
    users = tmp_path / "users.txt"
    text = (SHIPPED / "plain.json5").read_text(encoding="utf-8")
    assert "/etc/vggt-motion/zenoh/users.txt" in text and '"change-me"' in text
    member, stranger = tmp_path / "member.json5", tmp_path / "stranger.json5"
    member.write_text(text.replace("/etc/vggt-motion/zenoh/users.txt", str(users)), encoding="utf-8")
    stranger.write_text(member.read_text(encoding="utf-8").replace('"change-me"', '"guess"'), encoding="utf-8")
    users.write_text("vggt-motion:change-me\n", encoding="utf-8")
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    with contextlib.closing(open_bus(BusConfig(endpoint=endpoint, zenoh_config=member), "router")):
        with contextlib.closing(open_bus(BusConfig(endpoint=endpoint, zenoh_config=member))) as bus:
            assert bus.is_connected
        for file in (stranger, None):
            with pytest.raises(BusUnavailableError):
                open_bus(BusConfig(endpoint=endpoint, zenoh_config=file, connect_timeout_s=1.0))
