"""The processes of the fleet: etcd, HAProxy or Envoy with the shipped configuration, a Zenoh router, and the replicas."""

import base64
import contextlib
import json
import os
import re
import signal
import subprocess
import sys
import time
import urllib.request
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
REPLICAS = ("nesam-1", "nesam-2", "nesam-3")
MEMBERS = ("etcd", "etcd-2", "etcd-3")
LEASE_S = 1
ROUTER = """
import sys, time, zenoh
config = zenoh.Config()
config.insert_json5("mode", '"router"')
config.insert_json5("listen/endpoints", sys.argv[1])
config.insert_json5("scouting/multicast/enabled", "false")
with zenoh.open(config):
    while True:
        time.sleep(60)
"""


class Process:
    """A process that can be started, stopped and killed again and again."""

    def __init__(self, name, command, log):
        self.name, self._command, self._log = name, command, log
        self._child = None

    def start(self):
        self._child = subprocess.Popen(self._command, stdout=open(self._log, "ab"), stderr=subprocess.STDOUT, start_new_session=True)

    def replace(self, command):
        """What it is from its next start on."""
        self._command = command

    def signal(self, number):
        os.kill(self._child.pid, number)

    def kill(self):
        if self._child is not None and self._child.poll() is None:
            os.killpg(self._child.pid, signal.SIGKILL)
            self._child.wait()

    def terminate(self, timeout_s=30.0):
        """SIGTERM; the exit status."""
        self._child.terminate()
        return self._child.wait(timeout_s)

    @property
    def running(self):
        return self._child is not None and self._child.poll() is None

    @property
    def pid(self):
        return self._child.pid


@contextlib.contextmanager
def slow_disk(pid, delay_s):
    """While it lasts, each wait of a process for its disk takes so much longer. Raises OSError where processes cannot be traced."""
    syncs = "fsync,fdatasync"
    command = ["strace", "-f", "-qq", "-o", os.devnull, "-e", f"trace={syncs}", "-e", f"inject={syncs}:delay_exit={delay_s * 1e6:.0f}", "-p", str(pid)]
    tracer = subprocess.Popen(command, stderr=subprocess.PIPE)
    try:
        if not _traced_by(pid, tracer):
            raise OSError(f"strace: {tracer.communicate()[1].decode().strip()}")
        yield
    finally:
        # It lets go of what it traces.
        tracer.terminate()
        tracer.communicate()


def _traced_by(pid, tracer):
    """Whether a process is traced, once its tracer has begun or given up."""
    while tracer.poll() is None:
        if f"TracerPid:\t{tracer.pid}\n" in Path(f"/proc/{pid}/status").read_text():
            return True
        time.sleep(0.01)
    return False


def why_no_slow_disk():
    """Why disks cannot be slowed down here; empty if they can."""
    with subprocess.Popen(["sleep", "60"]) as sleeper:
        try:
            with slow_disk(sleeper.pid, 1.0):
                return ""
        except OSError as error:
            return str(error)
        finally:
            sleeper.kill()


