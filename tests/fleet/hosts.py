"""Hosts of the fleet: network namespaces on one bridge, or loopback addresses where namespaces cannot be made."""

import ctypes
import os
import subprocess

NAMES = ("etcd", "etcd-2", "etcd-3", "proxy", "router", "nesam-1", "nesam-2", "nesam-3", "client")
_CLONE_NEWNET = 0x40000000


class CannotCut(Exception):
    """Loopback cannot be cut."""


class Loopback:
    """Every host is an address of loopback. Nothing can be cut."""

    can_cut = False

    def __init__(self):
        self.address = {name: f"127.77.0.{i + 2}" for i, name in enumerate(NAMES)}

    def command(self, host, command):
        """The command as it has to be started for a host."""
        return list(command)

    def cut(self, host, other=None):
        raise CannotCut(host)

    def heal(self, host, other=None):
        raise CannotCut(host)

    def close(self):
        pass


class Namespaces:
    """Every host is a network namespace; the bridge is in one of its own, so that the machine's network is left alone. This process moves into `client`."""

    can_cut = True

    def __init__(self):
        self._prefix = f"nf{os.getpid()}"
        self.address = {name: f"10.77.0.{i + 2}" for i, name in enumerate(NAMES)}
        self._made = []
        self._home = os.open("/proc/self/ns/net", os.O_RDONLY)
        try:
            self._build()
        except (OSError, subprocess.CalledProcessError):
            self.close()
            raise

    def _name(self, host):
        return f"{self._prefix}-{host}"

    def _ip(self, *arguments):
        subprocess.run(["ip", *arguments], check=True, capture_output=True)

    def _build(self):
        for host in ("net", *NAMES):
            self._ip("netns", "add", self._name(host))
            self._made.append(host)
            self._ip("-n", self._name(host), "link", "set", "lo", "up")
        net = self._name("net")
        self._ip("-n", net, "link", "add", "bridge", "type", "bridge")
        self._ip("-n", net, "link", "set", "bridge", "up")
        for i, host in enumerate(NAMES):
            self._ip("-n", net, "link", "add", f"to-{i}", "type", "veth", "peer", "name", "eth0", "netns", self._name(host))
            self._ip("-n", net, "link", "set", f"to-{i}", "master", "bridge", "up")
            self._ip("-n", self._name(host), "addr", "add", f"{self.address[host]}/24", "dev", "eth0")
            self._ip("-n", self._name(host), "link", "set", "eth0", "up")
        with open(f"/var/run/netns/{self._name('client')}", "rb") as own:
            if ctypes.CDLL(None, use_errno=True).setns(own.fileno(), _CLONE_NEWNET) != 0:
                raise OSError(ctypes.get_errno(), "setns")

    def command(self, host, command):
        """The command as it has to be started for a host."""
        return ["ip", "netns", "exec", self._name(host), *command]

    def cut(self, host, other=None):
        """Cuts a host off, from everybody or from one other."""
        if other is None:
            self._ip("-n", self._name("net"), "link", "set", f"to-{NAMES.index(host)}", "down")
        else:
            self._ip("-n", self._name(host), "route", "add", "blackhole", f"{self.address[other]}/32")

    def heal(self, host, other=None):
        if other is None:
            self._ip("-n", self._name("net"), "link", "set", f"to-{NAMES.index(host)}", "up")
        else:
            self._ip("-n", self._name(host), "route", "del", "blackhole", f"{self.address[other]}/32")

    def close(self):
        ctypes.CDLL(None).setns(self._home, _CLONE_NEWNET)
        for host in reversed(self._made):
            subprocess.run(["ip", "netns", "del", self._name(host)], capture_output=True)
        self._made = []


def make(loopback):
    """Namespaces if they can be made, else loopback; says which and why."""
    if loopback:
        return Loopback(), "as asked"
    try:
        return Namespaces(), ""
    except (OSError, subprocess.CalledProcessError) as error:
        return Loopback(), (getattr(error, "stderr", None) or str(error).encode()).decode().strip()
