"""Goal: behind a proxy that ends TLS each client has its own rights, whatever it says of itself. Method: HAProxy with deploy/haproxy/haproxy-tls.cfg before a
server with a fleet file, certificates made here."""

import re
import shutil
import subprocess
import time
from pathlib import Path

import grpc
import pytest
from conftest import free_port, start_server, straight

import nesam
from nesam.v1 import sessions_pb2, sessions_pb2_grpc

CONFIGURATION = Path(__file__).parents[3] / "deploy/haproxy/haproxy-tls.cfg"
FLEET = """
operators = ["control"]
proxies = ["front"]
[vehicles.truck-7]
[vehicles.truck-8]
[planners.mission-1]
vehicles = ["truck-7"]
"""
SERVER = """
[tls]
certificate = "nesam.pem"
key = "nesam.key"
client_ca = "fleet-ca.pem"
fleet = "fleet.toml"
[http]
listen = "127.0.0.1:0"
health = "127.0.0.1:{health}"
[zenoh]
enabled = false
"""


def openssl(folder, *arguments):
    subprocess.run(["openssl", *arguments], cwd=folder, check=True, stderr=subprocess.DEVNULL)


def certify(folder, file, common_name, *names):
    """A certificate of the fleet's authority and its key."""
    curve = ["-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes"]
    if not (folder / "fleet-ca.pem").exists():
        openssl(folder, "req", "-x509", *curve, "-days", "1", "-subj", "/CN=fleet", "-keyout", "fleet-ca.key", "-out", "fleet-ca.pem")
    openssl(folder, "req", *curve, "-subj", f"/CN={common_name}", "-keyout", f"{file}.key", "-out", f"{file}.csr")
    (folder / f"{file}.ext").write_text("subjectAltName=" + ",".join(names) + "\n")
    authority = ["-CA", "fleet-ca.pem", "-CAkey", "fleet-ca.key", "-CAcreateserial"]
    openssl(folder, "x509", "-req", "-in", f"{file}.csr", *authority, "-days", "1", "-extfile", f"{file}.ext", "-out", f"{file}.pem")


@pytest.fixture
def fleet(request, tmp_path):
    """Folder of the certificates and address of the proxy."""
    if not (CONFIGURATION.is_file() and shutil.which("haproxy") and shutil.which("openssl")):
        pytest.skip("needs the repository, haproxy and openssl")
    certify(tmp_path, "nesam", "nesam:server:nesam-1", "DNS:nesam", "URI:nesam:server:nesam-1")
    certify(tmp_path, "front", "nesam:proxy:front", "DNS:localhost", "URI:nesam:proxy:front")
    (tmp_path / "proxy.pem").write_text((tmp_path / "front.pem").read_text() + (tmp_path / "front.key").read_text())
    for identity in ("vehicle:truck-7", "vehicle:truck-8", "planner:mission-1", "operator:control"):
        certify(tmp_path, identity.split(":")[1], f"nesam:{identity}", f"URI:nesam:{identity}")
    health, port = free_port(), free_port()
    (tmp_path / "fleet.toml").write_text(FLEET)
    (tmp_path / "nesam.toml").write_text(SERVER.format(health=health))
    server, address = start_server(request, "--config", "nesam.toml", "--grpc", "127.0.0.1:0", folder=tmp_path)
    text = CONFIGURATION.read_text().replace("/etc/nesam/tls", str(tmp_path)).replace("bind :50051", f"bind 127.0.0.1:{port}").replace("50081", str(health))
    text = re.sub(r"^ +server nesam-[23] .*\n", "", text, flags=re.MULTILINE)
    (tmp_path / "haproxy.cfg").write_text(text.replace("nesam-1:50051", address.removeprefix("https://")))
    proxy = subprocess.Popen(["haproxy", "-db", "-f", "haproxy.cfg"], cwd=tmp_path, stdout=subprocess.DEVNULL)
    yield tmp_path, f"localhost:{port}"
    proxy.terminate()
    server.terminate()
    proxy.wait(timeout=30)
    assert server.wait(timeout=30) == 0


def tls(folder, name):
    return nesam.Tls.from_files(folder / "fleet-ca.pem", folder / f"{name}.pem", folder / f"{name}.key")


def connected(folder, address, name, vehicle):
    return nesam.Client(address, timeout_s=20.0, tls=tls(folder, name), vehicle_id=vehicle)


def until_served(client):
    """The proxy asks for the health of the server before it sends anything there."""
    begun = time.monotonic()
    while True:
        try:
            return client.sessions()
        except nesam.NesamError:
            assert time.monotonic() - begun < 20.0, "the proxy serves nobody"
            time.sleep(0.1)


def sessions_seen(folder, address, name, said):
    """What a client sees that says it is somebody."""
    shown = tls(folder, name)
    credentials = grpc.ssl_channel_credentials(shown.authority, shown.key, shown.certificate)
    with grpc.secure_channel(address, credentials) as channel:
        metadata = [("x-vehicle-id", "truck-7"), *(("x-nesam-identity", who) for who in said)]
        listed = sessions_pb2_grpc.SessionsStub(channel).List(sessions_pb2.ListSessionsRequest(), metadata=metadata, timeout=20.0)
    return [session.session_id for session in listed.sessions]


def test_service_rights_hold_behind_a_proxy_that_ends_tls(fleet):
    folder, address = fleet
    with connected(folder, address, "truck-7", "truck-7") as own, connected(folder, address, "truck-8", "truck-7") as other:
        until_served(own)
        own.open_session("truck-7")
        assert {answer.outcome for answer in own.measure(straight("truck-7", 20))} == {"APPLIED"}
        with pytest.raises(nesam.NesamError, match="vehicle `truck-8` has no right"):
            other.session("truck-7")
        with connected(folder, address, "mission-1", "truck-7") as planner:
            assert planner.session("truck-7").accepted == 20
            with pytest.raises(nesam.NesamError, match="planner `mission-1` has no right"):
                planner.close_session("truck-7")
    # What a client says of itself is overwritten, once or twice.
    assert sessions_seen(folder, address, "control", []) == ["truck-7"]
    for said in (["nesam:operator:control"], ["nesam:operator:control", "nesam:vehicle:truck-7"]):
        assert sessions_seen(folder, address, "truck-8", said) == []
    # Without a certificate nobody gets as far as the servers.
    with pytest.raises(nesam.NesamError), nesam.Client(address, timeout_s=5.0, tls=nesam.Tls.from_files(folder / "fleet-ca.pem"), vehicle_id="truck-7") as nobody:
        nobody.sessions()