class Fleet:
    """All of them."""

    def __init__(self, hosts, server, folder, members=1, idle_s=86400.0, before=None, envoy=False):
        self.hosts, self.folder = hosts, Path(folder)
        self.folder.mkdir(parents=True, exist_ok=True)
        at = hosts.address
        self.proxy_address = f"{at['proxy']}:50051"
        self.members, self.idle_s, self._server = MEMBERS[:members], idle_s, server
        self._etcd_urls = {name: f"http://{at[name]}:2379" for name in self.members}
        commands = {
            **{name: self._member(name) for name in self.members},
            "proxy": self._envoy() if envoy else self._haproxy(),
            "router": [sys.executable, "-c", ROUTER, json.dumps([f"tcp/{at['router']}:7447"])],
        }
        for name in REPLICAS:
            commands[name] = self._replica(name, before or server)
        self.processes = {
            name: Process(name, hosts.command(name, command), self.folder / f"{name}.log") for name, command in commands.items()
        }

    def _replica(self, name, server):
        return [server, "serve", "--config", str(self._configuration(name))]

    def upgrade(self, name):
        """Ends a replica and starts the program that is tested in its place; its exit status."""
        status = self.processes[name].terminate()
        self.processes[name].replace(self.hosts.command(name, self._replica(name, self._server)))
        self.processes[name].start()
        self.await_healthy(name)
        return status

    def _member(self, name):
        client, peers = self._etcd_urls[name], {member: f"http://{self.hosts.address[member]}:2380" for member in self.members}
        command = ["etcd", "--name", name, "--data-dir", str(self.folder / name), "--listen-client-urls", client, "--advertise-client-urls", client]
        command += ["--listen-peer-urls", peers[name], "--initial-advertise-peer-urls", peers[name]]
        command += ["--initial-cluster", ",".join(f"{member}={peer}" for member, peer in peers.items())]
        return [*command, "--heartbeat-interval", "50", "--election-timeout", "500", "--snapshot-count", "1000", "--quota-backend-bytes", str(8 << 30), "--log-level", "error"]

    def _haproxy(self):
        return ["haproxy", "-db", "-f", self._at_our_addresses("haproxy/haproxy.cfg", "bind :50051", "bind {}:50051", "{}:50051")]

    def _envoy(self):
        path = self._at_our_addresses("envoy/envoy.yaml", "address: 0.0.0.0,", "address: {},", "address: {},")
        program = Path(sys.executable).parent / "envoy"
        return [str(program), "-c", path, "--use-dynamic-base-id", "--concurrency", "1", "--log-level", "error"]

    def _at_our_addresses(self, shipped, everywhere, here, replica):
        """Path of a copy of what is shipped for a proxy: it listens `here` and not `everywhere`, and finds each `replica` by its address and not by its name."""
        text = (ROOT / "deploy" / shipped).read_text().replace(everywhere, here.format(self.hosts.address["proxy"]))
        for name in REPLICAS:
            text = text.replace(replica.format(name), replica.format(self.hosts.address[name]))
        path = self.folder / Path(shipped).name
        path.write_text(text)
        return str(path)

    def _configuration(self, name):
        address = self.hosts.address[name]
        path = self.folder / f"{name}.toml"
        path.write_text(
            f'[grpc]\nlisten = "{address}:50051"\n[http]\nlisten = "{address}:50080"\n'
            f'[zenoh]\nlisten = []\nconnect = ["tcp/{self.hosts.address["router"]}:7447"]\nfleet = "fleet"\nname = "{name}"\n'
            f"[cluster]\netcd = {json.dumps(list(self._etcd_urls.values()))}\n"
            f'name = "{name}"\nlease_s = {LEASE_S}\n[limits]\nsession_idle_s = {self.idle_s}\n'
        )
        return path

    def start(self):
        for name in (*self.members, "router", *REPLICAS):
            self.processes[name].start()
        for name in REPLICAS:
            self.await_healthy(name)
        self.processes["proxy"].start()
        time.sleep(1.0)

    def healthy(self, name):
        try:
            with urllib.request.urlopen(f"http://{self.hosts.address[name]}:50080/health", timeout=0.5) as reply:
                return reply.status == 200
        except OSError:
            return False

    def await_healthy(self, name, timeout_s=60.0):
        end = time.monotonic() + timeout_s
        while not self.healthy(name):
            if time.monotonic() > end or not self.processes[name].running:
                raise RuntimeError(f"{name} does not come up; see {self.folder / (name + '.log')}")
            time.sleep(0.05)

    def declined_by_envoy(self):
        """Counters of calls that Envoy declined by a limit of its own, and did not send or not send again, where they are not 0."""
        ask = "import sys, urllib.request; sys.stdout.buffer.write(urllib.request.urlopen('http://127.0.0.1:9901/stats?filter=overflow$', timeout=5).read())"
        told = subprocess.run(self.hosts.command("proxy", [sys.executable, "-c", ask]), check=True, capture_output=True, text=True).stdout
        return [line for line in told.splitlines() if not line.endswith(": 0")]

    def metric(self, name, metric):
        with urllib.request.urlopen(f"http://{self.hosts.address[name]}:50080/metrics", timeout=5) as reply:
            return float(re.search(rf"^{metric} (\S+)$", reply.read().decode(), re.M).group(1))

    def stop(self):
        for process in self.processes.values():
            process.kill()

    def _etcd(self, path, body, timeout_s=5.0, member=None):
        """What a member answers: the one asked for, else the first that does."""
        members = [member] if member else self.members
        for name in members:
            request = urllib.request.Request(self._etcd_urls[name] + path, data=json.dumps(body).encode())
            try:
                return urllib.request.urlopen(request, timeout=timeout_s)
            except OSError:
                if name == members[-1]:
                    raise

    def leader(self):
        """The member of etcd that leads."""
        for name in self.members:
            with self._etcd("/v3/maintenance/status", {}, member=name) as reply:
                told = json.load(reply)
            if told["leader"] == told["header"]["member_id"]:
                return name
        raise RuntimeError("etcd has no leader")

    @staticmethod
    def _prefix(prefix):
        end = prefix[:-1] + chr(ord(prefix[-1]) + 1)
        return {"key": base64.b64encode(prefix.encode()).decode(), "range_end": base64.b64encode(end.encode()).decode()}

    def revision(self):
        with self._etcd("/v3/kv/range", {"key": base64.b64encode(b"x").decode()}) as reply:
            return int(json.load(reply)["header"]["revision"])

    def write_s(self):
        """How long etcd takes for a write."""
        begun = time.monotonic()
        self._etcd("/v3/kv/put", {"key": base64.b64encode(b"fleet/written").decode()}).close()
        return time.monotonic() - begun

    def owners(self):
        """Name of the server that has each session."""
        with self._etcd("/v3/kv/range", self._prefix("nesam/live/owner/")) as reply:
            found = json.load(reply).get("kvs", [])
        return {_text(kv["key"]).rsplit("/", 1)[1]: json.loads(_text(kv["value"]))["name"] for kv in found}

    def sessions(self):
        """Names of the sessions in etcd."""
        with self._etcd("/v3/kv/range", {**self._prefix("nesam/session/"), "keys_only": True}) as reply:
            return [_text(kv["key"]).rsplit("/", 1)[1] for kv in json.load(reply).get("kvs", [])]

    def history(self, since):
        """What etcd remembers of owners and sessions after a revision: (revision, kind, session, is it a put, was it made new)."""
        until, events = self.revision(), []
        with self._etcd("/v3/watch", {"create_request": {**self._prefix("nesam/"), "start_revision": since + 1}}, timeout_s=10.0) as stream:
            while until > since:
                told = json.loads(stream.readline())["result"]
                for event in told.get("events", []):
                    kv, put = event["kv"], event.get("type", "PUT") == "PUT"
                    words = _text(kv["key"]).split("/")
                    kind = {"live": words[2], "session": "session"}.get(words[1])
                    revision = int(kv["mod_revision"])
                    if kind in ("owner", "session"):
                        events.append((revision, kind, words[-1], put, put and kv["create_revision"] == kv["mod_revision"]))
                    since = max(since, revision)
                # The last revisions may be of keys that do not interest.
                since = max(since, int(told["header"]["revision"]) if told.get("events") else since)
        return events


def _text(encoded):
    return base64.b64decode(encoded).decode()
